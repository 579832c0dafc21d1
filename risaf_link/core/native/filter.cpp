// The filter, its aiding, and the step from readings to attitude, for Python.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <optional>

#include "aiding.hpp"
#include "eskf.hpp"
#include "estimator.hpp"
#include "mean.hpp"
#include "median.hpp"
#include "module.hpp"
#include "risaf.hpp"
#include "robust.hpp"

using namespace nb::literals;

namespace {

using risaf::Aiding;
using risaf::Eskf;
using risaf::FilterNumbers;
using risaf::SpeedTracker;
using risaf::Vector;

template <typename... Shape>
using Floats = nb::ndarray<const double, Shape..., nb::c_contig, nb::device::cpu>;
using Three = Floats<nb::shape<3>>;
using ByErrors = Floats<nb::shape<3, 12>>;
using Told = std::vector<std::tuple<double, double, double, bool, int, int>>;

Vector vector(const Three& v) { return {v.data()[0], v.data()[1], v.data()[2]}; }

FilterNumbers numbers(const nb::dict& told) {
  FilterNumbers c;
#define RISAF_TAKE(name) c.name = nb::cast<double>(told[#name]);
  RISAF_FILTER_NUMBERS(RISAF_TAKE)
#undef RISAF_TAKE
  c.HISTORY = nb::cast<std::size_t>(told["HISTORY"]);
  c.PARTS = nb::cast<std::size_t>(told["PARTS"]);
  c.QUIET = nb::cast<std::array<double, 6>>(told["QUIET"]);
  c.LOOSE = nb::cast<std::array<double, 6>>(told["LOOSE"]);
  c.STRICT = nb::cast<std::array<double, 6>>(told["STRICT"]);
  return c;
}

nb::tuple told(const risaf::Correction& c) {
  return nb::make_tuple(c.value, c.variance, c.gate, c.reset, static_cast<int>(c.source),
                        static_cast<int>(c.outcome));
}

nb::list told(const risaf::Corrections& corrections) {
  nb::list all;
  for (const risaf::Correction& correction : corrections) {
    all.append(told(correction));
  }
  return all;
}

nb::object compare_heading(const Eskf& filter, double heading, double variance, double age,
                           double gate) {
  risaf::Correction compared;
  if (!filter.compare_heading(heading, variance, age, gate, compared)) {
    return nb::none();
  }
  return told(compared);
}

void predict(Eskf& filter, const Three& rate, const Three& noise, const Three& bias_walk,
             double dt) {
  risaf::FusedAxis fused[3];
  for (std::size_t k = 0; k < 3; ++k) {
    fused[k] = {rate.data()[k], risaf::NaN, noise.data()[k], bias_walk.data()[k], 0};
  }
  filter.predict(fused, dt);
}

nb::list correct_gravity(Eskf& filter, const Three& gravity_n, double forward, double right,
                         double down, const ByErrors& lever, const ByErrors& by_errors) {
  risaf::Gravity gravity{vector(gravity_n), forward, right, down, {}, {}};
  for (std::size_t i = 0; i < 3; ++i) {
    std::copy_n(lever.data() + 12 * i, 12, gravity.lever[i].begin());
    std::copy_n(by_errors.data() + 12 * i, 12, gravity.by_errors[i].begin());
  }
  return told(filter.correct_gravity(gravity));
}

Array<double> covariance(const Eskf& filter) {
  auto* values = new double[risaf::STATES * risaf::STATES];
  for (std::size_t i = 0; i < risaf::STATES; ++i) {
    for (std::size_t j = 0; j < risaf::STATES; ++j) {
      values[risaf::STATES * i + j] = filter.covariance(i, j);
    }
  }
  return owned(values, {risaf::STATES, risaf::STATES});
}

// q_nb, rate, bias, standard deviations of the angles, their covariances, aligned, resets, standard
// deviations of the bias.
nb::tuple state(const Eskf& filter) {
  const auto [w, x, y, z] = filter.attitude();
  const Vector &rate = filter.rate(), &bias = filter.bias();
  const auto [std, common] = filter.angle_spread();
  return nb::make_tuple(owned(new double[4]{w, x, y, z}, {4}),
                        owned(new double[3]{rate[0], rate[1], rate[2]}, {3}),
                        owned(new double[3]{bias[0], bias[1], bias[2]}, {3}), std, common,
                        filter.aligned(), filter.resets(), filter.bias_std());
}

// Errors (26,), latitude, aligned, levelled, resting: with `state`, `FilterMemory` of memory.py.
nb::tuple memory(const Eskf& filter) {
  const auto errors = filter.errors();
  auto* values = new double[errors.size()];
  std::copy(errors.begin(), errors.end(), values);
  return nb::make_tuple(owned(values, {errors.size()}), filter.latitude(), filter.aligned(),
                        filter.levelled(), filter.resting());
}

void recall(Eskf& filter, const Floats<nb::shape<4>>& q_nb, const Three& rate_b,
            const Floats<nb::shape<26>>& errors, const Floats<nb::shape<29, 29>>& covariance,
            double latitude, bool aligned, bool levelled, int resets) {
  const double* q = q_nb.data();
  filter.set_attitude({q[0], q[1], q[2], q[3]});
  filter.set_covariance(covariance.data());
  filter.recall(vector(rate_b), errors.data(), latitude, aligned, levelled, resets);
}

constexpr std::size_t MANY = 8;  // epochs; for fewer others can wait
constexpr std::size_t COLUMNS = sizeof(risaf::Known) / sizeof(double);
using Known = nb::ndarray<double, nb::shape<-1, COLUMNS>, nb::c_contig, nb::device::cpu>;

// The caller's array takes what becomes known: one made here would take longer than an epoch does.
template <typename Fusion>
void advance(Fusion& gyros, risaf::Robust& accelerometers, Eskf& filter, Aiding& aiding,
             const Floats<nb::shape<-1>>& dt, const Floats<nb::shape<-1, -1, 3>>& rates_b,
             const Floats<nb::shape<-1, -1, 3>>& forces_b, const Known& known) {
  const std::size_t epochs = dt.shape(0);
  if (rates_b.shape(0) != epochs || forces_b.shape(0) != epochs || known.shape(0) != epochs) {
    throw nb::value_error("dt, rates_b, forces_b, known: found different lengths, expected one");
  }
  std::optional<nb::gil_scoped_release> others_may_run;
  if (epochs >= MANY) {
    others_may_run.emplace();
  }
  risaf::advance(gyros, accelerometers, filter, aiding, epochs, dt.data(), rates_b.data(),
                 rates_b.shape(1), forces_b.data(), forces_b.shape(1),
                 reinterpret_cast<risaf::Known*>(known.data()));
}

// One epoch of n gyros. To take readings out of bytes, and give a row of a track so, costs less than
// arrays do.
template <typename Fusion>
nb::bytes advance_one(Fusion& gyros, risaf::Robust& accelerometers, Eskf& filter, Aiding& aiding,
                      double dt, const nb::bytes& readings, std::size_t n) {
  const std::size_t sensors = readings.size() / (3 * sizeof(double));
  if (sensors < n || readings.size() % (3 * sizeof(double)) != 0) {
    throw nb::value_error("readings: found fewer than of all gyros, or a part of one");
  }
  const auto* rates_b = static_cast<const double*>(readings.data());
  nb::bytes row(nullptr, sizeof(risaf::Known));
  risaf::advance(gyros, accelerometers, filter, aiding, 1, &dt, rates_b, n, rates_b + 3 * n,
                 sensors - n, static_cast<risaf::Known*>(const_cast<void*>(row.data())));
  return row;
}

template <typename Fusion>
void bind_advance(nb::module_& m) {
  m.def("advance", &advance<Fusion>, "gyros"_a, "accelerometers"_a, "attitude"_a, "aiding"_a, "dt"_a,
        "rates_b"_a, "forces_b"_a, "known"_a.noconvert());
  m.def("advance_one", &advance_one<Fusion>, "gyros"_a, "accelerometers"_a, "attitude"_a, "aiding"_a,
        "dt"_a, "readings"_a, "n"_a);
}

}  // namespace

