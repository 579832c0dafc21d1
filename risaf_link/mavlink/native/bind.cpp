// What reads frames, as a part of the kernel's Python module.
#include <nanobind/nanobind.h>
#include <nanobind/stl/map.h>

#include <map>

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
    const auto [rest, follows] = search.cut(done, in_step);
    summed += search.summed;
    const auto& dropped = search.dropped;
    return nb::make_tuple(
        nb::bytes(search.cuts.data(), search.cuts.size() * sizeof(risaf::Cut)), search.keep, rest,
        follows, search.skipped, nb::make_tuple(dropped[0], dropped[1], dropped[2], dropped[3]));
  }

 private:
  risaf::Search::Extras extras_;
};

}  // namespace

void bind_frames(nb::module_& m) {
  nb::class_<Cutter>(m, "Cutter")
      .def(nb::init<const std::map<std::uint32_t, std::uint8_t>&>(), "extras"_a)
      .def_ro("summed", &Cutter::summed)
      .def("cut", &Cutter::cut, "buffer"_a, "prefix_size"_a, "done"_a, "in_step"_a, "ended"_a);
}
