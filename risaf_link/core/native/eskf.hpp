// The filter of eskf.py and error_state.py, whose text says what is done and why; names are the same.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <vector>

#include "fused.hpp"
#include "rotation.hpp"
#include "row.hpp"

namespace risaf {

constexpr std::size_t STATES = 29, BIAS = 3, SCALE = 6, GYRO = 3, ACCELEROMETER = 15;
constexpr std::size_t ERRORS = 12;  // of a triad: bias, and a matrix row by row
constexpr std::size_t OFFSET = 27, LATE = 28, DOWN = 2;
constexpr std::size_t PADDED = 32;  // length of a row of the covariance in memory

using Errors = std::array<double, ERRORS>;
using ByErrors = std::array<Errors, 3>;
using State = std::array<double, STATES>;

// Parameters of the filter, and constants of gap.py, eskf.py and aiding.py, all told by Python.
#define RISAF_FILTER_NUMBERS(X)                                                                   \
  X(initial_bias_std) X(initial_tilt_std) X(common_noise) X(common_bias_walk) X(scale_std)        \
  X(turn_error) X(accel_bias_std) X(gate) X(gravity_distrust) X(distrust)                         \
  X(offset_std) X(delay_std)                                                                      \
  X(GAP) X(USUAL_LESS) X(USUAL_MORE) X(SHAKEN_TIME) X(END_TIME) X(UNSEEN_CHANGE)                  \
  X(LONG_STEP) X(UNKNOWN_RATE) X(LARGEST_RATE) X(LARGEST_FORCE) X(LARGEST_STEP) X(LARGEST_GAP)    \
  X(OFFSET_TIME) X(LATE_TIME) X(RATE_SPAN) X(STEEP) X(EARTH_RATE) X(GRAVITY)                      \
  X(PART) X(SHORTEST_SPAN) X(HEAVES) X(FLOOR) X(HIDDEN_TIME) X(ANY_SPEED) X(SPEED_TIME) X(ACCELERATION_STD)        \
  X(ACCELERATION_TIME) X(SPEED_LOST) X(SPEED_JUMP) X(BLOCK) X(STILL) X(STILL_ALONE)               \
  X(STILL_ON_ROAD) X(STILL_BY_GRAVITY) X(CLAIMED_TURN) X(LEVEL_PART) X(LEVEL_TIME) X(TILTED_TIME) \
  X(UNFELT) X(REST_RATE) X(UNCONFIRMED_RATE) X(STANDING_SPEED)

struct FilterNumbers {
#define RISAF_DECLARE(name) double name = NaN;
  RISAF_FILTER_NUMBERS(RISAF_DECLARE)
#undef RISAF_DECLARE
  std::size_t HISTORY = 0, PARTS = 0;
  std::array<double, 6> QUIET{}, LOOSE{}, STRICT{};
};

enum class Outcome { FUSED, RESET, REJECTED, NOT_FINITE, UNOBSERVABLE };
enum class Aid { HEADING, GRAVITY, SIZE, REST };

struct Correction {
  double value, variance, gate;
  bool reset;
  Aid source;
  Outcome outcome;

  bool fused() const { return outcome == Outcome::FUSED || outcome == Outcome::RESET; }
};

using Corrections = std::vector<Correction>;

struct Gravity {
  Vector gravity_n{};
  double forward = NaN, right = NaN, down = INFINITE;
  ByErrors lever{}, by_errors{};

  // It without what the accelerometers are known to err by.
  Vector less(const Errors& force_errors) const {
    Vector corrected = gravity_n;
    for (std::size_t i = 0; i < 3; ++i) {
      corrected[i] += dot(by_errors[i], force_errors);
    }
    return corrected;
  }
};

// What the errors of a triad make of its reading in another frame.
inline ByErrors drive(const Matrix& matrix, const Vector& reading_b) {
  ByErrors by_errors;
  for (std::size_t i = 0; i < 3; ++i) {
    for (std::size_t j = 0; j < 3; ++j) {
      by_errors[i][j] = matrix[i][j];
      for (std::size_t k = 0; k < 3; ++k) {
        by_errors[i][3 + 3 * j + k] = matrix[i][j] * reading_b[k];
      }
    }
  }
  return by_errors;
}

inline ByErrors operator*(const Matrix& m, const ByErrors& e) {
  ByErrors turned;
  for (std::size_t i = 0; i < 3; ++i) {
    for (std::size_t j = 0; j < ERRORS; ++j) {
      turned[i][j] = m[i][0] * e[0][j] + m[i][1] * e[1][j] + m[i][2] * e[2][j];
    }
  }
  return turned;
}

class Eskf {
 public:
  explicit Eskf(const FilterNumbers& numbers) : c(numbers), history_(numbers.HISTORY) {
    const double tilt = c.initial_tilt_std * c.initial_tilt_std;
    wrong_variance_ = {c.offset_std * c.offset_std, c.delay_std * c.delay_std};
    State diagonal{tilt, tilt, PI * PI};
    std::fill_n(&diagonal[BIAS], 3, c.initial_bias_std * c.initial_bias_std);
    std::fill_n(&diagonal[SCALE], 9, c.scale_std * c.scale_std);
    std::fill_n(&diagonal[ACCELEROMETER], 3, c.accel_bias_std * c.accel_bias_std);
    std::fill_n(&diagonal[ACCELEROMETER + 3], 9, c.scale_std * c.scale_std);
    std::copy_n(wrong_variance_.begin(), 2, &diagonal[OFFSET]);
    for (std::size_t i = 0; i < STATES; ++i) {
      covariance_[i][i] = diagonal[i];
    }
    drive_ib_ = drive(matrix(by_rate_), rate_);
  }

