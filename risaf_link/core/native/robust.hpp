// The step of robust.py, whose text says what is done and why; names are the same.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <utility>
#include <vector>

#include "fused.hpp"
#include "row.hpp"
#include "select.hpp"

namespace risaf {

struct RobustParameters {
  double gate, bias_time, hold_time, resolution, scale_error, gyro_noise, bias_walk;
  // Constants of robust.py, told by it.
  double limit, longest, watch_time, burst_time, burst, swell, noise_time, spread_time;
  double frozen_after, repeated_after, many, silent_after, dead_after, relearn, tiny, least_white,
      prior;
  std::vector<double> mad_factors;
};

// As `SensorState` and `Reason` of health.py.
enum SensorState : std::int8_t { HEALTHY, SUSPECT, DEAD };
enum Reason : std::int8_t { NONE, SETTLING, WANDERING, OUTLYING, FROZEN, SILENT };

class Robust {
 public:
  explicit Robust(RobustParameters parameters) : p(std::move(parameters)) {}

  // Channels of one axis; as `Channels` of robust.py.
  struct Axis {
    Row reading, count, residual, bias, age, slow, rejected, unchanged, moved;
    Row frozen, silent, calm, out, wandering, outlying, trusted;
    double spread = 0.0, slow_spread = 0.0, centre = 0.0, turning = 0.0, jitter = 0.0;
    double calm_walk = 0.0, noise = NaN;
    // Of this epoch.
    Row now, offset, valid, changing, jury, inside, active;
    std::size_t jury_count = 0, changing_count = 0, active_count = 0, moved_count = 0;
    double now_spread = 0.0, nearest = 0.0, mean = 0.0, slow_centre = 0.0;
    Selection centres, spreads, slow_centres, slow_spreads;
  };

  // Take new parameters; what was learnt stays.
  void configure(RobustParameters parameters) { p = std::move(parameters); }

  std::size_t sensors() const { return n_; }
  const Axis& axis(std::size_t i) const { return axes_[i]; }

  // Fuse readings (n, 3); returns how many sensors are valid on all axes.
  RISAF_FAST std::int64_t fuse(double dt, const double* readings, std::size_t n, FusedAxis* fused) {
    dt = dt > 0.0 && n_ > 0 ? std::min(dt, p.longest) : 0.0;
    if (n != n_) {
      resize(n);
    }
    elapsed_ += dt;
    by_axis(readings, n, axes_[0].now.data(), axes_[1].now.data(), axes_[2].now.data());
    for (Axis& a : axes_) {
      note_changes(a, dt);
    }
    if (all_repeat()) {
      freeze();
    }
    for (Axis& a : axes_) {
      choose_jury(a);
      find_centre(a, dt);
    }
    const double least = std::hypot(
        p.resolution, unscaled(axes_[0].centre, axes_[1].centre, axes_[2].centre));
    const double least_slow = std::hypot(
        p.resolution, p.gate * unscaled(axes_[0].turning, axes_[1].turning, axes_[2].turning));
    for (Axis& a : axes_) {
      choose_active(a, limit(a, least, dt));
      follow(a, dt);
      average_noise(a, dt);
      trust(a, slow_limit(a, least_slow, dt), dt);
    }
    judge(dt, fused);
    return static_cast<std::int64_t>(risaf::count(length(), [this](std::size_t i) {
      return axes_[0].valid[i] * axes_[1].valid[i] * axes_[2].valid[i] > 0.0;
    }));
  }

  // What is remembered over a restart, as memory.py has it: rows of channels, values of axes.
  static constexpr std::array<Row Axis::*, 5> CHANNELS{&Axis::bias, &Axis::age, &Axis::slow,
                                                       &Axis::calm, &Axis::out};
  static constexpr std::array<double Axis::*, 6> AXES{&Axis::spread,    &Axis::slow_spread,
                                                      &Axis::turning,   &Axis::jitter,
                                                      &Axis::calm_walk, &Axis::noise};

  double elapsed() const { return elapsed_; }
  double calm() const { return calm_; }

