// The kernel's readers of bytes on their own, for libFuzzer with the sanitizers:
//
//   clang++ -std=c++17 -g -O1 -fsanitize=fuzzer,address,undefined -fno-sanitize-recover=all
//       -I risaf_link/mavlink/native tests/fuzz/kernel.cpp -o out/kernel && out/kernel
//
// A stream gives the same frames however it is cut, none of which reaches beyond it; and epochs are
// found in a table of frames without a step outside of buffers that are just as large as they must.
#include <cstdint>
#include <cstdlib>
#include <vector>

#include "epochs.hpp"
#include "frames.hpp"

namespace {

using risaf::Cut;
using Bytes = std::vector<std::uint8_t>;

constexpr std::uint32_t INFO = 59610, GYRO_ARRAY = 59611, ACCEL_ARRAY = 59612, RAW_IMU = 27;

void require(bool holds) {
  if (!holds) {
    std::abort();
  }
}

const risaf::Search::Extras& extras() {
  static const risaf::Search::Extras all = [] {
    risaf::Search::Extras values(ACCEL_ARRAY + 1, -1);
    values[0] = 50;
    values[RAW_IMU] = 144;
    values[INFO] = 1;
    values[GYRO_ARRAY] = 2;
    values[ACCEL_ARRAY] = 3;
    return values;
  }();
  return all;
}

// Put the checksums right of what may be frames, one after another.
void mend(Bytes* data) {
  for (std::size_t at = 0; at + risaf::HEADER_V2 < data->size();) {
    std::uint8_t* b = data->data() + at;
    const std::size_t header = risaf::header_size(b[0] == risaf::MARK_V2 ? 2 : 1);
    const std::size_t end = at + header + b[1];
    if (!risaf::is_mark(b[0]) || end + risaf::CHECKSUM > data->size()) {
      ++at;
      continue;
    }
    const std::uint32_t id = b[0] == risaf::MARK_V2 ? b[7] | b[8] << 8 | b[9] << 16 : b[5];
    const std::int16_t extra = id < extras().size() ? extras()[id] : std::int16_t{0};
    const std::uint16_t crc = risaf::Checksum::step(
        risaf::Checksum::of(b + 1, end - at - 1), static_cast<std::uint8_t>(extra));
    (*data)[end] = crc & 0xFF;
    (*data)[end + 1] = crc >> 8;
    at = end + risaf::CHECKSUM;
  }
}

// What `FrameParser` does: pieces of a stream, one after another.
struct Parser {
  std::size_t prefix = 0, done = 0, skipped = 0, kept_at = 0;
  bool in_step = true;
  Bytes buffer;
  std::vector<Cut> cuts;  // places are those in the whole stream
  std::array<std::size_t, 4> dropped{};

  void take(const std::uint8_t* data, std::size_t size, bool ended) {
    buffer.insert(buffer.end(), data, data + size);
    const Bytes exact(buffer);  // without room behind it
    risaf::Search search(extras(), exact.data(), exact.size(), prefix, ended);
    const auto [rest, follows] = search.cut(done, in_step);
    for (Cut cut : search.cuts) {
      require(cut.payload() + cut.size + risaf::CHECKSUM <= exact.size());
      require(cut.start >= cut.prefix);
      cut.start += static_cast<std::int64_t>(kept_at);
      cuts.push_back(cut);
    }
    require(search.keep <= exact.size());
    kept_at += search.keep;
    skipped += search.skipped;
    done = rest;
    in_step = follows;
    for (std::size_t i = 0; i < dropped.size(); ++i) {
      dropped[i] += search.dropped[i];
    }
    buffer.erase(buffer.begin(), buffer.begin() + static_cast<std::ptrdiff_t>(search.keep));
  }
};

bool same(const Cut& a, const Cut& b) {
  return a.start == b.start && a.prefix == b.prefix && a.message_id == b.message_id &&
         a.version == b.version && a.size == b.size && a.is_signed == b.is_signed &&
         a.known == b.known;
}

Parser parsed(const Bytes& data, std::size_t prefix, const std::uint8_t* sizes, std::size_t count) {
  Parser parser;
  parser.prefix = prefix;
  std::size_t at = 0;
  for (std::size_t i = 0; i < count; ++i) {
    const std::size_t size = std::min<std::size_t>(sizes[i], data.size() - at);
    parser.take(data.data() + at, size, false);
    at += size;
  }
  parser.take(data.data() + at, data.size() - at, false);
  parser.take(nullptr, 0, true);
  return parser;
}

void find_epochs(const Bytes& data, const std::vector<Cut>& cuts, const std::uint8_t* how) {
  std::vector<std::uint8_t> kinds(ACCEL_ARRAY + 1, risaf::IGNORED);
  kinds[0] = risaf::ASIDE;
  kinds[RAW_IMU] = risaf::REFUSED;
  kinds[INFO] = risaf::APART;
  kinds[GYRO_ARRAY] = risaf::GYROS;
  kinds[ACCEL_ARRAY] = risaf::FORCES;
  std::vector<std::uint64_t> times_us;
  for (std::size_t i = 0; i < cuts.size(); ++i) {
    times_us.push_back(i * how[3] * 1000 << (how[4] & 63));
  }
  const risaf::ArrayLayout array{1, 158, 0, {how[0], 1e-3, how[1] * 1.0}, {how[2], 1e-3, 1e9},
                                 Bytes(how[5] & 1 ? 40 : 0)};
  risaf::EpochFinder finder(kinds, INFO, 1'000'000, 3'000'000);
  const Bytes exact(data);
  finder.load(exact.data(), cuts.data(), times_us.data(), cuts.size());
  risaf::Clock clock{0, static_cast<std::uint16_t>(how[5] - 1)};
  for (std::size_t turns = 0; turns <= cuts.size(); ++turns) {
    const auto& epochs = finder.take(array, &clock, 0, 1 + how[4] % 8);
    for (const bool is_gyro : {true, false}) {
      const risaf::Sensors& sensors = is_gyro ? array.gyros : array.accels;
      std::vector<double> values(3 * sensors.count * epochs.size());
      finder.read(sensors, is_gyro, values.data());
    }
    for (const risaf::Aside& aside : finder.asides()) {
      require(aside.row < cuts.size() && aside.before < epochs.size());
    }
    for (const risaf::EpochRows& epoch : epochs) {
      require(epoch.newest <= epoch.end && epoch.begun <= epoch.heard && epoch.end < cuts.size());
    }
    if (epochs.empty() && finder.single() == cuts.size()) {
      return;
    }
  }
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  constexpr std::size_t HEAD = 12;
  if (size < HEAD) {
    return 0;
  }
  const std::size_t prefix = data[0] & 1 ? 8 : 0;
  Bytes stream(data + HEAD, data + size);
  if (data[0] & 2) {
    mend(&stream);
  }
  const Parser whole = parsed(stream, prefix, data, 0), pieces = parsed(stream, prefix, data + 1, 5);
  require(whole.cuts.size() == pieces.cuts.size() && whole.skipped == pieces.skipped &&
          whole.dropped == pieces.dropped);
  for (std::size_t i = 0; i < whole.cuts.size(); ++i) {
    require(same(whole.cuts[i], pieces.cuts[i]));
  }
  find_epochs(stream, whole.cuts, data + 6);
  return 0;
}