  // What others read.

  const FilterNumbers& numbers() const { return c; }
  Quaternion attitude() const { return product(correction_, by_rate_); }
  Matrix matrix_ib() const { return matrix(by_rate_); }
  Matrix matrix_ni() const { return matrix(correction_); }
  const ByErrors& drive_ib() const { return drive_ib_; }
  const Vector& rate() const { return rate_; }
  const Vector& bias() const { return bias_; }
  const std::array<double, 9>& scale() const { return scale_; }
  const Errors& force_errors() const { return force_errors_; }
  const std::array<double, 2>& wrong() const { return wrong_; }
  bool levelled() const { return levelled_; }
  bool aligned() const { return aligned_; }
  int resets() const { return resets_; }
  double latitude() const { return latitude_; }
  bool resting() const { return elapsed_ - rested_ < c.LARGEST_GAP; }
  double covariance(std::size_t i, std::size_t j) const { return covariance_[i][j]; }

  Vector up_b() const {
    const Matrix matrix_nb = matrix(attitude());
    return {-matrix_nb[DOWN][0], -matrix_nb[DOWN][1], -matrix_nb[DOWN][2]};
  }

  // Variance of a sum of errors of one triad, whose states start at `first`.
  double variance(std::size_t first, const Errors& a, const Errors& b) const {
    double sum = 0.0;
    for (std::size_t i = 0; i < ERRORS; ++i) {
      double column = 0.0;
      for (std::size_t j = 0; j < ERRORS; ++j) {
        column += covariance_[first + i][first + j] * b[j];
      }
      sum += a[i] * column;
    }
    return sum;
  }

  Vector bias_std() const {
    Vector std;
    for (std::size_t i = 0; i < 3; ++i) {
      std[i] = std::sqrt(covariance_[BIAS + i][BIAS + i]);
    }
    return std;
  }

  // Standard deviations of roll, pitch and yaw, half a turn at most; covariances of roll with
  // pitch, of roll with yaw, of pitch with yaw.
  struct AngleSpread {
    Vector std, common;
  };

  AngleSpread angle_spread() const {
    const Matrix matrix_nb = matrix(attitude());
    const double north = matrix_nb[0][0], east = matrix_nb[1][0];
    const double level = std::max(north * north + east * east, 1e-12), cosine = std::sqrt(level);
    const State yaw_row = by_yaw(matrix_nb, 0.0);
    const Vector rows[3] = {{north / level, east / level, 0.0},
                            {-east / cosine, north / cosine, 0.0},
                            {yaw_row[0], yaw_row[1], yaw_row[2]}};
    Vector carried[3], kept, std;
    for (std::size_t i = 0; i < 3; ++i) {
      for (std::size_t k = 0; k < 3; ++k) {
        carried[i][k] = rows[i][0] * covariance_[0][k] + rows[i][1] * covariance_[1][k] +
                        rows[i][2] * covariance_[2][k];
      }
      const double whole = std::sqrt(std::max(dot(carried[i], rows[i]), 0.0));
      std[i] = std::min(whole, PI);
      kept[i] = PI / std::max(whole, PI);  // so that they stay a covariance
    }
    const double by_yaw_known = aligned_ ? kept[2] : 0.0;
    std[2] = aligned_ ? std[2] : PI;
    return {std,
            {dot(carried[0], rows[1]) * kept[0] * kept[1],
             dot(carried[0], rows[2]) * kept[0] * by_yaw_known,
             dot(carried[1], rows[2]) * kept[1] * by_yaw_known}};
  }

  // What others set.

  // Take new parameters; the state stays, and with it what they say of the start.
  void configure(const FilterNumbers& numbers) {
    c = numbers;
    wrong_variance_ = {c.offset_std * c.offset_std, c.delay_std * c.delay_std};
  }

  void set_latitude(double latitude) {
    if (std::abs(latitude) <= PI / 2.0) {
      latitude_ = latitude;
      earth_ = {c.EARTH_RATE * std::cos(latitude), 0.0, -c.EARTH_RATE * std::sin(latitude)};
    }
  }