  // Tell it: channels (5, 3, n), axes (6, 3).
  void tell(double* channels, double* axes) const {
    for (std::size_t k = 0; k < 3; ++k) {
      for (std::size_t j = 0; j < CHANNELS.size(); ++j) {
        std::copy_n((axes_[k].*CHANNELS[j]).begin(), n_, channels + (3 * j + k) * n_);
      }
      for (std::size_t j = 0; j < AXES.size(); ++j) {
        axes[3 * j + k] = axes_[k].*AXES[j];
      }
    }
  }

  // Go on from it, with n sensors.
  void recall(std::size_t n, const double* channels, const double* axes, double elapsed,
              double calm) {
    axes_ = {};
    n_ = 0;
    resize(n);
    for (std::size_t k = 0; k < 3; ++k) {
      Axis& a = axes_[k];
      for (std::size_t j = 0; j < CHANNELS.size(); ++j) {
        std::copy_n(channels + (3 * j + k) * n, n, (a.*CHANNELS[j]).begin());
      }
      for (std::size_t j = 0; j < AXES.size(); ++j) {
        a.*AXES[j] = axes[3 * j + k];
      }
      for (std::size_t i = 0; i < n; ++i) {
        a.trusted[i] = a.calm[i] >= p.hold_time ? 1.0 : 0.0;
      }
    }
    elapsed_ = elapsed;
    calm_ = calm;
  }

  // `judge` of robust.py: of each sensor, by its worst axis, and its bias (n, 3).
  void health(std::int8_t* state, std::int8_t* reason, double* rejected, double* bias) const {
    for (std::size_t i = 0; i < n_; ++i) {
      Reason worst = NONE;
      bool dead = false;
      rejected[i] = 0.0;
      for (std::size_t k = 0; k < 3; ++k) {
        const Axis& a = axes_[k];
        const Reason found = a.silent[i] > 0.0      ? SILENT
                             : a.frozen[i] > 0.0    ? FROZEN
                             : a.outlying[i] > 0.0  ? OUTLYING
                             : a.wandering[i] > 0.0 ? WANDERING
                             : a.trusted[i] > 0.0   ? NONE
                                                    : SETTLING;
        worst = std::max(worst, found);
        dead |= a.frozen[i] > 0.0 || a.silent[i] > p.silent_after || a.out[i] > p.dead_after;
        rejected[i] = std::max(rejected[i], a.rejected[i]);
        bias[3 * i + k] = a.bias[i];
      }
      reason[i] = worst;
      state[i] = dead ? DEAD : worst > NONE ? SUSPECT : HEALTHY;
    }
  }

 private:
  // Keep the first n sensors, and make new ones of which nothing is known.
  [[gnu::noinline]] void resize(std::size_t n) {
    const std::size_t kept = std::min(n, n_), length = padded(n);
    const bool first = n_ == 0;
    for (Axis& a : axes_) {
      const auto fill = [=](Row& row, double value) {
        row.resize(kept);
        row.resize(length, value);
      };
      fill(a.reading, NaN);
      fill(a.count, NaN);
      for (Row* row : {&a.residual, &a.bias, &a.age, &a.slow, &a.rejected, &a.unchanged, &a.moved,
                       &a.frozen, &a.silent, &a.wandering, &a.outlying}) {
        fill(*row, 0.0);
      }
      fill(a.calm, first ? p.hold_time : 0.0);
      fill(a.out, first ? 0.0 : p.relearn);
      a.trusted.resize(length);
      for (std::size_t i = 0; i < length; ++i) {
        a.trusted[i] = a.calm[i] >= p.hold_time && i < n ? 1.0 : 0.0;
      }
      for (std::size_t i = n; i < length; ++i) {
        a.silent[i] = INFINITE;  // no sensor, and so never trusted
      }
      for (Row* row : {&a.now, &a.offset, &a.valid, &a.changing, &a.jury, &a.inside, &a.active}) {
        row->assign(length, NaN);
      }
    }
    values_.resize(length);
    n_ = n;
    blocks_ = length / PARTS;
  }

