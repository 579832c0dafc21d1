// What the fusions of fusion.py have in common; names are the same.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>

#include "fused.hpp"
#include "row.hpp"

namespace risaf {

// The readings of an epoch by axis: `_channels` of fusion.py. And for how long each sensor has been
// silent: what `SilenceMonitor` of health.py remembers.
struct Readings {
  std::array<Row, 3> rates, valid;
  Row silent_for;  // s
  std::size_t sensors = 0, blocks = 0;

  std::size_t length() const { return PARTS * blocks; }

  // Take readings (n, 3); returns how many sensors are valid on all axes.
  std::int64_t take(double dt, const double* readings, std::size_t n) {
    if (n != sensors) {
      resize(n);
      dt = std::max(dt, std::numeric_limits<double>::min());
    }
    by_axis(readings, n, rates[0].data(), rates[1].data(), rates[2].data());
    RISAF_EACH
    for (std::size_t i = 0; i < length(); ++i) {
      const bool x = std::abs(rates[0][i]) < INFINITE, y = std::abs(rates[1][i]) < INFINITE,
                 z = std::abs(rates[2][i]) < INFINITE;
      valid[0][i] = where(x, 1.0, 0.0);
      valid[1][i] = where(y, 1.0, 0.0);
      valid[2][i] = where(z, 1.0, 0.0);
      silent_for[i] = where(x & y & z, 0.0, silent_for[i] + dt);
    }
    return static_cast<std::int64_t>(count(length(), [this](std::size_t i) {
      return valid[0][i] * valid[1][i] * valid[2][i] > 0.0;
    }));
  }

 private:
  [[gnu::noinline]] void resize(std::size_t n) {
    for (auto* rows : {&rates, &valid}) {
      for (Row& row : *rows) {
        row.assign(padded(n), NaN);
      }
    }
    silent_for.assign(padded(n), 0.0);
    sensors = n;
    blocks = padded(n) / PARTS;
  }
};

// What one sensor's noise and bias walk are, where readings cannot tell.
struct OneSensor {
  double gyro_noise, bias_walk;

  // `_fused` of fusion.py: as if the sensors were independent and Gaussian.
  FusedAxis fused(double dt, double rate, double variance, double count) const {
    const double sensors = count > 0.0 ? count : NaN;
    const double one = dt > 0.0 ? gyro_noise * gyro_noise / dt : NaN;
    const double noise = (std::isnan(variance) ? one : variance) / sensors;
    const double walk = bias_walk / std::sqrt(sensors);
    return {rate, variance, noise, walk, static_cast<std::int64_t>(count)};
  }

  // `_mean_of_active` of fusion.py: eq. 7 and 8.
  FusedAxis mean_of_active(double dt, const Row& rates, const Row& active,
                           std::size_t length) const {
    const double count = sum(length, [&](std::size_t i) { return active[i]; });
    const double total =
        sum(length, [&](std::size_t i) { return where(active[i] > 0.0, rates[i], 0.0); });
    const double rate = count > 0.0 ? total / count : NaN;
    const double square = sum(length, [&](std::size_t i) {
      const double residual = where(active[i] > 0.0, rates[i] - rate, 0.0);
      return residual * residual;
    });
    return fused(dt, rate, count > 1.0 ? square / (count - 1.0) : NaN, count);
  }
};

}  // namespace risaf
