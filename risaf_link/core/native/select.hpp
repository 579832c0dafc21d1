// Order statistics of a few hundred values that change little from one epoch to the next.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <iterator>

#include "fused.hpp"
#include "row.hpp"

namespace risaf {

// Order statistics k and k + 1 (the same where k is the last).
struct Pair {
  double low, high;
};

// Finds the same order statistics of every epoch.
//
// To look from a bound is to count the values up to it, and to see the next above. Where k are
// counted, the next is order statistic k: it becomes the bound, and its count, more than k, proves
// it. The first bound is just below what was found the last time; then, in strides of twice the
// length, one on the other side is looked for; between the two, false position goes for a count of
// k, in the Illinois form: Dowell and Jarratt, "A modified regula falsi method for computing the
// root of an equation", BIT 11, 1971. Where the first bound was has no influence on what is found,
// only on how long it takes.
class Selection {
 public:
  // Order statistics k and k + 1 of n values; what else is in the row, to its length, is infinite.
  RISAF_FAST Pair find(const double* values, std::size_t length, std::size_t n, std::size_t k) {
    const double aim = static_cast<double>(k) - 0.5;
    double low = -INFINITE, missing = 0.0, next = -INFINITE;  // a bound, and above it the next
    double high = INFINITE, surplus = 0.0;
    double bound = at_ - step_, before = NaN, stride = step_;
    bool enclosed = false;
    for (std::size_t i = 0; i < LOOKS; ++i) {
      const Look here = look(bound, values, length);
      const double more = here.count - aim;
      if (more < 1.0) {
        surplus *= before == low ? 0.5 : 1.0;
        low = bound;
        missing = std::max(-more, 0.0);
        next = here.next;
      } else if (bound == next) {
        at_ = bound;
        return {bound, more > 2.0 || k + 1 == n ? bound : here.next};
      } else {
        missing *= before == high ? 0.5 : 1.0;
        high = bound;
        surplus = more;
      }
      before = bound;
      if (low == -INFINITE || high == INFINITE) {
        bound -= more * stride;
        stride *= 2.0;
      } else {
        const double step = (high - low) / (missing + surplus);
        bound = low + missing * step;
        step_ = enclosed ? step_ : step;
        enclosed = true;
      }
      bound = std::max(bound < high ? bound : std::nextafter(high, -INFINITE), next);
    }
    return sorted(values, length, k);
  }

  // Median of the finite values of a row, n in number; 0 of none.
  double median(const double* values, std::size_t length, std::size_t n) {
    if (n == 0) {
      return 0.0;
    }
    const Pair middle = find(values, length, n, (n - 1) / 2);
    return 0.5 * (middle.low + (n % 2 ? middle.low : middle.high));
  }

  // Quantile of the n finite values of a row, at least one: `quantiles` of fusion.py.
  double quantile(const double* values, std::size_t length, std::size_t n, double share) {
    const double place = share * static_cast<double>(n - 1);
    const auto below = static_cast<std::size_t>(place);
    const double part = place - static_cast<double>(below);
    const auto [low, high] = find(values, length, n, below);
    const double step = high - low;
    return part < 0.5 ? low + step * part : high - step * (1.0 - part);
  }

 private:
  static constexpr std::size_t LOOKS = 16;

  // The values up to a bound are so many, and the next is this.
  struct Look {
    double count, next;
  };

  static Look look(double bound, const double* values, std::size_t length) {
    double counts[PARTS] = {}, next[PARTS];
    std::fill(next, next + PARTS, INFINITE);
    for (std::size_t i = 0; i < length; i += PARTS) {
      RISAF_PARTS
      for (std::size_t j = 0; j < PARTS; ++j) {
        const double value = values[i + j];
        const bool counted = value <= bound;
        counts[j] += where(counted, 1.0, 0.0);
        next[j] = minimum(where(counted, INFINITE, value), next[j]);
      }
    }
    return {total(counts), smallest(next)};
  }

  // The same by sorting: at first, and where looking has come to nothing.
  [[gnu::noinline]] Pair sorted(const double* values, std::size_t length, std::size_t k) {
    ordered_.clear();
    std::copy_if(values, values + length, std::back_inserter(ordered_),
                 [](double value) { return value < INFINITE; });
    std::sort(ordered_.begin(), ordered_.end());
    if (k >= ordered_.size()) {  // what is chosen is not finite
      return {INFINITE, INFINITE};
    }
    const std::size_t last = ordered_.size() - 1, around = 1 + last / 8;
    const std::size_t before = k - std::min(k, around), behind = std::min(k + around, last);
    at_ = ordered_[k];
    const auto between = static_cast<double>(std::max<std::size_t>(behind - before, 1));
    step_ = (ordered_[behind] - ordered_[before]) / between;
    return {at_, ordered_[std::min(k + 1, last)]};
  }

  double at_ = 0.0, step_ = 0.0;  // the lower one; from one value to the next
  Row ordered_;
};

}  // namespace risaf