  double unscaled(double x, double y, double z) const {
    const double believed = p.prior / (p.prior + static_cast<double>(n_));
    return p.scale_error * std::sqrt(believed * (x * x + y * y + z * z));
  }

  double share(double dt, double time_constant) const {
    return elapsed_ > 0.0 ? dt / std::min(elapsed_, time_constant) : 1.0;
  }

  // Robust standard deviation, from the median of the distances of so many.
  double deviation(std::size_t count, double median) const {
    return p.mad_factors[std::min(count, p.mad_factors.size() - 1)] * median;
  }

  void note_changes(Axis& a, double dt) {
    const double limit = p.limit, resolution = p.resolution, frozen_after = p.frozen_after;
    const double jitter = a.jitter;
    RISAF_EACH
    for (std::size_t i = 0; i < length(); ++i) {
      const double reading = a.now[i], change = std::abs(reading - a.reading[i]);
      const bool valid = std::abs(reading) < limit;
      const bool changed = valid & (change > 0.0);  // false for the first
      a.count[i] = minimum(a.count[i], where(changed, change, a.count[i]));
      a.unchanged[i] = where(changed, 0.0, a.unchanged[i] + where(valid, dt, 0.0));
      a.silent[i] = where(valid, 0.0, a.silent[i] + dt);
      a.reading[i] = where(valid, reading, a.reading[i]);
      const double count = maximum(a.count[i], resolution);
      const bool reason =
          (std::abs(a.moved[i]) > 2.0 * count) | (2.0 * jitter > count) | (a.frozen[i] > 0.0);
      const bool frozen = valid & (a.unchanged[i] > frozen_after) & reason;
      a.frozen[i] = where(frozen, 1.0, 0.0);
      a.valid[i] = where(valid, 1.0, 0.0);
      a.changing[i] = where(valid & !frozen, 1.0, 0.0);
      a.jury[i] = a.changing[i] * a.trusted[i];
      a.offset[i] = where(valid, reading, a.bias[i]) - a.bias[i];
    }
  }

  double count_of(const Axis& a, std::size_t i) const { return maximum(a.count[i], p.resolution); }

  // Whether all repeat themselves though enough of them should not.
  bool all_repeat() const {
    double noisy = 0.0;
    for (const Axis& a : axes_) {
      for (std::size_t i = 0; i < n_; ++i) {
        if (a.valid[i] > 0.0) {
          if (a.unchanged[i] <= p.repeated_after) {
            return false;
          }
          noisy += 2.0 * a.jitter > count_of(a, i);
        }
      }
    }
    return noisy >= p.many;
  }

  void freeze() {
    for (Axis& a : axes_) {
      a.frozen = a.valid;
      std::fill(a.changing.begin(), a.changing.end(), 0.0);
      std::fill(a.jury.begin(), a.jury.end(), 0.0);
    }
  }

  void choose_jury(Axis& a) {
    const std::size_t valid = flagged(a.valid);
    a.changing_count = flagged(a.changing);
    a.jury_count = flagged(a.jury);
    if (static_cast<double>(a.jury_count) < std::max(3.0, static_cast<double>(valid) / 2.0)) {
      a.jury = a.changing;
      a.jury_count = a.changing_count;
    }
  }

  void find_centre(Axis& a, double dt) {
    select(a.offset, a.jury);
    const double centre =
        a.jury_count ? a.centres.median(values_.data(), length(), a.jury_count) : a.centre;
    const double step = centre - a.centre;
    RISAF_EACH
    for (std::size_t i = 0; i < length(); ++i) {
      a.moved[i] = where(a.unchanged[i] > 0.0, a.moved[i] + step, 0.0);
      a.offset[i] -= centre;
      values_[i] = where(a.jury[i] > 0.0, std::abs(a.offset[i]), INFINITE);
    }
    const std::size_t n = a.jury_count;
    a.nearest = least(length(), [this](std::size_t i) { return values_[i]; });
    a.now_spread = deviation(n, a.spreads.median(values_.data(), length(), n));
    a.centre = centre;
    a.turning += dt / p.watch_time * (centre - a.turning);
  }

