// Whole epochs of one array out of a table of frames, as long as all is as usual. What is not is left
// to `Ingest` and `EpochAssembler`, and so is the meaning of all this: `block.py` says what is usual.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <limits>
#include <utility>
#include <vector>

#include "frames.hpp"

namespace risaf {

// Of a message: `Kind` in block.py.
enum Kind : std::uint8_t { IGNORED, ASIDE, APART, REFUSED, GYROS, FORCES };

// Sensors of one kind.
struct Sensors {
  std::size_t count;
  double scale, limit;  // of a count of the message; what is as large, or larger, is saturated
};

struct ArrayLayout {
  std::uint8_t system, component, array_id;
  Sensors gyros, accels;
  std::vector<std::uint8_t> told;  // by its last IMU_ARRAY_INFO, behind the time; empty: nothing
};

// How the last epoch ended, and this one may go on.
struct Clock {
  std::int64_t time_us;
  std::uint16_t sequence;
};

struct EpochRows {
  std::size_t newest, begun, heard, end;  // first frame; first and last of the gyros; last of all
  std::int64_t time_us;
};

// A frame that stands between epochs, or within one, and bears on none of them.
struct Aside {
  std::size_t row, before;  // index of the epoch before which it is to be handed on
};

struct Unusable {
  std::size_t invalid = 0, saturated = 0;
};

class EpochFinder {
 public:
  static constexpr std::int64_t LATEST_US = std::int64_t{1} << 62;
  static constexpr std::size_t INFO_TIME = 8, HEAD = 12, COUNT = 252, ARRAY_ID = 253, CAPACITY = 40;
  static constexpr std::int16_t INVALID = -32768;

  // `kinds` by message id; `info_id`: of IMU_ARRAY_INFO; `jump_us`: a step that is no usual one;
  // `patience_us`: for how long an array may be silent without another being listened to.
  EpochFinder(std::vector<std::uint8_t> kinds, std::uint32_t info_id, std::int64_t jump_us,
              std::uint64_t patience_us)
      : kinds_(std::move(kinds)), info_id_(info_id), jump_us_(jump_us), patience_us_(patience_us) {}

  // Begin with a table, which must outlive its use.
  void load(const std::uint8_t* buffer, const Cut* cuts, const std::uint64_t* times_us,
            std::size_t size) {
    buffer_ = buffer;
    cuts_ = cuts;
    times_us_ = times_us;
    size_ = size;
    at_ = 0;
  }

  // Take whole epochs, up to the first frame that is not as usual. They stay known until the next
  // call; `clock` is that of the last one, then.
  const std::vector<EpochRows>& take(const ArrayLayout& array, Clock* clock,
                                     std::uint64_t heard_us, std::size_t most) {
    epochs_.clear();
    chunks_.clear();
    refused_.clear();
    asides_.clear();
    EpochRows epoch{};
    Clock now = *clock;
    std::size_t whole_chunks = 0, gyros = 0, forces = 0;
    for (std::size_t row = at_; row < size_ && epochs_.size() < most; ++row) {
      const Kind kind = kind_of(row);
      if (kind == IGNORED) {
        continue;
      }
      if (kind == ASIDE || (kind == APART && repeats(array, row))) {
        asides_.push_back({row, epochs_.size()});
        continue;
      }
      if (kind == REFUSED && apart(times_us_[row], heard_us) <= patience_us_) {
        refused_.push_back(row);
        continue;
      }
      Chunk chunk;
      if (kind < GYROS || !read(array, row, kind == GYROS, &chunk)) {
        break;
      }
      std::size_t& come = chunk.is_gyro ? gyros : forces;
      const bool is_first = gyros + forces == 0;
      const std::int64_t step_us = chunk.clock.time_us - clock->time_us;
      if (chunk.first != come || (is_first ? step_us <= 0 || step_us > jump_us_
                                           : chunk.clock.time_us != epoch.time_us)) {
        break;
      }
      if (is_first) {
        epoch.newest = row;
        epoch.time_us = chunk.clock.time_us;
      }
      if (chunk.is_gyro) {
        const auto next = static_cast<std::uint16_t>(clock->sequence + 1);
        if (come == 0 && chunk.clock.sequence != next) {
          break;
        }
        if (come == 0) {
          epoch.begun = row;
          now = chunk.clock;
        }
        epoch.heard = row;
        heard_us = times_us_[row];
      }
      come += chunk.count;
      chunk.epoch = epochs_.size();
      chunks_.push_back(chunk);
      if (gyros == array.gyros.count && forces == array.accels.count) {
        epoch.end = row;
        epochs_.push_back(epoch);
        *clock = now;
        gyros = forces = 0;
        whole_chunks = chunks_.size();
        at_ = row + 1;
      }
    }
    chunks_.resize(whole_chunks);
    while (!refused_.empty() && refused_.back() >= at_) {
      refused_.pop_back();
    }
    while (!asides_.empty() && asides_.back().row >= at_) {
      asides_.pop_back();
    }
    return epochs_;
  }

  // What stood between the epochs that were taken and is to be handed on there.
  const std::vector<Aside>& asides() const { return asides_; }