  void set_attitude(const Quaternion& q_nb) {
    correction_ = product(q_nb, {by_rate_.w, -by_rate_.x, -by_rate_.y, -by_rate_.z});
  }

  void set_covariance(const double* covariance) {
    for (std::size_t i = 0; i < STATES; ++i) {
      std::copy_n(covariance + STATES * i, STATES, covariance_[i]);
    }
  }

  // What is held to make readings and headings wrong, in the order of the covariance.
  std::array<double, STATES - GYRO> errors() const {
    std::array<double, STATES - GYRO> all;
    auto end = std::copy(bias_.begin(), bias_.end(), all.begin());
    end = std::copy(scale_.begin(), scale_.end(), end);
    end = std::copy(force_errors_.begin(), force_errors_.end(), end);
    std::copy(wrong_.begin(), wrong_.end(), end);
    return all;
  }

  // `recall` of eskf.py, but for attitude and covariance.
  void recall(const Vector& rate_b, const double* errors, double latitude, bool aligned,
              bool levelled, int resets) {
    rate_ = rate_b;
    std::copy_n(errors, 3, bias_.begin());
    std::copy_n(errors + 3, 9, scale_.begin());
    std::copy_n(errors + ERRORS, ERRORS, force_errors_.begin());
    std::copy_n(errors + 2 * ERRORS, 2, wrong_.begin());
    set_latitude(latitude);
    aligned_ = aligned;
    levelled_ = levelled;
    resets_ = resets;
  }

  void predict(const FusedAxis* fused, double dt) {
    if (!(dt > 0.0)) {
      return;
    }
    dt = std::min(dt, c.LARGEST_STEP);
    std::array<bool, 3> known;
    Vector held, read;
    const Vector rate_before = rate_;
    for (std::size_t i = 0; i < 3; ++i) {
      known[i] = std::abs(fused[i].rate) < c.LARGEST_RATE;  // false for NaN
      held[i] = unseen_[i] < c.LONG_STEP ? rate_[i] : 0.0;
      read[i] = known[i] ? fused[i].rate - bias_[i] : held[i];
    }
    for (std::size_t i = 0; i < 3; ++i) {
      const double* row = &scale_[3 * i];
      const double scaled = row[0] * read[0] + row[1] * read[1] + row[2] * read[2];
      rate_[i] = known[i] ? read[i] - scaled : held[i];
    }
    const Step step = take(rate_before, known, dt);
    Vector unseen = see(known, dt, step.has_gap);
    for (std::size_t i = 0; i < 3; ++i) {
      unseen[i] += step.unseen[i];
    }
    const Quaternion before = by_rate_;
    by_rate_ = unit(product(before, exp(rotation(step))));
    drive_ib_ = drive(matrix(between(before, by_rate_, 0.5)), step.rate_b);
    const Vector earth = earth_rate();
    turn({-earth[0] * dt, -earth[1] * dt, -earth[2] * dt});
    elapsed_ += dt;
    remember();
    spread(matrix_ni() * drive_ib_, fused, unseen, step.told, dt);
  }

  // Whether a heading can be compared; if so, with what outcome.
  bool compare_heading(double heading, double variance, double age, double gate,
                       Correction& compared) const {
    State row;
    double error;
    if (!usable(heading, variance, age) || !by_heading(heading, age, row, error)) {
      return false;
    }
    const double spread = dot(row, times_covariance(row)) + variance;
    const bool inside = error * error <= gate * gate * spread;
    compared = {error, spread, gate, false, Aid::HEADING,
                inside ? Outcome::FUSED : Outcome::REJECTED};
    return true;
  }

  Correction correct_heading(double heading, double variance, double age, double gate) {
    if (!usable(heading, variance, age)) {
      return {heading, variance, gate, false, Aid::HEADING, Outcome::NOT_FINITE};
    }
    State row;
    double error;
    if (!by_heading(heading, age, row, error)) {
      const double spread = covariance_[DOWN][DOWN] + variance;
      return {error, spread, gate, false, Aid::HEADING, Outcome::UNOBSERVABLE};
    }
    if (!aligned_) {
      return reset_heading(heading, variance, age, gate);
    }
    return fuse_all<1>(Aid::HEADING, {row}, {error}, {variance}, gate)[0];
  }

