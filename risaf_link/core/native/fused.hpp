// What every fusion gives.
#pragma once

#include <cstdint>
#include <limits>

namespace risaf {

constexpr double NaN = std::numeric_limits<double>::quiet_NaN();
constexpr double INFINITE = std::numeric_limits<double>::infinity();

// One axis of the rate of an array; what `FusedRate` holds.
struct FusedAxis {
  double rate, variance, noise, bias_walk;
  std::int64_t active;
};

}  // namespace risaf
