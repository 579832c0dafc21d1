// Vectors, matrices and quaternions of one rotation; as quaternion.py.
#pragma once

#include <array>
#include <cmath>
#include <cstddef>

namespace risaf {

using Vector = std::array<double, 3>;
using Matrix = std::array<Vector, 3>;  // row by row

struct Quaternion {
  double w = 1.0, x = 0.0, y = 0.0, z = 0.0;
};

inline Quaternion product(const Quaternion& p, const Quaternion& q) {
  return {p.w * q.w - p.x * q.x - p.y * q.y - p.z * q.z,
          p.w * q.x + p.x * q.w + p.y * q.z - p.z * q.y,
          p.w * q.y - p.x * q.z + p.y * q.w + p.z * q.x,
          p.w * q.z + p.x * q.y - p.y * q.x + p.z * q.w};
}

inline Quaternion exp(const Vector& angle) {
  const double norm = std::sqrt(angle[0] * angle[0] + angle[1] * angle[1] + angle[2] * angle[2]);
  const double part = norm > 1e-9 ? std::sin(norm / 2.0) / norm : 0.5;
  return {std::cos(norm / 2.0), part * angle[0], part * angle[1], part * angle[2]};
}

inline Quaternion unit(const Quaternion& q) {
  const double norm = std::sqrt(q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z);
  return {q.w / norm, q.x / norm, q.y / norm, q.z / norm};
}

inline Quaternion between(const Quaternion& p, const Quaternion& q, double part) {
  return unit({p.w + part * (q.w - p.w), p.x + part * (q.x - p.x), p.y + part * (q.y - p.y),
               p.z + part * (q.z - p.z)});
}

inline double yaw(const Quaternion& q) {
  return std::atan2(2.0 * (q.w * q.z + q.x * q.y), q.w * q.w + q.x * q.x - q.y * q.y - q.z * q.z);
}

inline Matrix matrix(const Quaternion& q) {
  const auto [w, x, y, z] = q;
  return {{{w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)},
           {2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)},
           {2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z}}};
}

template <std::size_t N>
double dot(const std::array<double, N>& a, const std::array<double, N>& b) {
  double sum = 0.0;
  for (std::size_t i = 0; i < N; ++i) {
    sum += a[i] * b[i];
  }
  return sum;
}

inline bool finite(const Vector& v) {
  return std::isfinite(v[0]) && std::isfinite(v[1]) && std::isfinite(v[2]);
}

inline Vector operator*(const Matrix& m, const Vector& v) {
  return {dot(m[0], v), dot(m[1], v), dot(m[2], v)};
}

constexpr double PI = 3.141592653589793;

// As `wrap` of rotation.py: into (-pi, pi].
inline double wrap(double angle) {
  const double remainder = std::remainder(angle, 2.0 * PI);
  return remainder == -PI ? PI : remainder;
}

}  // namespace risaf