  Correction reset_heading(double heading, double variance, double age, double gate) {
    if (!usable(heading, variance, age)) {
      return {heading, variance, gate, false, Aid::HEADING, Outcome::NOT_FINITE};
    }
    age = true_age(age);
    const double error = wrap(heading - wrong_[0] - yaw(attitude_before(age)));
    const double spread = covariance_[DOWN][DOWN] + variance;
    turn({0.0, 0.0, error});
    const double cosine = std::cos(error), sine = std::sin(error), late = yaw_rate_before(age);
    for (std::size_t j = 0; j < STATES; ++j) {  // rows, then columns, by the same rotation
      const double north = covariance_[0][j], east = covariance_[1][j];
      covariance_[0][j] = cosine * north - sine * east;
      covariance_[1][j] = sine * north + cosine * east;
      covariance_[DOWN][j] = late * covariance_[LATE][j] - covariance_[OFFSET][j];
    }
    for (std::size_t i = 0; i < STATES; ++i) {
      double* row = covariance_[i];
      const double north = row[0], east = row[1];
      row[0] = cosine * north - sine * east;
      row[1] = sine * north + cosine * east;
      row[DOWN] = late * row[LATE] - row[OFFSET];
    }
    symmetrise();
    covariance_[DOWN][DOWN] += std::min(variance, PI * PI);
    if (!aligned_) {
      doubt_bias_for_earth_rate();
    }
    aligned_ = true;
    ++resets_;
    return {error, spread, gate, true, Aid::HEADING, Outcome::RESET};
  }

  void doubt_bias(double rate) {
    const Matrix matrix_nb = matrix(attitude());
    for (std::size_t i = 0; i < 3; ++i) {
      for (std::size_t j = 0; j < 3; ++j) {
        covariance_[BIAS + i][BIAS + j] += rate * rate * (matrix_nb[2][i] * matrix_nb[2][j]);
      }
    }
  }

  Corrections correct_gravity(const Gravity& gravity) {
    const auto [north, east, down] = gravity.less(force_errors_);
    const double level = std::hypot(north, east), size = std::hypot(north, east, down);
    const double most = c.LARGEST_FORCE * c.LARGEST_FORCE;
    if (!(0.1 * c.GRAVITY < size && size < c.LARGEST_FORCE) ||
        !(0.0 < gravity.forward && gravity.forward < most) ||
        !(0.0 < gravity.right && gravity.right < most)) {
      return {{size, 1.0, c.gate, false, Aid::GRAVITY, Outcome::NOT_FINITE}};
    }
    const double angle = level > 1e-9 * size ? std::atan2(level, down) / level : 1.0 / size;
    const std::array<double, 2> about_n{east * angle, -north * angle};
    const double scale = 1.0 / (size * size);
    const std::array<double, 2> variances{gravity.right * scale, gravity.forward * scale};
    if (!levelled_) {
      if (sets_tilt(about_n, std::max(variances[0], variances[1]))) {
        return set_level(about_n, gravity, variances);
      }
      levelled_ = true;
    }
    const auto rows = level_rows(yaw(attitude()), gravity, size);
    const std::array<double, 2> errors{rows[0][0] * about_n[0] + rows[0][1] * about_n[1],
                                       rows[1][0] * about_n[0] + rows[1][1] * about_n[1]};
    Corrections corrections = fuse_all<2>(Aid::GRAVITY, rows, errors, variances, c.gate);
    if (distrusts(Aid::GRAVITY, resting() ? 0.0 : c.gravity_distrust)) {
      const double doubt = errors[0] * errors[0] + errors[1] * errors[1];
      covariance_[0][0] += doubt;
      covariance_[1][1] += doubt;
      corrections = fuse_all<2>(Aid::GRAVITY, rows, errors, variances, c.gate);
    }
    if (corrections[0].fused() && gravity.down < most) {
      learn_size(gravity);
    }
    return corrections;
  }

  Corrections correct_zero_rate(const Vector& rate_b, const Vector& variance, bool confirmed) {
    for (std::size_t i = 0; i < 3; ++i) {
      if (!(std::abs(rate_b[i]) < c.LARGEST_RATE) || !(variance[i] > 0.0) ||
          !(variance[i] < c.LARGEST_RATE * c.LARGEST_RATE)) {
        return {{NaN, 1.0, c.gate, false, Aid::REST, Outcome::NOT_FINITE}};
      }
    }
    const Vector earth = earth_rate();
    const Matrix matrix_nb = matrix(attitude());
    std::array<double, 3> errors;
    std::array<State, 3> rows{};
    for (std::size_t i = 0; i < 3; ++i) {
      const double turned = earth[0] * matrix_nb[0][i] + earth[1] * matrix_nb[1][i] +
                            earth[2] * matrix_nb[2][i];
      errors[i] = rate_b[i] - bias_[i] - turned;
      rows[i][BIAS + i] = 1.0;
    }
    Corrections corrections = fuse_all<3>(Aid::REST, rows, errors, variance, c.gate);
    if (corrections[0].fused()) {
      rested_ = elapsed_;
    } else if (confirmed && distrusts(Aid::REST, c.distrust)) {
      for (std::size_t i = BIAS; i < BIAS + 3; ++i) {
        covariance_[i][i] += dot(errors, errors);
      }
      return fuse_all<3>(Aid::REST, rows, errors, variance, c.gate);
    }
    return corrections;
  }

