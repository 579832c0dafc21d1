// What aiding.py makes of specific force, speed and rest, whose text says what and why; names are
// the same.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <optional>
#include <vector>

#include "eskf.hpp"

namespace risaf {

class SpeedTracker {
 public:
  explicit SpeedTracker(const FilterNumbers& numbers) : c(numbers) { start(0.0, INFINITE); }

  double speed, acceleration, speed_variance, acceleration_variance;

  bool known() const { return speed_variance < INFINITE; }
  bool recent() const { return since_told_ < c.LARGEST_GAP; }
  bool standing() const { return recent() && std::abs(speed) < c.STANDING_SPEED; }

  void advance(double dt) {
    since_told_ += dt;
    if (dt != kept_dt_) {
      kept_ = std::exp(-dt / c.ACCELERATION_TIME);
      kept_dt_ = dt;
    }
    const double usual = c.ACCELERATION_STD * c.ACCELERATION_STD;
    speed_variance += dt * (2.0 * common_ + dt * acceleration_variance);
    common_ = kept_ * (common_ + dt * acceleration_variance);
    speed += dt * acceleration;
    acceleration *= kept_;
    acceleration_variance = usual + kept_ * kept_ * (acceleration_variance - usual);
  }

  void turn_round() {
    speed = -speed;
    acceleration = -acceleration;
  }

  void hear(double told, double variance, double age) {
    if (!(std::abs(told) < 1e3 && 0.0 < variance && variance < 1e6 && 0.0 <= age && age < 10.0)) {
      return;
    }
    since_told_ = 0.0;
    if (!(speed_variance < c.SPEED_LOST * c.SPEED_LOST)) {
      start(told, variance);
      return;
    }
    const double by_speed = speed_variance - age * common_;
    const double by_acceleration = common_ - age * acceleration_variance;
    const double spread = by_speed - age * by_acceleration + variance;
    const double error = told - (speed - age * acceleration);
    speed += by_speed / spread * error;
    acceleration += by_acceleration / spread * error;
    speed_variance -= by_speed * by_speed / spread;
    acceleration_variance -= by_acceleration * by_acceleration / spread;
    common_ -= by_speed * by_acceleration / spread;
  }

 private:
  void start(double told, double variance) {
    speed = told;
    acceleration = 0.0;
    speed_variance = variance;
    acceleration_variance = c.ACCELERATION_STD * c.ACCELERATION_STD;
    common_ = 0.0;
  }

  FilterNumbers c;
  double since_told_ = INFINITE, common_ = 0.0, kept_ = NaN, kept_dt_ = NaN;
};

class GravityFinder {
 public:
  explicit GravityFinder(const FilterNumbers& numbers) : c(numbers) {}

  void restart() {
    parts_.clear();
    fresh_ = 0;
    part_ = {};
  }

  std::optional<Gravity> take(const Eskf& attitude, const Vector& force_b, double dt,
                              const SpeedTracker& speed) {
    for (const double force : force_b) {
      if (!(std::abs(force) < c.LARGEST_FORCE)) {
        return {};
      }
    }
    const Matrix matrix_ib = attitude.matrix_ib();
    const double rate_y = attitude.rate()[1], rate_z = attitude.rate()[2];
    Vector level_b = force_b;
    if (speed.speed_variance < speed.speed * speed.speed) {
      const double gained = speed.speed - speed_;
      level_b[0] -= std::abs(gained) < c.SPEED_JUMP ? gained / dt : 0.0;
      level_b[1] -= speed.speed * rate_z;
      level_b[2] += speed.speed * rate_y;
    }
    speed_ = speed.speed;
    Vector support_b = force_b;
    if (attitude.levelled()) {
      support_b = attitude.up_b();
      for (double& force : support_b) {
        force *= c.GRAVITY;
      }
    }
    const Vector level_i = matrix_ib * level_b;
    const ByErrors &by_gyro = attitude.drive_ib(), by_force = drive(matrix_ib, support_b);
    for (std::size_t i = 0; i < 3; ++i) {
      part_.force[i] -= level_i[i] * dt;
      for (std::size_t j = 0; j < ERRORS; ++j) {
        part_.lever[i][j] += by_gyro[i][j] * dt;
        part_.by_errors[i][j] += by_force[i][j] * dt;
      }
    }
    part_.time += dt;
    part_.turned += rate_z * dt;
    if (part_.time < c.PART) {
      return {};
    }
    if (parts_.size() == c.PARTS) {
      parts_.erase(parts_.begin());
    }
    parts_.push_back(part_);
    part_ = {};
    ++fresh_;
    if (last_ && fresh_ < c.PARTS / 2) {
      return {};
    }
    fresh_ = 0;
    return judge(attitude, speed);
  }

