// The kernel as a Python module.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/vector.h>

#include "module.hpp"
#include "risaf.hpp"
#include "robust.hpp"

using namespace nb::literals;

namespace {

using Readings = nb::ndarray<const double, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
template <typename Fusion>
nb::tuple fuse(Fusion& fusion, double dt, const Readings& readings) {
  risaf::FusedAxis fused[3];
  const std::int64_t valid = fusion.fuse(dt, readings.data(), readings.shape(0), fused);
  auto* values = new double[12];
  auto* active = new std::int64_t[3];
  for (std::size_t k = 0; k < 3; ++k) {
    values[k] = fused[k].rate;
    values[3 + k] = fused[k].variance;
    values[6 + k] = fused[k].noise;
    values[9 + k] = fused[k].bias_walk;
    active[k] = fused[k].active;
  }
  return nb::make_tuple(owned(values, {4, 3}), owned(active, {3}), valid);
}

// What is remembered of each channel under a name, shape (3, n).
template <typename T>
Array<double> channels(const risaf::Robust& robust, std::vector<T> risaf::Robust::Axis::*member) {
  const std::size_t n = robust.sensors();
  auto* values = new double[3 * n];
  for (std::size_t k = 0; k < 3; ++k) {
    const auto& channel = robust.axis(k).*member;
    std::copy(channel.begin(), channel.end(), values + k * n);
  }
  return owned(values, {3, n});
}

// All that is remembered, by the names of `Channels`.
nb::dict all_channels(const risaf::Robust& robust) {
  using Axis = risaf::Robust::Axis;
  nb::dict all;
  all["reading"] = channels(robust, &Axis::reading);
  all["count"] = channels(robust, &Axis::count);
  all["residual"] = channels(robust, &Axis::residual);
  all["bias"] = channels(robust, &Axis::bias);
  all["age"] = channels(robust, &Axis::age);
  all["slow"] = channels(robust, &Axis::slow);
  all["rejected"] = channels(robust, &Axis::rejected);
  all["unchanged"] = channels(robust, &Axis::unchanged);
  all["moved"] = channels(robust, &Axis::moved);
  all["frozen"] = channels(robust, &Axis::frozen);
  all["silent"] = channels(robust, &Axis::silent);
  all["calm"] = channels(robust, &Axis::calm);
  all["out"] = channels(robust, &Axis::out);
  all["outlying"] = channels(robust, &Axis::outlying);
  all["wandering"] = channels(robust, &Axis::wandering);
  return all;
}

Array<double> relative_bias(const risaf::Risaf& fusion) {
  const std::size_t n = fusion.sensors();
  auto* values = new double[3 * n];
  for (std::size_t k = 0; k < 3; ++k) {
    const auto& bias = fusion.relative_bias(k);
    std::copy(bias.begin(), bias.end(), values + k * n);
  }
  return owned(values, {3, n});
}

}  // namespace

void bind_frames(nb::module_& m);

NB_MODULE(_kernel, m) {
  bind_frames(m);

  nb::class_<risaf::RobustParameters> parameters(m, "RobustParameters");
  parameters.def(nb::init<>());
  const auto field = [&parameters](const char* name, double risaf::RobustParameters::*member) {
    parameters.def_rw(name, member);
  };
  field("gate", &risaf::RobustParameters::gate);
  field("bias_time", &risaf::RobustParameters::bias_time);
  field("hold_time", &risaf::RobustParameters::hold_time);
  field("resolution", &risaf::RobustParameters::resolution);
  field("scale_error", &risaf::RobustParameters::scale_error);
  field("gyro_noise", &risaf::RobustParameters::gyro_noise);
  field("bias_walk", &risaf::RobustParameters::bias_walk);
  field("limit", &risaf::RobustParameters::limit);
  field("longest", &risaf::RobustParameters::longest);
  field("watch_time", &risaf::RobustParameters::watch_time);
  field("burst_time", &risaf::RobustParameters::burst_time);
  field("burst", &risaf::RobustParameters::burst);
  field("swell", &risaf::RobustParameters::swell);
  field("noise_time", &risaf::RobustParameters::noise_time);
  field("spread_time", &risaf::RobustParameters::spread_time);
  field("frozen_after", &risaf::RobustParameters::frozen_after);
  field("silent_after", &risaf::RobustParameters::silent_after);
  field("relearn", &risaf::RobustParameters::relearn);
  field("tiny", &risaf::RobustParameters::tiny);
  field("least_white", &risaf::RobustParameters::least_white);
  field("prior", &risaf::RobustParameters::prior);
  parameters.def_rw("mad_factors", &risaf::RobustParameters::mad_factors);

  nb::class_<risaf::Risaf>(m, "Risaf")
      .def(nb::init<double, double, double, double, double>(), "alpha"_a, "lower_quantile"_a,
           "upper_quantile"_a, "gyro_noise"_a, "bias_walk"_a)
      .def("fuse", &fuse<risaf::Risaf>, "dt"_a, "readings"_a)
      .def("relative_bias", &relative_bias);

  nb::class_<risaf::Robust>(m, "Robust")
      .def(nb::init<risaf::RobustParameters>())
      .def("fuse", &fuse<risaf::Robust>, "dt"_a, "readings"_a)
      .def("channels", &all_channels)
      .def("trusted", [](const risaf::Robust& robust) {
        return channels(robust, &risaf::Robust::Axis::trusted);
      });

  bind_filter(m);
}
