// Order statistics of a few hundred values.
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>

namespace risaf {

// Order statistics k and k + 1 (the same where k is the last).
struct Pair {
  double low, high;
};

// Values are moved about.
inline Pair select(double* values, std::size_t n, std::size_t k) {
  double* const at = values + k;
  std::nth_element(values, at, values + n);
  return {*at, k + 1 < n ? *std::min_element(at + 1, values + n) : *at};
}

// Values are moved about.
//
// A sample says within which bounds the two very likely are; in one pass without branches, what is
// within is gathered, and what is below counted. Where the sample was wrong, all are gone through.
inline Pair order_statistics(double* values, std::size_t n, std::size_t k) {
  constexpr std::size_t SAMPLE = 15, MARGIN = 3, LARGEST = 1024;
  if (n < 4 * SAMPLE || n > LARGEST) {
    return select(values, n, k);
  }
  std::array<double, SAMPLE> sample;
  for (std::size_t i = 0; i < SAMPLE; ++i) {
    double value = values[i * (n / SAMPLE)];
    std::size_t at = i;
    for (; at > 0 && sample[at - 1] > value; --at) {
      sample[at] = sample[at - 1];
    }
    sample[at] = value;
  }
  const std::size_t middle = k * SAMPLE / n;
  const double least = sample[middle > MARGIN ? middle - MARGIN : 0];
  const double most = sample[std::min(middle + MARGIN, SAMPLE - 1)];
  std::array<double, LARGEST + 1> within;
  std::size_t m = 0, below = 0;
  for (std::size_t i = 0; i < n; ++i) {
    within[m] = values[i];
    m += (least <= values[i]) & (values[i] <= most);
    below += values[i] < least;
  }
  if (k < below || k + 1 >= below + m) {
    return select(values, n, k);
  }
  return select(within.data(), m, k - below);
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
