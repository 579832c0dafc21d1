// Frames in a stream: `Search` in search.py, whose text says what is done; names are the same.
#pragma once

#include <algorithm>
#include <array>
#include <bitset>
#include <cstddef>
#include <cstdint>
#include <utility>
#include <vector>

namespace risaf {

constexpr std::uint8_t MARK_V1 = 0xFE, MARK_V2 = 0xFD, SIGNED = 0x01;
constexpr std::size_t HEADER_V1 = 6, HEADER_V2 = 10, CHECKSUM = 2, SIGNATURE = 13;

inline bool is_mark(std::uint8_t byte) { return byte == MARK_V1 || byte == MARK_V2; }

inline std::size_t header_size(std::uint8_t version) { return version == 2 ? HEADER_V2 : HEADER_V1; }

// CRC-16/MCRF4XX, eight bytes at a time: row k holds what a byte does k bytes later.
class Checksum {
 public:
  static constexpr std::size_t ROWS = 8;
  using Table = std::array<std::array<std::uint16_t, 256>, ROWS>;

  static std::uint16_t of(const std::uint8_t* bytes, std::size_t size) {
    std::uint16_t crc = 0xFFFF;
    for (; size >= ROWS; size -= ROWS, bytes += ROWS) {
      std::uint16_t next = TABLE[7][bytes[0] ^ (crc & 0xFF)] ^ TABLE[6][bytes[1] ^ (crc >> 8)];
      for (std::size_t i = 2; i < ROWS; ++i) {
        next ^= TABLE[ROWS - 1 - i][bytes[i]];
      }
      crc = next;
    }
    for (; size > 0; --size, ++bytes) {
      crc = step(crc, *bytes);
    }
    return crc;
  }

  static constexpr std::uint16_t step(std::uint16_t crc, std::uint8_t byte) {
    return static_cast<std::uint16_t>((crc >> 8) ^ TABLE[0][(crc ^ byte) & 0xFF]);
  }

 private:
  static constexpr Table made() {
    Table table{};
    for (unsigned byte = 0; byte < 256; ++byte) {
      unsigned crc = byte;
      for (int bit = 0; bit < 8; ++bit) {
        crc = crc & 1 ? crc >> 1 ^ 0x8408 : crc >> 1;
      }
      table[0][byte] = static_cast<std::uint16_t>(crc);
    }
    for (std::size_t row = 1; row < ROWS; ++row) {
      for (unsigned byte = 0; byte < 256; ++byte) {
        const std::uint16_t before = table[row - 1][byte];
        table[row][byte] = static_cast<std::uint16_t>(before >> 8 ^ table[0][before & 0xFF]);
      }
    }
    return table;
  }

  static const Table TABLE;
};

inline constexpr Checksum::Table Checksum::TABLE = Checksum::made();

// One frame: `CUT` in search.py.
struct Cut {
  std::int64_t start;
  std::int32_t prefix;
  std::uint32_t message_id;
  std::uint8_t version, sequence, system, component, size, is_signed, known, unused;

  std::size_t payload() const { return static_cast<std::size_t>(start) + header_size(version); }
};
static_assert(sizeof(Cut) == 24);

enum class No { MARK = -1, CHECKSUM, INCOMPATIBLE, UNVERIFIED, END };  // why there is no frame

class Search {
 public:
  using Extras = std::vector<std::int16_t>;  // CRC_EXTRA by message id; -1: not known

  std::vector<Cut> cuts;
  std::size_t keep = 0, skipped = 0, summed = 0;
  std::array<std::size_t, 4> dropped{};  // by `No`

  Search(const Extras& extras, const std::uint8_t* buffer, std::size_t size,
         std::size_t prefix_size, bool ended)
      : extras_(extras), buffer_(buffer), size_(size), prefix_size_(prefix_size), ended_(ended) {}

  // Returns where the last frame ended, and whether the next must follow directly.
  std::pair<std::size_t, bool> cut(std::size_t done, bool in_step) {
    std::size_t at = 0, free = 0, start = 0;
    while (true) {
      start = in_step ? done + prefix_size_ : next_mark(at);
      Cut found;
      No no = No::END;
      if (start < size_ && is_frame(start, in_step, &found, &no)) {
        const std::size_t between = start - std::min(start, done);
        const std::size_t prefix = std::min(prefix_size_, between);
        found.prefix = static_cast<std::int32_t>(prefix);
        skipped += between - prefix;
        done = end_of(found);
        at = free = done - (found.is_signed ? SIGNATURE : 1);
        in_step = true;
        cuts.push_back(found);
      } else if (no == No::END && (!ended_ || start >= size_)) {
        break;
      } else if (in_step) {
        if (no != No::MARK) {
          ++dropped[static_cast<std::size_t>(no)];
        }
        in_step = false;
      } else {
        at = start + 1;
      }
    }
    keep = in_step ? free : std::max(free, start - std::min(start, prefix_size_));
    skipped += keep - std::min(keep, done);
    return {done - std::min(keep, done), in_step};
  }

