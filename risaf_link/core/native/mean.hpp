// `Mean` of fusion.py.
#pragma once

#include <cstddef>
#include <cstdint>

#include "readings.hpp"

namespace risaf {

class Mean {
 public:
  Mean(double gyro_noise, double bias_walk) : sensor_{gyro_noise, bias_walk} {}

  // Take new parameters; what was learnt stays.
  void configure(double gyro_noise, double bias_walk) { sensor_ = {gyro_noise, bias_walk}; }

  const Readings& readings() const { return now_; }

  // Fuse readings (n, 3); returns how many sensors are valid on all axes.
  RISAF_FAST std::int64_t fuse(double dt, const double* readings, std::size_t n, FusedAxis* fused) {
    const std::int64_t whole = now_.take(dt, readings, n);
    for (std::size_t k = 0; k < 3; ++k) {
      fused[k] = sensor_.mean_of_active(dt, now_.rates[k], now_.valid[k], now_.length());
    }
    return whole;
  }

 private:
  OneSensor sensor_;
  Readings now_;
};

}  // namespace risaf
