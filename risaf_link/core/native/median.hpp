// `Median` of fusion.py.
#pragma once

#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>

#include "readings.hpp"
#include "select.hpp"

namespace risaf {

class Median {
 public:
  Median(double gyro_noise, double bias_walk, double mad_to_std)
      : sensor_{gyro_noise, bias_walk}, mad_to_std_(mad_to_std) {}

  // Take new parameters; what was learnt stays.
  void configure(double gyro_noise, double bias_walk) { sensor_ = {gyro_noise, bias_walk}; }

  const Readings& readings() const { return now_; }

  // Fuse readings (n, 3); returns how many sensors are valid on all axes.
  RISAF_FAST std::int64_t fuse(double dt, const double* readings, std::size_t n, FusedAxis* fused) {
    const std::int64_t whole = now_.take(dt, readings, n);
    values_.resize(now_.length());
    for (std::size_t k = 0; k < 3; ++k) {
      fused[k] = fuse_axis(dt, now_.rates[k], now_.valid[k], medians_[k], deviations_[k]);
    }
    return whole;
  }

 private:
  FusedAxis fuse_axis(double dt, const Row& rates, const Row& valid, Selection& medians,
                      Selection& deviations) {
    const std::size_t length = now_.length();
    const std::size_t n = count(length, [&](std::size_t i) { return valid[i] > 0.0; });
    if (n == 0) {
      return sensor_.fused(dt, NaN, NaN, 0.0);
    }
    RISAF_EACH
    for (std::size_t i = 0; i < length; ++i) {
      values_[i] = where(valid[i] > 0.0, rates[i], INFINITE);
    }
    const double median = medians.quantile(values_.data(), length, n, 0.5);
    RISAF_EACH
    for (std::size_t i = 0; i < length; ++i) {
      values_[i] = std::abs(values_[i] - median);
    }
    const double deviation = mad_to_std_ * deviations.quantile(values_.data(), length, n, 0.5);
    const double variance = n > 1 ? deviation * deviation : NaN;
    return sensor_.fused(dt, median, variance, static_cast<double>(n));
  }

  OneSensor sensor_;
  double mad_to_std_;
  Readings now_;
  std::array<Selection, 3> medians_, deviations_;
  Row values_;  // on their way to a median
};

}  // namespace risaf