 private:
  static std::size_t checksum_of(const Cut& cut) { return cut.payload() + cut.size; }
  static std::size_t end_of(const Cut& cut) {
    return checksum_of(cut) + CHECKSUM + (cut.is_signed ? SIGNATURE : 0);
  }

  std::size_t next_mark(std::size_t at) const {
    while (at < size_ && !is_mark(buffer_[at])) {
      ++at;
    }
    return std::min(at, size_);
  }

  bool is_frame(std::size_t start, bool in_step, Cut* found, No* no) {
    return read_header(start, found, no) && !is_faulty(*found, no) &&
           (found->known || !is_doubtful(*found, in_step, no));
  }

  bool read_header(std::size_t start, Cut* found, No* no) const {
    const std::uint8_t* b = buffer_ + start;
    if (!is_mark(b[0])) {
      *no = No::MARK;
      return false;
    }
    const bool second = b[0] == MARK_V2;
    if (size_ - start < (second ? HEADER_V2 : HEADER_V1)) {
      *no = No::END;
      return false;
    }
    if (second && (b[2] & ~SIGNED)) {
      *no = No::INCOMPATIBLE;
      return false;
    }
    const std::uint32_t message_id = second ? b[7] | b[8] << 8 | b[9] << 16 : b[5];
    const std::uint8_t* sender = b + (second ? 4 : 2);  // and its sequence number
    *found = {static_cast<std::int64_t>(start), 0, message_id,
              static_cast<std::uint8_t>(second ? 2 : 1), sender[0], sender[1], sender[2], b[1],
              static_cast<std::uint8_t>(second && b[2]), extra_of(message_id) >= 0, 0};
    return true;
  }

  bool is_faulty(const Cut& cut, No* no) {
    if (size_ < end_of(cut)) {
      *no = No::END;
      return true;
    }
    const std::uint8_t* content = buffer_ + cut.start + 1;
    const std::uint8_t* checksum = buffer_ + checksum_of(cut);
    summed += static_cast<std::size_t>(checksum - content);
    const std::uint16_t crc = Checksum::of(content, static_cast<std::size_t>(checksum - content));
    const auto sent = static_cast<std::uint16_t>(checksum[0] | checksum[1] << 8);
    const bool holds = cut.known ? sent == Checksum::step(crc, extra_of(cut.message_id))
                                 : fits_any(crc, sent);
    *no = No::CHECKSUM;
    return !holds;
  }

  // Whether an unknown message is not believed: the third rule in search.py.
  bool is_doubtful(const Cut& cut, bool in_step, No* no) {
    const std::size_t end = end_of(cut), behind = end + prefix_size_;
    if (behind < size_) {
      if (!is_mark(buffer_[behind])) {
        *no = No::UNVERIFIED;
        return true;
      }
    } else if (!ended_) {
      *no = No::END;
      return true;
    }
    bool must_wait = false;
    for (auto at = next_mark(static_cast<std::size_t>(cut.start) + 1); at < end;
         at = next_mark(at + 1)) {
      Cut inner;
      No why = No::MARK;
      if (read_header(at, &inner, &why)) {
        if (!inner.known || (in_step && end_of(inner) > end)) {
          continue;
        }
        if (!is_faulty(inner, &why)) {
          *no = No::UNVERIFIED;
          return true;
        }
      }
      must_wait = must_wait || (why == No::END && !in_step && !ended_);
    }
    *no = No::END;
    return must_wait;
  }

  std::int16_t extra_of(std::uint32_t message_id) const {
    return message_id < extras_.size() ? extras_[message_id] : std::int16_t{-1};
  }

  static bool fits_any(std::uint16_t crc, std::uint16_t sent) {
    static const std::bitset<65536> steps = [] {
      std::bitset<65536> all;
      for (unsigned byte = 0; byte < 256; ++byte) {
        all.set(Checksum::step(0, static_cast<std::uint8_t>(byte)));
      }
      return all;
    }();
    return steps[static_cast<std::uint16_t>(sent ^ crc >> 8)];
  }

  const Extras& extras_;
  const std::uint8_t* buffer_;
  std::size_t size_, prefix_size_;
  bool ended_;
};

}  // namespace risaf
