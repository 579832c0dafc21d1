// Order statistics of a few hundred values.
#pragma once

#include <algorithm>
#include <cstddef>

namespace risaf {

// Order statistics k and k + 1 (the same where k is the last), values are moved about.
struct Pair {
  double low, high;
};

inline Pair order_statistics(double* values, std::size_t n, std::size_t k) {
  double* const at = values + k;
  std::nth_element(values, at, values + n);
  return {*at, k + 1 < n ? *std::min_element(at + 1, values + n) : *at};
}

// Median of n values, which are moved about; 0 of none.
inline double median(double* values, std::size_t n) {
  if (n == 0) {
    return 0.0;
  }
  const Pair middle = order_statistics(values, n, (n - 1) / 2);
  return 0.5 * (middle.low + (n % 2 ? middle.low : middle.high));
}

}  // namespace risaf