void bind_filter(nb::module_& m) {
  nb::class_<FilterNumbers>(m, "FilterNumbers").def("__init__", [](FilterNumbers* self, const nb::dict& told) {
    new (self) FilterNumbers(numbers(told));
  });

  nb::class_<Eskf>(m, "Eskf")
      .def(nb::init<const FilterNumbers&>())
      .def("configure", &Eskf::configure)
      .def("set_latitude", &Eskf::set_latitude)
      .def("set_attitude", [](Eskf& filter, const std::array<double, 4>& q) {
        filter.set_attitude({q[0], q[1], q[2], q[3]});
      })
      .def("set_covariance", [](Eskf& filter, const Floats<nb::shape<29, 29>>& covariance) {
        filter.set_covariance(covariance.data());
      })
      .def("memory", &memory)
      .def("recall", &recall)
      .def("predict", &predict)
      .def("compare_heading", &compare_heading)
      .def("correct_heading", [](Eskf& filter, double heading, double variance, double age, double gate) {
        return told(filter.correct_heading(heading, variance, age, gate));
      })
      .def("reset_heading", [](Eskf& filter, double heading, double variance, double age, double gate) {
        return told(filter.reset_heading(heading, variance, age, gate));
      })
      .def("correct_gravity", &correct_gravity)
      .def("doubt_bias", &Eskf::doubt_bias, "rate"_a)
      .def("correct_zero_rate", [](Eskf& filter, const Three& rate, const Three& variance, bool confirmed) {
        return told(filter.correct_zero_rate(vector(rate), vector(variance), confirmed));
      })
      .def("state", &state)
      .def("covariance", &covariance)
      .def_prop_ro("wrong", &Eskf::wrong);

  nb::class_<SpeedTracker>(m, "SpeedTracker")
      .def(nb::init<const FilterNumbers&>())
      .def("advance", &SpeedTracker::advance, "dt"_a)
      .def("hear", &SpeedTracker::hear, "speed"_a, "variance"_a, "age"_a)
      .def("turn_round", &SpeedTracker::turn_round)
      .def_ro("speed", &SpeedTracker::speed)
      .def_ro("acceleration", &SpeedTracker::acceleration)
      .def_ro("speed_variance", &SpeedTracker::speed_variance)
      .def_prop_ro("recent", &SpeedTracker::recent);

  nb::class_<Aiding>(m, "Aiding")
      .def(nb::init<const FilterNumbers&>())
      .def_prop_ro("speed", [](Aiding& aiding) { return &aiding.speed; }, nb::rv_policy::reference_internal)
      .def("take", [](Aiding& aiding, Eskf& filter, const Three& rate_b, const Three& force_b, double dt) {
        return told(aiding.take(filter, vector(rate_b), vector(force_b), dt));
      });

  bind_advance<risaf::Mean>(m);
  bind_advance<risaf::Median>(m);
  bind_advance<risaf::Robust>(m);
  bind_advance<risaf::Risaf>(m);
}