  // What stood between the epochs that were taken and is not listened to.
  const std::vector<std::size_t>& refused() const { return refused_; }

  // How many frames of readings are in the epochs that were taken.
  std::size_t chunks() const { return chunks_.size(); }

  // Readings of the epochs that were taken, (epochs, sensors, 3).
  Unusable read(const Sensors& sensors, bool is_gyro, double* values) const {
    Unusable unusable;
    for (const Chunk& chunk : chunks_) {
      if (chunk.is_gyro == is_gyro) {
        double* to = values + 3 * (chunk.epoch * sensors.count + chunk.first);
        convert(chunk.readings, 3 * chunk.count, sensors, to, &unusable);
      }
    }
    return unusable;
  }

  // The next frame that is to be handed on alone; the size of the table: there is none.
  std::size_t single() {
    while (at_ < size_) {
      const std::size_t row = at_++;
      if (kind_of(row) != IGNORED) {
        return row;
      }
    }
    return size_;
  }

 private:
  struct Chunk {
    bool is_gyro;
    std::size_t epoch, first, count;
    Clock clock;
    const std::uint8_t* readings;
  };

  static std::uint64_t apart(std::uint64_t a, std::uint64_t b) { return a > b ? a - b : b - a; }

  Kind kind_of(std::size_t row) const {
    const std::uint32_t message_id = cuts_[row].message_id;
    return message_id < kinds_.size() ? static_cast<Kind>(kinds_[message_id]) : IGNORED;
  }

  // Whether a frame is an IMU_ARRAY_INFO that says what the array's last one said.
  bool repeats(const ArrayLayout& array, std::size_t row) const {
    const Cut& cut = cuts_[row];
    return cut.message_id == info_id_ && cut.system == array.system &&
           cut.component == array.component && !array.told.empty() &&
           cut.size == INFO_TIME + array.told.size() &&
           std::memcmp(buffer_ + cut.payload() + INFO_TIME, array.told.data(),
                       array.told.size()) == 0;
  }

  template <typename T>
  static T number(const std::uint8_t* bytes) {
    static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "as on the wire");
    T value;
    std::memcpy(&value, bytes, sizeof(T));
    return value;
  }

  // Read the head of GYRO_ARRAY or ACCEL_ARRAY; whether it is of the array and can be used.
  bool read(const ArrayLayout& array, std::size_t row, bool is_gyro, Chunk* chunk) const {
    const Cut& cut = cuts_[row];
    const std::uint8_t* payload = buffer_ + cut.payload();
    if (cut.size <= COUNT || cut.system != array.system || cut.component != array.component ||
        (cut.size > ARRAY_ID ? payload[ARRAY_ID] : 0) != array.array_id ||
        times_us_[row] > static_cast<std::uint64_t>(LATEST_US)) {
      return false;
    }
    const auto time_us = number<std::uint64_t>(payload);
    *chunk = {is_gyro, 0, number<std::uint16_t>(payload + 10), payload[COUNT],
              {static_cast<std::int64_t>(time_us), number<std::uint16_t>(payload + 8)},
              payload + HEAD};
    const Sensors& sensors = is_gyro ? array.gyros : array.accels;
    return time_us <= static_cast<std::uint64_t>(LATEST_US) && chunk->count > 0 &&
           chunk->count <= CAPACITY && chunk->first + chunk->count <= sensors.count &&
           sensors.scale > 0.0;
  }

  static void convert(const std::uint8_t* bytes, std::size_t size, const Sensors& sensors,
                      double* values, Unusable* unusable) {
    std::int16_t counts[3 * CAPACITY];
    std::memcpy(counts, bytes, size * sizeof(std::int16_t));
    int largest = 0;
    for (std::size_t i = 0; i < size; ++i) {
      largest = std::max(largest, std::abs(static_cast<int>(counts[i])));
    }
    for (std::size_t i = 0; i < size; ++i) {
      values[i] = counts[i] * sensors.scale;
    }
    if (largest * sensors.scale >= sensors.limit) {
      clean(counts, size, sensors.limit, values, unusable);
    }
  }

  static void clean(const std::int16_t* counts, std::size_t size, double limit, double* values,
                    Unusable* unusable) {
    for (std::size_t i = 0; i < size; ++i) {
      if (std::abs(values[i]) >= limit) {
        const bool is_invalid = counts[i] == INVALID || !std::isfinite(values[i]);
        ++(is_invalid ? unusable->invalid : unusable->saturated);
        values[i] = std::numeric_limits<double>::quiet_NaN();
      }
    }
  }

  std::vector<std::uint8_t> kinds_;
  std::uint32_t info_id_;
  std::int64_t jump_us_;
  std::uint64_t patience_us_;
  const std::uint8_t* buffer_ = nullptr;
  const Cut* cuts_ = nullptr;
  const std::uint64_t* times_us_ = nullptr;
  std::size_t size_ = 0;
  std::size_t at_ = 0;  // all before it is done with
  std::vector<EpochRows> epochs_;
  std::vector<Chunk> chunks_;
  std::vector<std::size_t> refused_;
  std::vector<Aside> asides_;
};

}  // namespace risaf