 private:
  // `Step` of gap.py, and whether it has a gap.
  struct Step {
    Vector rate_b;
    double told;
    Vector unseen;
    bool has_gap;
  };
  struct Instant {
    double time;
    Quaternion by_rate;
  };
  struct Rejecting {
    double began = INFINITE, last = -INFINITE;
  };

  static bool usable(double heading, double variance, double age) {
    return std::isfinite(heading) && 0.0 < variance && variance < INFINITE && 0.0 <= age &&
           age < INFINITE;
  }

  State times_covariance(const State& row) const {
    State column;
    for (std::size_t i = 0; i < STATES; ++i) {
      double sum = 0.0;
      for (std::size_t j = 0; j < STATES; ++j) {
        sum += covariance_[i][j] * row[j];
      }
      column[i] = sum;
    }
    return column;
  }

  // `Gaps.take` of gap.py.
  Step take(const Vector& before_b, const std::array<bool, 3>& known, double dt) {
    const double usual = usual_ > 0.0 ? usual_ : dt;
    usual_ = usual * (dt > usual ? c.USUAL_MORE : c.USUAL_LESS);
    Step step{rate_, dt, {}, false};
    if (!(dt > c.GAP * usual)) {
      const double weight = dt / (dt + c.SHAKEN_TIME);
      for (std::size_t i = 0; i < 3; ++i) {
        if (known[i]) {
          const double change = rate_[i] - before_b[i];
          shaken_[i] += weight * (change * change / dt - shaken_[i]);
        }
      }
      return step;
    }
    const double gap = dt - usual, bridged = std::min(gap, 2.0 * c.END_TIME);
    step.told = dt - gap + bridged;
    const double decided = c.UNSEEN_CHANGE * gap * gap;
    for (std::size_t i = 0; i < 3; ++i) {
      step.rate_b[i] += (before_b[i] - rate_[i]) * (0.5 * bridged / step.told);
      if (known[i]) {
        step.unseen[i] = shaken_[i] * (gap * gap * gap) / 12.0 + decided * decided;
        step.has_gap = true;
      }
    }
    return step;
  }

  Vector rotation(const Step& step) {
    const Vector now{step.rate_b[0] * step.told, step.rate_b[1] * step.told,
                     step.rate_b[2] * step.told};
    const bool follows = !(in_gap_ || step.has_gap) && step.told < c.LONG_STEP;
    const Vector last = follows ? turned_ : Vector{};
    turned_ = now;
    in_gap_ = step.has_gap;
    return {now[0] + (last[1] * now[2] - last[2] * now[1]) / 12.0,
            now[1] + (last[2] * now[0] - last[0] * now[2]) / 12.0,
            now[2] + (last[0] * now[1] - last[1] * now[0]) / 12.0};
  }

  Vector see(const std::array<bool, 3>& known, double dt, bool has_gap) {
    Vector variance{};
    for (std::size_t i = 0; i < 3; ++i) {
      if (!known[i] || (dt > c.LONG_STEP && !has_gap)) {
        const double before = unseen_turn(unseen_[i]), after = unseen_turn(unseen_[i] + dt);
        variance[i] = after * after - before * before;
        unseen_[i] += dt;
      }
      unseen_[i] = known[i] ? 0.0 : unseen_[i];
    }
    return variance;
  }

  double unseen_turn(double time) const {
    return c.UNKNOWN_RATE * time * std::min(time / c.LONG_STEP, 1.0);
  }

  void spread(const ByErrors& drive_nb, const FusedAxis* fused, const Vector& unseen, double told,
              double dt) {
    const std::array<double, 2> before{covariance_[0][0], covariance_[1][1]};
    ByErrors turned_nb;
    for (std::size_t i = 0; i < 3; ++i) {
      for (std::size_t j = 0; j < ERRORS; ++j) {
        turned_nb[i][j] = drive_nb[i][j] * told;
      }
    }
    carry(turned_nb);
    const auto [angle, walk] = noise(fused, unseen, told, dt);
    Matrix among;
    for (std::size_t i = 0; i < 3; ++i) {
      for (std::size_t j = 0; j < 3; ++j) {
        double by_gyro = 0.0, by_noise = 0.0;
        for (std::size_t k = 0; k < ERRORS; ++k) {
          by_gyro += covariance_[i][GYRO + k] * turned_nb[j][k];
        }
        for (std::size_t k = 0; k < 3; ++k) {
          by_noise += drive_nb[i][k] * angle[k] * drive_nb[j][k];
        }
        among[i][j] = covariance_[i][j] - by_gyro + by_noise;
      }
    }
    for (std::size_t i = 0; i < 3; ++i) {
      for (std::size_t j = 0; j < 3; ++j) {
        covariance_[i][j] = (among[i][j] + among[j][i]) / 2.0;
      }
    }
    for (std::size_t j = 3; j < STATES; ++j) {
      for (std::size_t i = 0; i < 3; ++i) {
        covariance_[j][i] = covariance_[i][j];
      }
    }
    forget(dt);
    for (std::size_t i = 0; i < 3; ++i) {
      covariance_[BIAS + i][BIAS + i] += walk[i];
    }
    if (unseen[0] + unseen[1] + unseen[2] > 0.0) {
      keep_level(before);
    }
    bound();
  }

