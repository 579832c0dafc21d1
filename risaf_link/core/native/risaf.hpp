// The step of `Risaf` in fusion.py, eq. 5 to 8, whose text says what is done; names are the same.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>

#include "readings.hpp"
#include "select.hpp"

namespace risaf {

class Risaf {
 public:
  Risaf(double alpha, double lower, double upper, double gyro_noise, double bias_walk) {
    configure(alpha, lower, upper, gyro_noise, bias_walk);
  }

  // Take new parameters; what was learnt stays.
  void configure(double alpha, double lower, double upper, double gyro_noise, double bias_walk) {
    alpha_ = alpha;
    lower_ = lower;
    upper_ = upper;
    sensor_ = {gyro_noise, bias_walk};
  }

  const Readings& readings() const { return now_; }
  const Row& relative_bias(std::size_t axis) const { return axes_[axis].relative_bias; }

  // Fuse readings (n, 3); returns how many sensors are valid on all axes.
  RISAF_FAST std::int64_t fuse(double dt, const double* readings, std::size_t n, FusedAxis* fused) {
    if (n != now_.sensors) {
      resize(n);
    }
    const std::int64_t whole = now_.take(dt, readings, n);
    for (std::size_t k = 0; k < 3; ++k) {
      fused[k] = fuse_axis(dt, now_.rates[k], now_.valid[k], axes_[k]);
    }
    return whole;
  }

 private:
  struct Axis {
    Row relative_bias;
    Selection lower, upper;
  };

  // Forget the last sensors, or add some without a bias.
  [[gnu::noinline]] void resize(std::size_t n) {
    for (Axis& axis : axes_) {
      axis.relative_bias.resize(std::min(n, now_.sensors));
      axis.relative_bias.resize(padded(n), 0.0);
    }
    corrected_.resize(padded(n));
    active_.resize(padded(n));
  }

  FusedAxis fuse_axis(double dt, const Row& rates, const Row& valid, Axis& axis) {
    const std::size_t length = now_.length();
    const std::size_t n = count(length, [&](std::size_t i) { return valid[i] > 0.0; });
    if (n == 0) {
      return sensor_.fused(dt, NaN, NaN, 0.0);
    }
    const double mean =
        sum(length, [&](std::size_t i) { return where(valid[i] > 0.0, rates[i], 0.0); }) /
        static_cast<double>(n);
    const double alpha = alpha_;
    Row& bias = axis.relative_bias;
    RISAF_EACH
    for (std::size_t i = 0; i < length; ++i) {
      const double tracked = alpha * bias[i] + (1.0 - alpha) * (rates[i] - mean);  // eq. 5
      bias[i] = where(valid[i] > 0.0, tracked, bias[i]);
      corrected_[i] = where(valid[i] > 0.0, rates[i] - bias[i], INFINITE);
    }
    const double lower = axis.lower.quantile(corrected_.data(), length, n, lower_);
    const double upper = axis.upper.quantile(corrected_.data(), length, n, upper_);
    RISAF_EACH
    for (std::size_t i = 0; i < length; ++i) {  // eq. 6
      active_[i] = where((lower <= corrected_[i]) & (corrected_[i] <= upper), valid[i], 0.0);
    }
    const bool none = count(length, [&](std::size_t i) { return active_[i] > 0.0; }) == 0;
    return sensor_.mean_of_active(dt, corrected_, none ? valid : active_, length);  // eq. 7 and 8
  }

  double alpha_, lower_, upper_;
  OneSensor sensor_;
  Readings now_;
  std::array<Axis, 3> axes_;
  Row corrected_, active_;  // of one axis
};

}  // namespace risaf
