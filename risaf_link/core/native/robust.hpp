// The step of robust.py, whose text says what is done and why; names are the same.
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

struct RobustParameters {
  double gate, bias_time, hold_time, resolution, scale_error, gyro_noise, bias_walk;
  // Constants of robust.py, told by it.
  double limit, longest, watch_time, burst_time, burst, swell, noise_time, spread_time;
  double frozen_after, silent_after, relearn, tiny, least_white, prior;
  std::vector<double> mad_factors;
};

class Robust {
 public:
  explicit Robust(RobustParameters parameters) : p(std::move(parameters)) {}

  // Channels of one axis, each of n values; as `Channels` of robust.py.
  struct Axis {
    std::vector<double> reading, count, residual, bias, age, slow, rejected, unchanged, moved;
    std::vector<double> silent, calm, out;
    std::vector<std::uint8_t> frozen, wandering, outlying, trusted;
    double spread = 0.0, slow_spread = 0.0, centre = 0.0, turning = 0.0, jitter = 0.0;
    double calm_walk = 0.0, noise = NaN;
    // Of this epoch.
    std::vector<double> corrected, offset;
    std::vector<std::uint8_t> valid, changing, jury, inside, active;
    std::size_t jury_count = 0, valid_count = 0, changing_count = 0, active_count = 0;
    double mean = 0.0;

    void resize(std::size_t n, const RobustParameters& p, bool first) {
      const std::size_t known = reading.size();
      reading.resize(n, NaN);
      count.resize(n, NaN);
      for (auto* values : {&residual, &bias, &age, &slow, &rejected, &unchanged, &moved, &silent}) {
        values->resize(n, 0.0);
      }
      calm.resize(n, first ? p.hold_time : 0.0);
      out.resize(n, first ? 0.0 : p.relearn);
      for (auto* flags : {&frozen, &wandering, &outlying, &trusted, &valid, &changing, &jury, &inside, &active}) {
        flags->resize(n, 0);
      }
      corrected.resize(n);
      offset.resize(n);
      for (std::size_t i = known; i < n; ++i) {
        trusted[i] = calm[i] >= p.hold_time;
      }
    }
  };

  std::size_t sensors() const { return n_; }
  const Axis& axis(std::size_t i) const { return axes_[i]; }

  // Fuse readings (n, 3); returns how many sensors are valid on all axes.
  std::int64_t fuse(double dt, const double* readings, std::size_t n, FusedAxis* fused) {
    dt = dt > 0.0 && n_ > 0 ? std::min(dt, p.longest) : 0.0;
    if (n != n_) {
      for (Axis& a : axes_) {
        a.resize(n, p, n_ == 0);
      }
      scratch_.resize(n);
      n_ = n;
    }
    elapsed_ += dt;
    for (std::size_t k = 0; k < 3; ++k) {
      Axis& a = axes_[k];
      note_changes(a, readings + k, dt);
      choose_jury(a);
      find_centre(a, dt);
    }
    const double least = std::hypot(p.resolution, unscaled(axes_[0].centre, axes_[1].centre, axes_[2].centre));
    const double least_slow = std::hypot(
        p.resolution, p.gate * unscaled(axes_[0].turning, axes_[1].turning, axes_[2].turning));
    std::array<std::size_t, 3> moved{};
    for (std::size_t k = 0; k < 3; ++k) {
      Axis& a = axes_[k];
      choose_active(a, limit(a, least, dt));
      average_noise(a, dt);
      learn(a, dt);
      watch(a, least_slow, dt);
      moved[k] = trust(a, dt);
    }
    judge(dt, moved, fused);
    std::int64_t whole = 0;
    for (std::size_t i = 0; i < n_; ++i) {
      whole += axes_[0].valid[i] & axes_[1].valid[i] & axes_[2].valid[i];
    }
    return whole;
  }

 private:
  double unscaled(double x, double y, double z) const {
    const double believed = p.prior / (p.prior + static_cast<double>(n_));
    return p.scale_error * std::sqrt(believed * (x * x + y * y + z * z));
  }

  double share(double dt, double time_constant) const {
    return elapsed_ > 0.0 ? dt / std::min(elapsed_, time_constant) : 1.0;
  }

  double factor(std::size_t count) const {
    return p.mad_factors[std::min(count, p.mad_factors.size() - 1)];
  }