 private:
  struct Part {  // integrals over a time
    Vector force{};
    ByErrors lever{}, by_errors{};
    double turned = 0.0, time = 0.0;
  };

  Gravity judge(const Eskf& attitude, const SpeedTracker& speed) {
    const std::size_t n = parts_.size();
    std::vector<double> weights(n);
    double sum = 0.0, time = 0.0, time_square = 0.0, turn_square = 0.0;
    for (std::size_t k = 0; k < n; ++k) {
      const Part& part = parts_[k];
      const double place = 2.0 * static_cast<double>(k + 1) - static_cast<double>(n + 1);
      const double hann = 0.5 + 0.5 * std::cos(PI * place / static_cast<double>(n + 1));
      weights[k] = hann * part.time;
      sum += weights[k];
      time += part.time;
      time_square += part.time * part.time;
      turn_square += part.turned * part.turned;
    }
    Part mean;
    double older = 0.0;
    for (std::size_t k = 0; k < n; ++k) {
      const Part& part = parts_[k];
      const double weight = weights[k] / sum;
      const double since = older + weight - weight / 2.0;
      older += weight;
      for (std::size_t i = 0; i < 3; ++i) {
        mean.force[i] += weight / part.time * part.force[i];
        for (std::size_t j = 0; j < ERRORS; ++j) {
          mean.lever[i][j] += since * part.lever[i][j];
          mean.by_errors[i][j] += weight / part.time * part.by_errors[i][j];
        }
      }
    }
    const Matrix matrix_ni = attitude.matrix_ni();
    Gravity gravity;
    gravity.gravity_n = matrix_ni * mean.force;
    gravity.lever = matrix_ni * mean.lever;
    gravity.by_errors = matrix_ni * mean.by_errors;
    const Vector corrected = gravity.less(attitude.force_errors());
    const double size_square = dot(corrected, corrected);
    const Errors& by_size = gravity.by_errors[DOWN];
    const double size_variance = attitude.variance(ACCELEROMETER, by_size, by_size);
    double now = 0.0, heave = 0.0;
    if (last_) {
      const Vector change = matrix_ni * Vector{mean.force[0] - (*last_)[0],
                                               mean.force[1] - (*last_)[1],
                                               mean.force[2] - (*last_)[2]};
      const double drift = attitude.variance(GYRO, gravity.lever[0], gravity.lever[0]) +
                           attitude.variance(GYRO, gravity.lever[1], gravity.lever[1]);
      const double level = change[0] * change[0] + change[1] * change[1];
      now = std::max(level - c.GRAVITY * c.GRAVITY * drift, 0.0) * 0.3;
      heave = 0.6 * change[2] * change[2];
      heaving_ += 0.2 * (heave - heaving_);
    }
    unsteady_ += 0.2 * (now - unsteady_);
    last_ = mean.force;
    const double hidden = size_square - c.GRAVITY * c.GRAVITY;
    const double doubt =
        2.0 * c.GRAVITY * c.HEAVES * std::sqrt(size_variance + std::max(heaving_, heave));
    const double span = time / 2.0;
    const double lasting = std::max(2.0 * c.HIDDEN_TIME / std::max(span, c.SHORTEST_SPAN), 1.0);
    double along = std::max(hidden - doubt, 0.0), across = along;
    if (!speed.known()) {
      const double curve = lasting_turn();
      curves_ = curve > 0.0 ? curves_ + 1 : 0;
      across += curves_ * std::min(curve * c.ANY_SPEED * c.ANY_SPEED, doubt);
    } else {
      const double most = std::max(hidden, 0.0) + doubt, turning = turn_square / time_square;
      const double seen =
          4.0 * PI * PI * c.SPEED_TIME / std::pow(2.0 * span, 3) * speed.speed_variance;
      along = std::min({most, speed.acceleration_variance, seen / lasting});
      across = std::min(most, turning * speed.speed_variance);
    }
    const double known = c.FLOOR * c.FLOOR + std::max(unsteady_, now);
    gravity.forward = known + lasting * along;
    gravity.right = known + lasting * across;
    gravity.down = attitude.resting() ? known : INFINITE;
    return gravity;
  }

