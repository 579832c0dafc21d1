// The step of `Risaf` in fusion.py, eq. 5 to 8, whose text says what is done; names are the same.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "fused.hpp"
#include "select.hpp"

namespace risaf {

class Risaf {
 public:
  Risaf(double alpha, double lower, double upper, double gyro_noise, double bias_walk)
      : alpha_(alpha), lower_(lower), upper_(upper), gyro_noise_(gyro_noise), bias_walk_(bias_walk) {}

  std::size_t sensors() const { return n_; }
  const std::vector<double>& relative_bias(std::size_t axis) const { return bias_[axis]; }

  // Fuse readings (n, 3); returns how many sensors are valid on all axes.
  std::int64_t fuse(double dt, const double* readings, std::size_t n, FusedAxis* fused) {
    if (n != n_) {
      for (auto& bias : bias_) {
        bias.resize(n, 0.0);
      }
      corrected_.resize(n);
      ordered_.resize(n);
      n_ = n;
    }
    const double alone = dt > 0.0 ? gyro_noise_ * gyro_noise_ / dt : NaN;
    for (std::size_t k = 0; k < 3; ++k) {
      fused[k] = fuse_axis(readings + k, bias_[k]);
      const double count = fused[k].active ? static_cast<double>(fused[k].active) : NaN;
      fused[k].noise = (std::isnan(fused[k].variance) ? alone : fused[k].variance) / count;
      fused[k].bias_walk = bias_walk_ / std::sqrt(count);
    }
    std::int64_t whole = 0;
    for (std::size_t i = 0; i < n; ++i) {
      const double* reading = readings + 3 * i;
      whole += std::isfinite(reading[0]) && std::isfinite(reading[1]) && std::isfinite(reading[2]);
    }
    return whole;
  }

 private:
  FusedAxis fuse_axis(const double* readings, std::vector<double>& bias) {
    double sum = 0.0;
    std::size_t valid = 0;
    for (std::size_t i = 0; i < n_; ++i) {
      const double reading = readings[3 * i];
      const bool finite = std::isfinite(reading);
      sum += finite ? reading : 0.0;
      valid += finite;
    }
    if (valid == 0) {
      return {NaN, NaN, NaN, NaN, 0};
    }
    const double mean = sum / static_cast<double>(valid);
    std::size_t m = 0;
    for (std::size_t i = 0; i < n_; ++i) {
      const double reading = readings[3 * i];
      if (std::isfinite(reading)) {
        bias[i] = alpha_ * bias[i] + (1.0 - alpha_) * (reading - mean);  // eq. 5
        corrected_[m++] = reading - bias[i];
      }
    }
    std::copy_n(corrected_.begin(), m, ordered_.begin());
    const auto [low, high] = thresholds(m);
    double total = 0.0;
    std::size_t active = 0;
    for (std::size_t i = 0; i < m; ++i) {  // eq. 6
      const bool inside = low <= corrected_[i] && corrected_[i] <= high;
      ordered_[active] = corrected_[i];
      active += inside;
    }
    if (active == 0) {  // of two sensors neither is inside
      std::copy_n(corrected_.begin(), m, ordered_.begin());
      active = m;
    }
    for (std::size_t i = 0; i < active; ++i) {
      total += ordered_[i];
    }
    const double rate = total / static_cast<double>(active);  // eq. 7
    double square = 0.0;
    for (std::size_t i = 0; i < active; ++i) {
      const double residual = ordered_[i] - rate;
      square += residual * residual;
    }
    const double variance = active > 1 ? square / static_cast<double>(active - 1) : NaN;  // eq. 8
    return {rate, variance, NaN, NaN, static_cast<std::int64_t>(active)};
  }

  // The two quantiles of the first m values in `ordered_`, which are moved about.
  Pair thresholds(std::size_t m) {
    const double low = quantile(m, lower_);
    return {low, quantile(m, upper_)};
  }

  double quantile(std::size_t m, double share) {
    const double place = share * static_cast<double>(m - 1);
    const auto below = static_cast<std::size_t>(place);
    const double part = place - static_cast<double>(below);
    const Pair values = order_statistics(ordered_.data(), m, below);
    const double step = values.high - values.low;
    return part < 0.5 ? values.low + step * part : values.high - step * (1.0 - part);
  }

  double alpha_, lower_, upper_, gyro_noise_, bias_walk_;
  std::array<std::vector<double>, 3> bias_;
  std::vector<double> corrected_, ordered_;
  std::size_t n_ = 0;
};

}  // namespace risaf