  void note_changes(Axis& a, const double* readings, double dt) {
    a.valid_count = a.changing_count = 0;
    for (std::size_t i = 0; i < n_; ++i) {
      const double reading = readings[3 * i];
      const bool valid = std::abs(reading) < p.limit;
      const double change = std::abs(reading - a.reading[i]);
      const bool changed = valid && change > 0.0;
      if (changed) {
        a.count[i] = std::fmin(a.count[i], change);
        a.unchanged[i] = 0.0;
      } else if (valid) {
        a.unchanged[i] += dt;
      }
      a.silent[i] = valid ? 0.0 : a.silent[i] + dt;
      if (valid) {
        a.reading[i] = reading;
      }
      const double count = std::fmax(a.count[i], p.resolution);
      const bool reason = std::abs(a.moved[i]) > 2.0 * count || 2.0 * a.jitter > count || a.frozen[i];
      a.frozen[i] = valid && a.unchanged[i] > p.frozen_after && reason;
      a.valid[i] = valid;
      a.changing[i] = valid && !a.frozen[i];
      a.corrected[i] = valid ? reading - a.bias[i] : 0.0;
      a.valid_count += valid;
      a.changing_count += a.changing[i];
    }
  }

  void choose_jury(Axis& a) {
    std::size_t trusted = 0;
    for (std::size_t i = 0; i < n_; ++i) {
      a.jury[i] = a.trusted[i] & a.changing[i];
      trusted += a.jury[i];
    }
    a.jury_count = trusted;
    if (static_cast<double>(trusted) < std::max(3.0, static_cast<double>(a.valid_count) / 2.0)) {
      a.jury = a.changing_count ? a.changing : a.valid;
      a.jury_count = a.changing_count ? a.changing_count : a.valid_count;
    }
  }

  void find_centre(Axis& a, double dt) {
    const double centre = median_of(a.corrected.data(), a.jury.data());
    for (std::size_t i = 0; i < n_; ++i) {
      a.moved[i] = a.unchanged[i] > 0.0 ? a.moved[i] + (centre - a.centre) : 0.0;
      a.offset[i] = a.corrected[i] - centre;
    }
    a.centre = centre;
    a.turning += dt / p.watch_time * (centre - a.turning);
  }

  double median_of(const double* values, const std::uint8_t* chosen) {
    std::size_t m = 0;
    for (std::size_t i = 0; i < n_; ++i) {
      scratch_[m] = values[i];
      m += chosen[i];
    }
    return median(scratch_.data(), m);
  }

  double limit(Axis& a, double least, double dt) {
    const double usual = std::max(a.spread, least);
    double nearest = INFINITE;
    std::size_t m = 0;
    for (std::size_t i = 0; i < n_; ++i) {
      const double distance = std::abs(a.offset[i]);
      scratch_[m] = distance;
      m += a.jury[i];
      nearest = a.jury[i] ? std::min(nearest, distance) : nearest;
    }
    double spread = factor(m) * median(scratch_.data(), m);
    if (elapsed_ > 0.0) {
      spread = std::min(spread, p.swell * usual);
    }
    a.spread += share(dt, p.noise_time) * (spread - a.spread);
    return std::max(p.gate * std::max({spread, a.spread, least}), nearest);
  }

  void choose_active(Axis& a, double limit) {
    std::size_t count = 0;
    for (std::size_t i = 0; i < n_; ++i) {
      a.inside[i] = (std::abs(a.offset[i]) <= limit) & a.valid[i];
      a.active[i] = a.trusted[i] & a.changing[i] & a.inside[i];
      count += a.active[i];
    }
    if (count == 0) {
      for (std::size_t i = 0; i < n_; ++i) {
        a.active[i] = a.jury[i] & a.inside[i];
        count += a.active[i];
      }
    }
    double sum = 0.0;
    for (std::size_t i = 0; i < n_; ++i) {
      sum += a.active[i] ? a.offset[i] : 0.0;
    }
    a.active_count = count;
    a.mean = sum / static_cast<double>(std::max<std::size_t>(count, 1));
  }

  void average_noise(Axis& a, double dt) {
    double square = 0.0, change_square = 0.0;
    for (std::size_t i = 0; i < n_; ++i) {
      const double residual = a.active[i] ? a.offset[i] - a.mean : 0.0;
      const double change = residual - a.residual[i];
      a.residual[i] = residual;
      square += residual * residual;
      change_square += change * change;
    }
    const auto count = static_cast<double>(a.active_count);
    if (a.active_count > 1) {
      square /= count - 1.0;
      const double known = std::isnan(a.noise) ? square : a.noise;
      a.noise = known + share(dt, p.noise_time) * (square - known);
    }
    const double size = std::sqrt(change_square / std::max(2.0 * count, 1.0));
    a.jitter += share(dt, p.spread_time) * (size - a.jitter);
  }

  void learn(Axis& a, double dt) {
    for (std::size_t i = 0; i < n_; ++i) {
      const bool learning =
          (a.trusted[i] & a.active[i]) || (a.out[i] >= p.relearn && a.changing[i]);
      const double elapsed = learning ? dt : 0.0;
      a.age[i] += elapsed;
      const double time = std::min(std::max(a.age[i], p.tiny), p.bias_time);
      a.bias[i] += elapsed / time * (a.offset[i] - a.mean);
    }
  }