  double lasting_turn() const {
    double turned = 0.0, time = 0.0, spread = 0.0;
    for (const Part& part : parts_) {
      turned += part.turned;
      time += part.time;
    }
    const double mean = turned / time;
    for (const Part& part : parts_) {
      const double residual = part.turned / part.time - mean;
      spread += residual * residual;
    }
    spread /= static_cast<double>(parts_.size());
    return 4.0 * spread < mean * mean && std::abs(turned) < PI ? mean * mean : 0.0;
  }

  FilterNumbers c;
  std::vector<Part> parts_;
  Part part_;
  std::size_t fresh_ = 0;
  std::optional<Vector> last_;
  double speed_ = 0.0, curves_ = 0.0, unsteady_ = 0.0, heaving_ = 0.0;
};

struct Rest {
  Vector rate_b, variance;
  bool confirmed;
};

class RestFinder {
 public:
  explicit RestFinder(const FilterNumbers& numbers) : c(numbers) {}

  void restart() {
    values_.clear();
    time_ = 0.0;
  }

  std::optional<Rest> take(const Vector& rate_b, const Vector& force_b, double dt,
                           const SpeedTracker& speed) {
    values_.push_back({rate_b[0], rate_b[1], rate_b[2], force_b[0], force_b[1], force_b[2]});
    time_ += dt;
    if (time_ < c.BLOCK || values_.size() < 5) {
      return {};
    }
    const std::optional<Rest> rest = judge(speed);
    restart();
    return rest;
  }

 private:
  using Six = std::array<double, 6>;
  struct Reference {
    std::size_t axes;
    Six mean;
  };

  std::optional<Rest> judge(const SpeedTracker& speed) {
    std::size_t axes = 6;
    for (const Six& value : values_) {
      axes = std::isnan(value[3]) || std::isnan(value[4]) || std::isnan(value[5]) ? 3 : axes;
    }
    const auto n = static_cast<double>(values_.size());
    Six mean{}, variance{}, noise{};
    for (std::size_t j = 0; j < axes; ++j) {
      for (const Six& value : values_) {
        mean[j] += value[j];
      }
      mean[j] /= n;
      for (const Six& value : values_) {
        const double residual = value[j] - mean[j];
        variance[j] += residual * residual;
      }
      variance[j] /= n;
      for (std::size_t i = 1; i < values_.size(); ++i) {
        const double change = values_[i][j] - values_[i - 1][j];
        noise[j] += change * change;
      }
      noise[j] = noise[j] / (n - 1.0) / 2.0;
    }
    const bool standing = speed.standing();
    const Six& allowed = standing ? c.LOOSE : c.STRICT;
    const double white = 1.0 - std::min(4.0 / std::sqrt(n), 0.7);
    bool quiet = standing || !speed.recent();
    bool agree = reference_ && reference_->axes == axes;
    for (std::size_t j = 0; j < axes; ++j) {
      quiet &= variance[j] < c.QUIET[j] * c.QUIET[j] && std::isfinite(mean[j]);
      quiet &= standing || variance[j] * white < noise[j] + 1e-9;
      agree = agree && std::abs(mean[j] - reference_->mean[j]) <
                           allowed[j] + 5.0 * std::sqrt(2.0 * noise[j] / n);
    }
    if (!(quiet && agree)) {
      reference_ = quiet ? std::optional<Reference>({axes, mean}) : std::nullopt;
      still_ = 0.0;
      return {};
    }
    still_ += time_;
    if (still_ < (standing ? c.STILL : speed.known() ? c.STILL_ON_ROAD : c.STILL_ALONE)) {
      return {};
    }
    const double floor = standing ? c.REST_RATE : c.UNCONFIRMED_RATE;
    Rest rest{{mean[0], mean[1], mean[2]}, {}, standing || contradicts(axes, mean)};
    for (std::size_t j = 0; j < 3; ++j) {
      rest.variance[j] = std::max(noise[j], variance[j]) / n + floor * floor;
    }
    return rest;
  }

