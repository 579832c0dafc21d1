// From the readings of an array to the attitude, epoch by epoch: fuse, predict, aid.
#pragma once

#include <cstddef>
#include <cstdint>

#include "aiding.hpp"
#include "eskf.hpp"
#include "robust.hpp"

namespace risaf {

// What is known after one epoch, as a row of doubles; track.py names them.
struct Known {
  double q_nb[4], rate_b[3], bias_b[3], angle_std[3], aligned, resets;
  double fused[3], variance[3], noise[3], bias_walk[3], active[3], valid;
  double ahead;
  double common[3], bias_std[3];
};

// Carry the attitude on over `epochs`, with readings of `n` gyros and `m` accelerometers each.
template <typename Fusion>
void advance(Fusion& gyros, Robust& accelerometers, Eskf& filter, Aiding& aiding,
             std::size_t epochs, const double* dt, const double* rates_b, std::size_t n,
             const double* forces_b, std::size_t m, Known* known) {
  for (std::size_t i = 0; i < epochs; ++i, ++known, rates_b += 3 * n, forces_b += 3 * m) {
    FusedAxis fused[3], felt[3];
    const std::int64_t valid = gyros.fuse(dt[i], rates_b, n, fused);
    filter.predict(fused, dt[i]);
    Vector force_b{NaN, NaN, NaN};
    if (m > 0) {
      accelerometers.fuse(dt[i], forces_b, m, felt);
      force_b = {felt[0].rate, felt[1].rate, felt[2].rate};
    }
    aiding.take(filter, {fused[0].rate, fused[1].rate, fused[2].rate}, force_b, dt[i]);
    const Quaternion q_nb = filter.attitude();
    const auto [std, common] = filter.angle_spread();
    const Vector bias_std = filter.bias_std();
    known->q_nb[0] = q_nb.w;
    known->q_nb[1] = q_nb.x;
    known->q_nb[2] = q_nb.y;
    known->q_nb[3] = q_nb.z;
    for (std::size_t k = 0; k < 3; ++k) {
      known->rate_b[k] = filter.rate()[k];
      known->bias_b[k] = filter.bias()[k];
      known->angle_std[k] = std[k];
      known->common[k] = common[k];
      known->bias_std[k] = bias_std[k];
      known->fused[k] = fused[k].rate;
      known->variance[k] = fused[k].variance;
      known->noise[k] = fused[k].noise;
      known->bias_walk[k] = fused[k].bias_walk;
      known->active[k] = static_cast<double>(fused[k].active);
    }
    const double up = 2.0 * (q_nb.x * q_nb.z - q_nb.w * q_nb.y);
    known->ahead = force_b[0] + filter.numbers().GRAVITY * up;
    known->aligned = filter.aligned();
    known->resets = filter.resets();
    known->valid = static_cast<double>(valid);
  }
}

}  // namespace risaf