  double limit(Axis& a, double least, double dt) {
    const double usual = std::max(a.spread, least);
    double spread = a.now_spread;
    if (elapsed_ > 0.0) {
      spread = std::min(spread, p.swell * usual);
    }
    if (a.jury_count) {
      a.spread += share(dt, p.noise_time) * (spread - a.spread);
    }
    return std::max(p.gate * std::max({spread, a.spread, least}), a.nearest);
  }

  void choose_active(Axis& a, double limit) {
    RISAF_EACH
    for (std::size_t i = 0; i < length(); ++i) {
      a.inside[i] = where(std::abs(a.offset[i]) <= limit, a.valid[i], 0.0);
      a.active[i] = a.trusted[i] * a.changing[i] * a.inside[i];
    }
    a.active_count = flagged(a.active);
    if (a.active_count == 0) {  // where none of the trusted is inside, the rest of the jury
      RISAF_EACH
      for (std::size_t i = 0; i < length(); ++i) {
        a.active[i] = a.jury[i] * a.inside[i];
      }
      a.active_count = flagged(a.active);
    }
    a.mean = sum(length(), [&a](std::size_t i) { return a.offset[i] * a.active[i]; }) /
             static_cast<double>(std::max<std::size_t>(a.active_count, 1));
  }

  // Let biases, residuals and what watches them follow the readings.
  void follow(Axis& a, double dt) {
    const double by_watch = dt / p.watch_time, by_burst = dt / p.burst_time, mean = a.mean;
    const double relearn = p.relearn, tiny = p.tiny, bias_time = p.bias_time;
    RISAF_EACH
    for (std::size_t i = 0; i < length(); ++i) {
      const double residual = a.offset[i] - mean, used = a.active[i] * residual;
      values_[i] = used - a.residual[i];
      a.residual[i] = used;
      const double known = a.trusted[i] * a.active[i];
      const double anew = where(a.out[i] >= relearn, a.changing[i], 0.0);
      const double elapsed = maximum(known, anew) * dt;
      a.age[i] += elapsed;
      a.bias[i] += elapsed / minimum(maximum(a.age[i], tiny), bias_time) * residual;
      a.slow[i] += by_watch * (a.inside[i] * residual - a.slow[i]);
      a.rejected[i] += by_burst * (a.valid[i] - a.inside[i] - a.rejected[i]);
    }
  }

  // Of the changes of the residuals in `values_`, and of the residuals.
  void average_noise(Axis& a, double dt) {
    const auto count = static_cast<double>(a.active_count);
    if (a.active_count > 1) {
      const double square = sum_of_squares(a.residual) / (count - 1.0);
      const double known = std::isnan(a.noise) ? square : a.noise;
      a.noise = known + share(dt, p.noise_time) * (square - known);
    }
    const double size = std::sqrt(sum_of_squares(values_) / std::max(2.0 * count, 1.0));
    if (a.active_count) {
      a.jitter += share(dt, p.spread_time) * (size - a.jitter);
    }
  }

  // How far from their centre z may be.
  double slow_limit(Axis& a, double least, double dt) {
    const std::size_t n = a.changing_count;
    select(a.slow, a.changing);
    a.slow_centre = a.slow_centres.median(values_.data(), length(), n);
    const double centre = a.slow_centre;
    RISAF_EACH
    for (std::size_t i = 0; i < length(); ++i) {
      values_[i] = where(a.changing[i] > 0.0, std::abs(a.slow[i] - centre), INFINITE);
    }
    const double white = a.spread * std::sqrt(dt / (2.0 * p.watch_time));
    const double spread =
        std::max(deviation(n, a.slow_spreads.median(values_.data(), length(), n)), white);
    a.slow_spread += share(dt, p.spread_time) * (spread - a.slow_spread);
    return std::max(p.gate * std::max(spread, a.slow_spread), least);
  }

