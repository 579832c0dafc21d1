// What reads frames, as a part of the kernel's Python module.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/map.h>
#include <nanobind/stl/vector.h>

#include <map>
#include <optional>
#include <vector>

#include "epochs.hpp"
#include "frames.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

const std::uint8_t* data(const nb::bytes& bytes) {
  return static_cast<const std::uint8_t*>(bytes.data());
}

// `cut` in frame.py, for the messages that are known.
class Cutter {
 public:
  std::size_t summed = 0;  // bytes that went through a checksum

  explicit Cutter(const std::map<std::uint32_t, std::uint8_t>& extras)
      : extras_(extras.empty() ? 0 : extras.rbegin()->first + 1, -1) {
    for (const auto& [message_id, extra] : extras) {
      extras_[message_id] = extra;
    }
  }

  nb::tuple cut(const nb::bytes& buffer, std::size_t prefix_size, std::size_t done, bool in_step,
                bool ended) {
    risaf::Search search(extras_, data(buffer), buffer.size(), prefix_size, ended);
    std::optional<nb::gil_scoped_release> others_may_run;
    if (buffer.size() >= LONG) {
      others_may_run.emplace();
    }
    const auto [rest, follows] = search.cut(done, in_step);
    others_may_run.reset();
    summed += search.summed;
    const auto& dropped = search.dropped;
    return nb::make_tuple(
        nb::bytes(search.cuts.data(), search.cuts.size() * sizeof(risaf::Cut)), search.keep, rest,
        follows, search.skipped, nb::make_tuple(dropped[0], dropped[1], dropped[2], dropped[3]));
  }

  // The frames of which bytes consist; none if there is anything else in them.
  std::vector<risaf::Cut> frames(const nb::bytes& bytes) const {
    risaf::Search search(extras_, data(bytes), bytes.size(), 0, false);
    const auto [rest, follows] = search.cut(0, true);
    const bool is_all = follows && search.keep + rest == bytes.size() && search.skipped == 0 &&
                        search.dropped == decltype(search.dropped){};
    return is_all ? std::move(search.cuts) : std::vector<risaf::Cut>{};
  }

 private:
  static constexpr std::size_t LONG = 1 << 16;  // bytes; with fewer others can wait

  risaf::Search::Extras extras_;
};

template <typename T>
using Column = nb::ndarray<const T, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

// Whole epochs out of a table, as block.py wants them.
class EpochFinder {
 public:
  EpochFinder(std::vector<std::uint8_t> kinds, std::uint32_t info_id, std::int64_t jump_us,
              std::uint64_t patience_us)
      : finder_(std::move(kinds), info_id, jump_us, patience_us) {}

  void load(nb::bytes buffer, nb::bytes records, const Column<std::uint64_t>& times_us) {
    if (records.size() != times_us.shape(0) * sizeof(risaf::Cut)) {
      throw nb::value_error("records: not as many as times");
    }
    times_us_.assign(times_us.data(), times_us.data() + times_us.shape(0));
    load_timed(std::move(buffer), std::move(records));
  }

  // Frames that were received all at once.
  void load_at_once(nb::bytes buffer, nb::bytes records, std::uint64_t time_us) {
    times_us_.assign(records.size() / sizeof(risaf::Cut), time_us);
    load_timed(std::move(buffer), std::move(records));
  }

  // Of the columns of an EpochBlock, first times and arrivals, int64, then what is double.
  nb::object take(const risaf::ArrayLayout& array, std::int64_t time_us, std::uint16_t sequence,
                  std::uint64_t heard_us, std::size_t most) {
    risaf::Clock clock{time_us, sequence};
    const auto& epochs = finder_.take(array, &clock, heard_us, most);
    const std::size_t size = epochs.size();
    if (size == 0) {
      return nb::none();
    }
    const std::size_t rates = 3 * size * array.gyros.count, forces = 3 * size * array.accels.count;
    nb::bytes columns(nullptr, sizeof(double) * (3 * size + rates + forces));
    auto* times = reinterpret_cast<std::int64_t*>(const_cast<void*>(columns.data()));
    auto* dt = reinterpret_cast<double*>(times + 2 * size);
    for (std::size_t i = 0; i < size; ++i) {
      times[i] = epochs[i].time_us;
      times[size + i] = static_cast<std::int64_t>(times_us_[epochs[i].end]);
      dt[i] = static_cast<double>(epochs[i].time_us - time_us) / 1e6;
      time_us = epochs[i].time_us;
    }
    const auto of_gyros = finder_.read(array.gyros, true, dt + size);
    const auto of_accels = finder_.read(array.accels, false, dt + size + rates);
    nb::list asides;
    for (const auto& aside : finder_.asides()) {
      asides.append(nb::make_tuple(aside.row, aside.before));
    }
    const auto& last = epochs.back();
    const auto came_us = [this](std::size_t row) { return times_us_[row]; };
    return nb::make_tuple(size, columns,
                          nb::make_tuple(came_us(last.newest), came_us(last.begun),
                                         came_us(last.heard)),
                          last.end, clock.sequence,
                          nb::make_tuple(of_gyros.invalid + of_accels.invalid,
                                         of_gyros.saturated + of_accels.saturated),
                          finder_.refused(), asides);
  }