  // Rows of the attitude's error, of which the gyro's errors have turned some part.
  RISAF_FAST void carry(const ByErrors& turned_nb) {
    for (std::size_t i = 0; i < 3; ++i) {
      double row[PADDED];
      std::copy_n(covariance_[i], PADDED, row);
      for (std::size_t k = 0; k < ERRORS; ++k) {
        const double by = turned_nb[i][k];
        const double* const error = covariance_[GYRO + k];
        for (std::size_t j = 0; j < PADDED; ++j) {
          row[j] -= by * error[j];
        }
      }
      std::copy_n(row, PADDED, covariance_[i]);
    }
  }

  // What is wrong with the headings becomes another.
  void forget(double dt) {
    if (dt != kept_dt_) {
      kept_ = {std::exp(-dt / c.OFFSET_TIME), std::exp(-dt / c.LATE_TIME)};
      kept_dt_ = dt;
    }
    for (std::size_t k = 0; k < 2; ++k) {
      const double kept = kept_[k];
      double* const row = covariance_[OFFSET + k];
      wrong_[k] *= kept;
      for (std::size_t j = 0; j < PADDED; ++j) {
        row[j] *= kept;
      }
      row[OFFSET + k] = row[OFFSET + k] * kept + wrong_variance_[k] * (1.0 - kept * kept);
      for (std::size_t j = 0; j < STATES; ++j) {
        covariance_[j][OFFSET + k] = row[j];
      }
    }
  }

  std::pair<Vector, Vector> noise(const FusedAxis* fused, const Vector& unseen, double told,
                                  double dt) const {
    const double common = c.common_noise * c.common_noise * dt +
                          c.turn_error * c.turn_error * std::sqrt(dot(turned_, turned_));
    Vector angle, walk;
    for (std::size_t i = 0; i < 3; ++i) {
      const double noise = fused[i].noise, bias_walk = fused[i].bias_walk;
      const bool known = 0.0 <= noise && noise < c.LARGEST_RATE * c.LARGEST_RATE;
      const bool walks = 0.0 <= bias_walk && bias_walk < c.LARGEST_RATE;
      angle[i] = (known ? noise * told * told : 0.0) + common + unseen[i];
      walk[i] = ((walks ? bias_walk * bias_walk : 0.0) + c.common_bias_walk * c.common_bias_walk) * dt;
    }
    return {angle, walk};
  }

  void bound() {
    if (std::max({covariance_[0][0], covariance_[1][1], covariance_[2][2]}) <= PI * PI) {
      return;
    }
    State scale;
    scale.fill(1.0);
    for (std::size_t i = 0; i < 3; ++i) {
      scale[i] = std::min(PI / std::sqrt(covariance_[i][i]), 1.0);
    }
    for (std::size_t i = 0; i < STATES; ++i) {
      for (std::size_t j = 0; j < STATES; ++j) {
        covariance_[i][j] *= scale[i] * scale[j];
      }
    }
  }

  void keep_level(const std::array<double, 2>& before) {
    const double down = std::clamp(matrix(attitude())[2][2], 0.0, 1.0);
    const double level = 2.0 * c.initial_tilt_std * c.initial_tilt_std + 1.0 - down * down;
    State scale;
    scale.fill(1.0);
    for (std::size_t i = 0; i < 2; ++i) {
      scale[i] = std::min(std::sqrt(std::max(before[i], level) / covariance_[i][i]), 1.0);
    }
    for (std::size_t i = 0; i < STATES; ++i) {
      for (std::size_t j = 0; j < STATES; ++j) {
        covariance_[i][j] *= scale[i] * scale[j];
      }
    }
  }

  Vector earth_rate() const {
    return {aligned_ ? earth_[0] : 0.0, earth_[1], earth_[2]};
  }

  void doubt_bias_for_earth_rate() {
    const double level = earth_[0];
    const Matrix matrix_nb = matrix(attitude());
    for (std::size_t i = 0; i < 3; ++i) {
      for (std::size_t j = 0; j < 3; ++j) {
        covariance_[BIAS + i][BIAS + j] +=
            level * level * (matrix_nb[0][i] * matrix_nb[0][j] + matrix_nb[1][i] * matrix_nb[1][j]);
      }
    }
  }

  bool sets_tilt(const std::array<double, 2>& about_n, double variance) const {
    const double x = covariance_[0][0], y = covariance_[1][1], gate = c.gate * c.gate;
    return variance < std::min(x, y) || about_n[0] * about_n[0] > gate * (x + variance) ||
           about_n[1] * about_n[1] > gate * (y + variance);
  }