  void watch(Axis& a, double least, double dt) {
    const double by_watch = dt / p.watch_time, by_burst = dt / p.burst_time;
    for (std::size_t i = 0; i < n_; ++i) {
      const double residual = a.inside[i] ? a.offset[i] - a.mean : 0.0;
      const double rejected = a.valid[i] && !a.inside[i] ? 1.0 : 0.0;
      a.slow[i] += by_watch * (residual - a.slow[i]);
      a.rejected[i] += by_burst * (rejected - a.rejected[i]);
    }
    const double centre = median_of(a.slow.data(), a.changing.data());
    std::size_t m = 0;
    for (std::size_t i = 0; i < n_; ++i) {
      scratch_[m] = std::abs(a.slow[i] - centre);
      m += a.changing[i];
    }
    const double white = a.spread * std::sqrt(dt / (2.0 * p.watch_time));
    const double spread = std::max(factor(m) * median(scratch_.data(), m), white);
    a.slow_spread += share(dt, p.spread_time) * (spread - a.slow_spread);
    const double limit = std::max(p.gate * std::max(spread, a.slow_spread), least);
    for (std::size_t i = 0; i < n_; ++i) {
      a.wandering[i] = std::abs(a.slow[i] - centre) > limit;
    }
  }

  // How many channels have come or gone.
  std::size_t trust(Axis& a, double dt) {
    std::size_t moved = 0, trusting = 0;
    double usual = 0.0;
    for (std::size_t i = 0; i < n_; ++i) {
      usual += a.trusted[i] ? a.rejected[i] : 0.0;
      trusting += a.trusted[i];
    }
    usual /= static_cast<double>(std::max<std::size_t>(trusting, 1));
    for (std::size_t i = 0; i < n_; ++i) {
      a.outlying[i] = a.rejected[i] > usual + p.burst;
      const bool alarm = a.outlying[i] || a.wandering[i] || a.frozen[i] ||
                         a.silent[i] > p.silent_after;
      a.calm[i] = alarm ? 0.0 : a.calm[i] + dt;
      const bool trusted = a.calm[i] >= p.hold_time;
      a.out[i] = trusted ? 0.0 : a.out[i] + dt;
      if (a.out[i] >= p.relearn && (a.out[i] < p.relearn + dt || a.age[i] >= p.relearn)) {
        a.age[i] = 0.0;
        a.slow[i] = 0.0;
      }
      moved += trusted != static_cast<bool>(a.trusted[i]);
      a.trusted[i] = trusted;
    }
    return moved;
  }

  void judge(double dt, const std::array<std::size_t, 3>& moved, FusedAxis* fused) {
    const double time = std::min(std::max(2.0 / 3.0 * elapsed_, p.watch_time), p.bias_time);
    double turned = 0.0;
    for (const Axis& a : axes_) {
      turned += a.turning * a.turning;
    }
    const double scale = p.scale_error * std::sqrt(turned) / std::max(p.resolution, p.tiny);
    const double calm = 1.0 / (1.0 + scale * scale);
    const double part =
        dt > 0.0 ? dt / std::min(std::max(elapsed_ / 3.0, dt), p.spread_time) : 0.0;
    calm_ += part * (calm - calm_);
    for (std::size_t k = 0; k < 3; ++k) {
      Axis& a = axes_[k];
      const double count = a.active_count ? static_cast<double>(a.active_count) : NaN;
      double slow = 0.0;
      for (std::size_t i = 0; i < n_; ++i) {
        slow += a.active[i] ? a.slow[i] * a.slow[i] : 0.0;
      }
      slow = a.active_count ? slow / std::max(count - 1.0, 1.0) : NaN;
      double white = a.noise - slow;
      white = std::isnan(white) ? NaN : std::max(white, p.least_white * a.noise);
      double walk = 2.0 * (time + p.watch_time) / (time * time) * slow -
                    dt / (p.watch_time * time) * (std::isnan(white) ? 0.0 : white);
      a.calm_walk += part * (calm * (std::isnan(walk) ? 0.0 : walk) - a.calm_walk);
      walk = a.calm_walk / std::max(calm_, p.tiny);
      const double told = count - 1.0;
      walk = (p.prior * p.bias_walk * p.bias_walk + told * std::max(walk, 0.0)) / (p.prior + told);
      if (dt > 0.0 && moved[k]) {
        walk += static_cast<double>(moved[k]) / (count * dt) * slow;
      }
      const double alone = dt > 0.0 ? p.gyro_noise * p.gyro_noise / dt : NaN;
      fused[k].active = static_cast<std::int64_t>(a.active_count);
      fused[k].rate = a.active_count ? a.centre + a.mean : NaN;
      fused[k].variance = a.active_count ? a.noise : NaN;
      fused[k].noise = (std::isnan(white) ? alone : white) / count;
      fused[k].bias_walk = std::sqrt(walk / count);
    }
  }

  RobustParameters p;
  std::array<Axis, 3> axes_;
  std::vector<double> scratch_;
  std::size_t n_ = 0;
  double elapsed_ = 0.0, calm_ = 0.0;
};

}  // namespace risaf