  void trust(Axis& a, double slow_limit, double dt) {
    const std::size_t trusting = flagged(a.trusted);
    const double sum_of_shares =
        sum(length(), [&a](std::size_t i) { return a.rejected[i] * a.trusted[i]; });
    const double usual = sum_of_shares / static_cast<double>(std::max<std::size_t>(trusting, 1));
    const double burst = usual + p.burst, silent_after = p.silent_after, hold_time = p.hold_time;
    const double relearn = p.relearn, centre = a.slow_centre;
    RISAF_EACH
    for (std::size_t i = 0; i < length(); ++i) {
      const bool outlying = a.rejected[i] > burst;
      const bool wandering = std::abs(a.slow[i] - centre) > slow_limit;
      const bool alarm = outlying | wandering | (a.frozen[i] > 0.0) | (a.silent[i] > silent_after);
      a.calm[i] = where(alarm, 0.0, a.calm[i] + dt);
      const bool trusted = a.calm[i] >= hold_time;
      const double now = where(trusted, 1.0, 0.0);
      a.out[i] = where(trusted, 0.0, a.out[i] + dt);
      const bool anew =
          (a.out[i] >= relearn) & ((a.out[i] < relearn + dt) | (a.age[i] >= relearn));
      a.age[i] = where(anew, 0.0, a.age[i]);
      a.slow[i] = where(anew, 0.0, a.slow[i]);
      a.outlying[i] = where(outlying, 1.0, 0.0);
      a.wandering[i] = where(wandering, 1.0, 0.0);
      values_[i] = std::abs(a.trusted[i] - now);
      a.trusted[i] = now;
    }
    a.moved_count = flagged(values_);
  }

  void judge(double dt, FusedAxis* fused) {
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
      double slow =
          sum(length(), [&a](std::size_t i) { return a.active[i] * a.slow[i] * a.slow[i]; });
      slow = a.active_count ? slow / std::max(count - 1.0, 1.0) : NaN;
      double white = a.noise - slow;
      white = std::isnan(white) ? NaN : std::max(white, p.least_white * a.noise);
      double walk = 2.0 * (time + p.watch_time) / (time * time) * slow -
                    dt / (p.watch_time * time) * (std::isnan(white) ? 0.0 : white);
      a.calm_walk += part * (calm * (std::isnan(walk) ? 0.0 : walk) - a.calm_walk);
      walk = a.calm_walk / std::max(calm_, p.tiny);
      const double told = count - 1.0;
      walk = (p.prior * p.bias_walk * p.bias_walk + told * std::max(walk, 0.0)) / (p.prior + told);
      if (dt > 0.0 && a.moved_count) {
        walk += static_cast<double>(a.moved_count) / (count * dt) * slow;
      }
      const double alone = dt > 0.0 ? p.gyro_noise * p.gyro_noise / dt : NaN;
      fused[k].active = static_cast<std::int64_t>(a.active_count);
      fused[k].rate = a.active_count ? a.centre + a.mean : NaN;
      fused[k].variance = a.active_count ? a.noise : NaN;
      fused[k].noise = (std::isnan(white) ? alone : white) / count;
      fused[k].bias_walk = std::sqrt(walk / count);
    }
  }

  // Of the rows.
  std::size_t length() const { return PARTS * blocks_; }

  std::size_t flagged(const Row& flags) const {
    return risaf::count(length(), [&flags](std::size_t i) { return flags[i] > 0.0; });
  }

  double sum_of_squares(const Row& row) const {
    return sum(length(), [&row](std::size_t i) { return row[i] * row[i]; });
  }

  // The chosen of a row in `values_`; the others are infinite there.
  void select(const Row& row, const Row& chosen) {
    RISAF_EACH
    for (std::size_t i = 0; i < length(); ++i) {
      values_[i] = where(chosen[i] > 0.0, row[i], INFINITE);
    }
  }

  RobustParameters p;
  std::array<Axis, 3> axes_;
  Row values_;  // on their way to a median or a sum
  std::size_t n_ = 0, blocks_ = 0;
  double elapsed_ = 0.0, calm_ = 0.0;
};

}  // namespace risaf