  Corrections set_level(const std::array<double, 2>& about_n, const Gravity& gravity,
                        const std::array<double, 2>& variances) {
    Corrections corrections;
    for (std::size_t i = 0; i < 2; ++i) {
      const double spread = covariance_[i][i] + variances[i];
      corrections.push_back({about_n[i], spread, c.gate, true, Aid::GRAVITY, Outcome::RESET});
    }
    const Vector angle_n{about_n[0], about_n[1], 0.0};
    turn(angle_n);
    for (std::size_t i = 0; i < 2; ++i) {
      for (std::size_t j = 0; j < STATES; ++j) {
        covariance_[i][j] = covariance_[j][i] = 0.0;
      }
      covariance_[i][i] = PI * PI;
    }
    const Matrix turned = matrix(exp(angle_n));
    Gravity upright = gravity;
    upright.lever = turned * gravity.lever;
    upright.by_errors = turned * gravity.by_errors;
    for (const State& row : level_rows(0.0, upright, c.GRAVITY)) {
      gain(row, std::max(variances[0], variances[1]));
    }
    levelled_ = true;
    return corrections;
  }

  void learn_size(const Gravity& gravity) {
    State row{};
    const Vector gravity_n = gravity.less(force_errors_);
    for (std::size_t j = 0; j < ERRORS; ++j) {
      row[ACCELEROMETER + j] = -gravity.by_errors[DOWN][j];
    }
    const double size = std::sqrt(dot(gravity_n, gravity_n));
    fuse_all<1>(Aid::SIZE, {row}, {size - c.GRAVITY}, {gravity.down}, c.gate);
  }

  void turn(const Vector& angle_n) { correction_ = unit(product(exp(angle_n), correction_)); }

  template <std::size_t N>
  Corrections fuse_all(Aid source, const std::array<State, N>& rows,
                       const std::array<double, N>& errors, const std::array<double, N>& variances,
                       double gate) {
    std::array<double, N> spreads;
    bool passed = true;
    for (std::size_t i = 0; i < N; ++i) {
      spreads[i] = dot(rows[i], times_covariance(rows[i])) + variances[i];
      passed &= errors[i] * errors[i] <= gate * gate * spreads[i];
    }
    note(source, passed);
    if (passed) {
      State change{};
      for (std::size_t i = 0; i < N; ++i) {
        const double error = errors[i] - dot(rows[i], change);
        const State by = gain(rows[i], variances[i]);
        for (std::size_t j = 0; j < STATES; ++j) {
          change[j] += by[j] * error;
        }
      }
      turn({change[0], change[1], change[2]});
      for (std::size_t j = 0; j < 3; ++j) {
        bias_[j] += change[BIAS + j];
      }
      for (std::size_t j = 0; j < 9; ++j) {
        scale_[j] += change[SCALE + j];
      }
      for (std::size_t j = 0; j < ERRORS; ++j) {
        force_errors_[j] += change[ACCELEROMETER + j];
      }
      wrong_[0] += change[OFFSET];
      wrong_[1] += change[LATE];
    }
    Corrections corrections;
    for (std::size_t i = 0; i < N; ++i) {
      corrections.push_back({errors[i], spreads[i], gate, false, source,
                             passed ? Outcome::FUSED : Outcome::REJECTED});
    }
    return corrections;
  }

  State gain(const State& row, double variance) {
    const State column = times_covariance(row);
    const double spread = dot(row, column) + variance;
    State gain;
    for (std::size_t i = 0; i < STATES; ++i) {
      gain[i] = column[i] / spread;
    }
    for (std::size_t i = 0; i < STATES; ++i) {
      for (std::size_t j = 0; j < STATES; ++j) {
        covariance_[i][j] -= gain[i] * column[j];
      }
    }
    const State remaining = times_covariance(row);
    for (std::size_t i = 0; i < STATES; ++i) {
      const double added = variance * gain[i] - remaining[i];
      for (std::size_t j = 0; j < STATES; ++j) {
        covariance_[i][j] += added * gain[j];
      }
    }
    symmetrise();
    return gain;
  }

  void symmetrise() {
    for (std::size_t i = 0; i < STATES; ++i) {
      for (std::size_t j = 0; j < i; ++j) {
        covariance_[i][j] = covariance_[j][i] = (covariance_[i][j] + covariance_[j][i]) / 2.0;
      }
    }
  }

  void note(Aid source, bool passed) {
    Rejecting& run = rejecting_[static_cast<std::size_t>(source)];
    if (passed) {
      run = {};
      return;
    }
    if (!(elapsed_ - run.last <= c.LARGEST_GAP)) {
      run.began = elapsed_;
    }
    run.last = elapsed_;
  }

  bool distrusts(Aid source, double after) const {
    const Rejecting& run = rejecting_[static_cast<std::size_t>(source)];
    return run.last == elapsed_ && run.last - run.began >= after;
  }

