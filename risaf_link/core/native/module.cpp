// The kernel as a Python module.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/vector.h>

#include "mean.hpp"
#include "median.hpp"
#include "module.hpp"
#include "risaf.hpp"
#include "robust.hpp"

using namespace nb::literals;

namespace {

using Readings = nb::ndarray<const double, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using Values = nb::ndarray<double, nb::shape<4, 3>, nb::c_contig, nb::device::cpu>;
using Active = nb::ndarray<std::int64_t, nb::shape<3>, nb::c_contig, nb::device::cpu>;

// Fuse into the caller's values (4, 3), rows as of FusedAxis, and active (3,); how many sensors are
// valid on all axes.
template <typename Fusion>
std::int64_t fuse(Fusion& fusion, double dt, const Readings& readings, const Values& values,
                  const Active& active) {
  risaf::FusedAxis fused[3];
  const std::int64_t valid = fusion.fuse(dt, readings.data(), readings.shape(0), fused);
  for (std::size_t k = 0; k < 3; ++k) {
    values.data()[k] = fused[k].rate;
    values.data()[3 + k] = fused[k].variance;
    values.data()[6 + k] = fused[k].noise;
    values.data()[9 + k] = fused[k].bias_walk;
    active.data()[k] = fused[k].active;
  }
  return valid;
}

// The first n of each axis' row, shape (3, n).
template <typename RowOf>
Array<double> by_axis(std::size_t n, RowOf row) {
  auto* values = new double[3 * n];
  for (std::size_t k = 0; k < 3; ++k) {
    std::copy_n(row(k).begin(), n, values + k * n);
  }
  return owned(values, {3, n});
}

// State, reason and share of rejected readings of each sensor, (n,), and its bias, (n, 3).
nb::tuple health(const risaf::Robust& robust) {
  const std::size_t n = robust.sensors();
  auto *state = new std::int8_t[n], *reason = new std::int8_t[n];
  auto *rejected = new double[n], *bias = new double[3 * n];
  robust.health(state, reason, rejected, bias);
  return nb::make_tuple(owned(state, {n}), owned(reason, {n}), owned(rejected, {n}),
                        owned(bias, {n, 3}));
}

// Channels (5, 3, n), axes (6, 3), elapsed, calm: `ArrayMemory` of memory.py.
nb::tuple memory(const risaf::Robust& robust) {
  const std::size_t n = robust.sensors();
  constexpr std::size_t rows = risaf::Robust::CHANNELS.size(), values = risaf::Robust::AXES.size();
  auto *channels = new double[rows * 3 * n], *axes = new double[values * 3];
  robust.tell(channels, axes);
  return nb::make_tuple(owned(channels, {rows, 3, n}), owned(axes, {values, 3}), robust.elapsed(),
                        robust.calm());
}

using Channels = nb::ndarray<const double, nb::shape<5, 3, -1>, nb::c_contig, nb::device::cpu>;
using Axes = nb::ndarray<const double, nb::shape<6, 3>, nb::c_contig, nb::device::cpu>;

void recall(risaf::Robust& robust, const Channels& channels, const Axes& axes, double elapsed,
            double calm) {
  robust.recall(channels.shape(2), channels.data(), axes.data(), elapsed, calm);
}

Array<double> relative_bias(const risaf::Risaf& fusion) {
  return by_axis(fusion.readings().sensors,
                 [&](std::size_t k) -> const risaf::Row& { return fusion.relative_bias(k); });
}

// For how long each sensor has been silent, shape (n,).
template <typename Fusion>
Array<double> silent_for(const Fusion& fusion) {
  const std::size_t n = fusion.readings().sensors;
  auto* values = new double[n];
  std::copy_n(fusion.readings().silent_for.begin(), n, values);
  return owned(values, {n});
}

// What every fusion can do.
template <typename Fusion>
nb::class_<Fusion> fusion(nb::module_& m, const char* name) {
  return nb::class_<Fusion>(m, name).def("fuse", &fuse<Fusion>, "dt"_a, "readings"_a,
                                         "values"_a.noconvert(), "active"_a.noconvert());
}

}  // namespace

NB_MODULE(_kernel, m) {
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
  field("repeated_after", &risaf::RobustParameters::repeated_after);
  field("many", &risaf::RobustParameters::many);
  field("silent_after", &risaf::RobustParameters::silent_after);
  field("dead_after", &risaf::RobustParameters::dead_after);
  field("relearn", &risaf::RobustParameters::relearn);
  field("tiny", &risaf::RobustParameters::tiny);
  field("least_white", &risaf::RobustParameters::least_white);
  field("prior", &risaf::RobustParameters::prior);
  parameters.def_rw("mad_factors", &risaf::RobustParameters::mad_factors);

  fusion<risaf::Mean>(m, "Mean")
      .def(nb::init<double, double>(), "gyro_noise"_a, "bias_walk"_a)
      .def("configure", &risaf::Mean::configure, "gyro_noise"_a, "bias_walk"_a)
      .def("silent_for", &silent_for<risaf::Mean>);
  fusion<risaf::Median>(m, "Median")
      .def(nb::init<double, double, double>(), "gyro_noise"_a, "bias_walk"_a, "mad_to_std"_a)
      .def("configure", &risaf::Median::configure, "gyro_noise"_a, "bias_walk"_a)
      .def("silent_for", &silent_for<risaf::Median>);
  fusion<risaf::Risaf>(m, "Risaf")
      .def(nb::init<double, double, double, double, double>(), "alpha"_a, "lower_quantile"_a,
           "upper_quantile"_a, "gyro_noise"_a, "bias_walk"_a)
      .def("configure", &risaf::Risaf::configure, "alpha"_a, "lower_quantile"_a,
           "upper_quantile"_a, "gyro_noise"_a, "bias_walk"_a)
      .def("silent_for", &silent_for<risaf::Risaf>)
      .def("relative_bias", &relative_bias);
  fusion<risaf::Robust>(m, "Robust")
      .def(nb::init<risaf::RobustParameters>())
      .def("configure", &risaf::Robust::configure, "parameters"_a)
      .def("health", &health)
      .def("memory", &memory)
      .def("recall", &recall);

  bind_filter(m);
  bind_frames(m);
}