  std::size_t single() { return finder_.single(); }

  // The array's next epoch, if frames bring that and nothing else: its time, dt, and the readings of
  // gyros and accelerometers, double. None: they do not. The table is given up.
  nb::object next(const Cutter& cutter, const nb::bytes& frames, const risaf::ArrayLayout& array,
                  std::int64_t time_us, std::uint16_t sequence) {
    const auto cuts = cutter.frames(frames);
    times_us_.assign(cuts.size(), 0);
    finder_.load(data(frames), cuts.data(), times_us_.data(), cuts.size());
    risaf::Clock clock{time_us, sequence};
    const auto& epochs = finder_.take(array, &clock, 0, 1);
    nb::object found = nb::none();
    if (epochs.size() == 1 && finder_.chunks() == cuts.size()) {
      const std::size_t rates = 3 * array.gyros.count, forces = 3 * array.accels.count;
      nb::bytes readings(nullptr, sizeof(double) * (rates + forces));
      auto* values = static_cast<double*>(const_cast<void*>(readings.data()));
      finder_.read(array.gyros, true, values);
      finder_.read(array.accels, false, values + rates);
      const std::int64_t now_us = epochs[0].time_us;
      found = nb::make_tuple(now_us, static_cast<double>(now_us - time_us) / 1e6, readings);
    }
    finder_.load(nullptr, nullptr, nullptr, 0);
    return found;
  }

 private:
  void load_timed(nb::bytes buffer, nb::bytes records) {
    finder_.load(data(buffer), reinterpret_cast<const risaf::Cut*>(data(records)), times_us_.data(),
                 times_us_.size());
    buffer_ = std::move(buffer);
    records_ = std::move(records);
  }

  risaf::EpochFinder finder_;
  nb::object buffer_, records_;
  std::vector<std::uint64_t> times_us_;
};

}  // namespace

void bind_frames(nb::module_& m) {
  nb::class_<Cutter>(m, "Cutter")
      .def(nb::init<const std::map<std::uint32_t, std::uint8_t>&>(), "extras"_a)
      .def_ro("summed", &Cutter::summed)
      .def("cut", &Cutter::cut, "buffer"_a, "prefix_size"_a, "done"_a, "in_step"_a, "ended"_a);

  nb::class_<risaf::Sensors>(m, "Sensors")
      .def(nb::init<std::size_t, double, double>(), "count"_a, "scale"_a, "limit"_a);
  nb::class_<risaf::ArrayLayout>(m, "ArrayLayout")
      .def("__init__",
           [](risaf::ArrayLayout* self, std::uint8_t system, std::uint8_t component,
              std::uint8_t array_id, risaf::Sensors gyros, risaf::Sensors accels, nb::bytes told) {
             const auto* begin = data(told);
             new (self) risaf::ArrayLayout{system, component, array_id, gyros, accels,
                                           {begin, begin + told.size()}};
           },
           "system"_a, "component"_a, "array_id"_a, "gyros"_a, "accels"_a, "told"_a);
  nb::class_<EpochFinder>(m, "EpochFinder")
      .def(nb::init<std::vector<std::uint8_t>, std::uint32_t, std::int64_t, std::uint64_t>(),
           "kinds"_a, "info_id"_a, "jump_us"_a, "patience_us"_a)
      .def("load", &EpochFinder::load, "buffer"_a, "records"_a, "times_us"_a)
      .def("load", &EpochFinder::load_at_once, "buffer"_a, "records"_a, "time_us"_a)
      .def("take", &EpochFinder::take, "array"_a, "time_us"_a, "sequence"_a,
           "heard_us"_a, "most"_a)
      .def("single", &EpochFinder::single)
      .def("next", &EpochFinder::next, "cutter"_a, "frames"_a, "array"_a, "time_us"_a,
           "sequence"_a);
}
