// Rows of channels, in whole eights, so that the compiler's vectors leave no rest.
//
// How wide the processor's vectors are makes no difference to the last bit: sums have eight parts
// everywhere, and no product and sum are contracted into one.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <new>
#include <vector>

#include "fused.hpp"

// A function with all it calls, built for several processors; which one it is, is seen at run time.
#if defined(__x86_64__) && defined(__GLIBC__) && !defined(__clang__)
#define RISAF_FAST \
  [[gnu::flatten, gnu::target_clones("arch=x86-64-v4", "avx2", "arch=x86-64-v2", "default")]]
#else
#define RISAF_FAST [[gnu::flatten]]
#endif

#if defined(__clang__)
#define RISAF_EACH
#define RISAF_PARTS
#else
// No two rows overlap in the loop that follows.
#define RISAF_EACH _Pragma("GCC ivdep")
// The loop that follows is one vector, or a few: it is not unrolled before that is seen.
#define RISAF_PARTS _Pragma("GCC unroll 1")
#endif

namespace risaf {

// Lets no vector of the processor lie across two lines of its cache.
template <typename T>
struct Aligned {
  using value_type = T;
  static constexpr std::align_val_t LINE{64};

  Aligned() = default;
  template <typename U>
  Aligned(const Aligned<U>&) {}

  T* allocate(std::size_t n) { return static_cast<T*>(::operator new(n * sizeof(T), LINE)); }
  void deallocate(T* values, std::size_t) { ::operator delete(values, LINE); }
  bool operator==(const Aligned&) const { return true; }
  bool operator!=(const Aligned&) const { return false; }
};

using Row = std::vector<double, Aligned<double>>;  // flags are 0 or 1

// As NumPy's. By their bits, for a branch would keep the loop around it from being vectorised.
inline double where(bool condition, double yes, double no) {
  const std::uint64_t mask = -static_cast<std::uint64_t>(condition);
  std::uint64_t a, b;
  std::memcpy(&a, &yes, sizeof a);
  std::memcpy(&b, &no, sizeof b);
  a = (a & mask) | (b & ~mask);
  std::memcpy(&yes, &a, sizeof a);
  return yes;
}

// As NumPy's fmin and fmax, but that y is given where either is NaN.
inline double minimum(double x, double y) { return where(x < y, x, y); }
inline double maximum(double x, double y) { return where(x > y, x, y); }

constexpr std::size_t PARTS = 8;

// How long a row of n channels is.
inline std::size_t padded(std::size_t n) { return (n + PARTS - 1) / PARTS * PARTS; }

inline double total(const double (&part)[PARTS]) {
  return ((part[0] + part[1]) + (part[2] + part[3])) + ((part[4] + part[5]) + (part[6] + part[7]));
}

inline double smallest(const double (&part)[PARTS]) {
  return std::min(std::min(std::min(part[0], part[1]), std::min(part[2], part[3])),
                  std::min(std::min(part[4], part[5]), std::min(part[6], part[7])));
}

// Lay readings (n, 3) out by axis.
inline void by_axis(const double* readings, std::size_t n, double* x, double* y, double* z) {
  RISAF_EACH
  for (std::size_t i = 0; i < n; ++i) {
    x[i] = readings[3 * i];
    y[i] = readings[3 * i + 1];
    z[i] = readings[3 * i + 2];
  }
}

// Sum of term(i) for i below n, whole eights.
template <typename Term>
inline double sum(std::size_t n, Term term) {
  double part[PARTS] = {};
  for (std::size_t i = 0; i < n; i += PARTS) {
    RISAF_PARTS
    for (std::size_t j = 0; j < PARTS; ++j) {
      part[j] += term(i + j);
    }
  }
  return total(part);
}

// Least of term(i) for i below n, whole eights.
template <typename Term>
inline double least(std::size_t n, Term term) {
  double part[PARTS];
  std::fill(part, part + PARTS, INFINITE);
  for (std::size_t i = 0; i < n; i += PARTS) {
    RISAF_PARTS
    for (std::size_t j = 0; j < PARTS; ++j) {
      part[j] = minimum(term(i + j), part[j]);
    }
  }
  return smallest(part);
}

// How many of i below n are so.
template <typename Test>
inline std::size_t count(std::size_t n, Test test) {
  const double found = sum(n, [test](std::size_t i) { return where(test(i), 1.0, 0.0); });
  return static_cast<std::size_t>(found);
}

}  // namespace risaf