  // Derivative of a heading by the error, and the innovation; false: it says nothing of yaw.
  bool by_heading(double heading, double age, State& row, double& error) const {
    age = true_age(age);
    const Matrix matrix_then = matrix(attitude_before(age));
    error = wrap(heading - wrong_[0] - std::atan2(matrix_then[1][0], matrix_then[0][0]));
    if (std::abs(matrix_then[2][0]) > c.STEEP) {
      return false;
    }
    row = by_yaw(matrix_then, age);
    row[OFFSET] = 1.0;
    row[LATE] = -yaw_rate_before(age);
    return true;
  }

  double true_age(double told) const { return std::max(told + wrong_[1], 0.0); }

  // `yaw_row` of error_state.py.
  State by_yaw(const Matrix& matrix_nb, double age) const {
    State row{};
    row[DOWN] = 1.0;
    const double north = matrix_nb[0][0], east = matrix_nb[1][0], down = matrix_nb[2][0];
    const double level = std::max(north * north + east * east, 1.0 - c.STEEP * c.STEEP);
    row[0] = -down * north / level;
    row[1] = -down * east / level;
    const ByErrors driven = drive(matrix_nb, rate_);
    for (std::size_t j = 0; j < ERRORS; ++j) {
      const double turned = row[0] * driven[0][j] + row[1] * driven[1][j] + row[2] * driven[2][j];
      row[GYRO + j] = turned * age;
    }
    return row;
  }

  static std::array<State, 2> level_rows(double yaw, const Gravity& gravity, double size) {
    std::array<State, 2> about{}, rows;
    about[0][0] = about[1][1] = 1.0;
    for (std::size_t j = 0; j < ERRORS; ++j) {
      about[0][GYRO + j] = gravity.lever[0][j];
      about[1][GYRO + j] = gravity.lever[1][j];
      about[0][ACCELEROMETER + j] = gravity.by_errors[1][j] / -size;
      about[1][ACCELEROMETER + j] = gravity.by_errors[0][j] / size;
    }
    const double cosine = std::cos(yaw), sine = std::sin(yaw);
    for (std::size_t j = 0; j < STATES; ++j) {
      rows[0][j] = cosine * about[0][j] + sine * about[1][j];
      rows[1][j] = cosine * about[1][j] - sine * about[0][j];
    }
    return rows;
  }

  double yaw_rate_before(double age) const {
    const double since = age + c.RATE_SPAN, until = std::max(age - c.RATE_SPAN, 0.0);
    if (!(until < since && since < INFINITE)) {
      return 0.0;
    }
    const double turned = yaw(attitude_before(until)) - yaw(attitude_before(since));
    return wrap(turned) / (since - until);
  }

  void remember() {
    newest_ = (newest_ + 1) % history_.size();
    history_[newest_] = {elapsed_, by_rate_};
    remembered_ = std::min(remembered_ + 1, history_.size());
  }

  // Attitude of `age` seconds ago, as known now; before the oldest by the present rate.
  Quaternion attitude_before(double age) const {
    const double time = elapsed_ - age;
    const Instant* later = nullptr;
    for (std::size_t i = 0; i < remembered_; ++i) {
      const Instant& earlier = history_[(newest_ + history_.size() - i) % history_.size()];
      if (earlier.time <= time) {
        if (!later || later->time <= earlier.time) {
          return product(correction_, earlier.by_rate);
        }
        const double part = (time - earlier.time) / (later->time - earlier.time);
        return product(correction_, between(earlier.by_rate, later->by_rate, part));
      }
      later = &earlier;
    }
    const Instant oldest = later ? *later : Instant{elapsed_, by_rate_};
    const double missing = std::min(oldest.time - time, c.LONG_STEP);
    const Quaternion back = exp({-rate_[0] * missing, -rate_[1] * missing, -rate_[2] * missing});
    return product(correction_, product(oldest.by_rate, back));
  }

  FilterNumbers c;
  Quaternion by_rate_, correction_;
  Vector bias_{}, rate_{}, unseen_{}, turned_{}, shaken_{};
  Vector earth_{};  // rad/s, ned; none until the latitude is known
  double usual_ = 0.0;
  bool in_gap_ = false;
  std::array<double, 9> scale_{};
  Errors force_errors_{};
  ByErrors drive_ib_{};
  alignas(64) double covariance_[STATES][PADDED] = {};
  std::array<double, 2> wrong_{}, wrong_variance_{}, kept_{};
  double kept_dt_ = NaN, latitude_ = NaN, elapsed_ = 0.0, rested_ = -INFINITE;
  bool aligned_ = false, levelled_ = false;
  int resets_ = 0;
  std::vector<Instant> history_;
  std::size_t newest_ = 0, remembered_ = 0;
  std::array<Rejecting, 4> rejecting_{};
};

}  // namespace risaf