  bool contradicts(std::size_t axes, const Six& mean) const {
    if (axes < 6 || still_ < c.STILL_BY_GRAVITY) {
      return false;
    }
    const auto [x, y, z, a, b, d] = mean;
    const double rate = std::sqrt(x * x + y * y + z * z), force = std::sqrt(a * a + b * b + d * d);
    const double claimed = std::sqrt((y * d - z * b) * (y * d - z * b) +
                                     (z * a - x * d) * (z * a - x * d) +
                                     (x * b - y * a) * (x * b - y * a));
    return claimed > std::max(c.LEVEL_PART * rate, c.CLAIMED_TURN / still_) * force;
  }

  FilterNumbers c;
  std::vector<Six> values_;
  double time_ = 0.0, still_ = 0.0;
  std::optional<Reference> reference_;
};

class Aiding {
 public:
  explicit Aiding(const FilterNumbers& numbers)
      : speed(numbers), c(numbers), gravity_(numbers), rest_(numbers) {
    const double tilt = c.GRAVITY * c.initial_tilt_std;
    level_variance_ = tilt * tilt * 2.0 * c.TILTED_TIME / c.LEVEL_TIME;
  }

  SpeedTracker speed;

  Corrections take(Eskf& attitude, const Vector& rate_b, const Vector& force_b, double dt) {
    if (!(dt > 0.0)) {
      return {};
    }
    speed.advance(std::min(dt, c.LARGEST_STEP));
    if (dt > c.LONG_STEP || !finite(rate_b)) {
      gravity_.restart();
      rest_.restart();
      return {};
    }
    Corrections corrections;
    if (const auto rest = rest_.take(rate_b, force_b, dt, speed)) {
      corrections = attitude.correct_zero_rate(rest->rate_b, rest->variance, rest->confirmed);
    }
    auto gravity = gravity_.take(attitude, force_b, dt, speed);
    if (!gravity) {
      gravity = usual(attitude, force_b, dt);
    }
    if (gravity) {
      const Corrections by_gravity = attitude.correct_gravity(*gravity);
      corrections.insert(corrections.end(), by_gravity.begin(), by_gravity.end());
    }
    return corrections;
  }

 private:
  std::optional<Gravity> usual(const Eskf& attitude, const Vector& force_b, double dt) {
    if (finite(force_b)) {
      unfelt_ = 0.0;
      feels_ = true;
      return {};
    }
    unfelt_ += dt;
    if (unfelt_ < (feels_ ? c.UNFELT : c.LEVEL_TIME)) {
      return {};
    }
    unfelt_ = 0.0;
    feels_ = false;
    Gravity gravity;
    gravity.gravity_n = matrix(attitude.attitude()) * Vector{0.0, 0.0, c.GRAVITY};
    gravity.forward = gravity.right = level_variance_;
    return gravity;
  }

  FilterNumbers c;
  GravityFinder gravity_;
  RestFinder rest_;
  double level_variance_ = NaN, unfelt_ = 0.0;
  bool feels_ = false;
};

}  // namespace risaf
