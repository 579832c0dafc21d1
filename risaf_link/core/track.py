"""What is estimated at each of a run of epochs, as columns."""

import struct
from collections.abc import Iterable

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from risaf_link.core.attitude import AttitudeState
from risaf_link.core.earth import GRAVITY
from risaf_link.core.fusion import FusedRate
from risaf_link.core.rotation import Floats

Q_NB, RATE, BIAS, STD = slice(0, 4), slice(4, 7), slice(7, 10), slice(10, 13)
ALIGNED, RESETS = 13, 14
FUSED, VARIANCE, NOISE, WALK = slice(15, 18), slice(18, 21), slice(21, 24), slice(24, 27)
ACTIVE, VALID, AHEAD = slice(27, 30), 30, 31
COMMON, BIAS_STD = slice(32, 35), slice(35, 38)
COLUMNS = 38
YAW_STD = 12

attitude_and_rate = struct.Struct("7d").unpack_from
"""What stands in Q_NB and RATE of the bytes of one row."""


class Track(Struct, frozen=True):
    """Fused rates and attitudes of k epochs, one after another.

    Parameters
    ----------
    values : ndarray, shape (k, 38)
        The columns that this module names; units are those of `FusedRate` and `AttitudeState`.
    """

    values: Floats

    @classmethod
    def of(cls, epochs: Iterable[tuple[FusedRate, AttitudeState, Floats]]) -> "Track":
        """Put together what single epochs came to."""
        rows = [
            np.concatenate(
                (
                    *(state.q_nb, state.rate_b, state.bias_b),
                    (state.roll_std, state.pitch_std, state.yaw_std, state.aligned, state.resets),
                    *(fused.rate_b, fused.variance, fused.noise, fused.bias_walk, fused.active),
                    (fused.valid, _ahead(state.q_nb, force_b)),
                    *(state.common, state.bias_std),
                )
            )
            for fused, state, force_b in epochs
        ]
        return cls(np.array(rows).reshape(-1, COLUMNS))

    def __len__(self) -> int:
        return len(self.values)

    @property
    def q_nb(self) -> Floats:
        """Attitude, (k, 4)."""
        return self.values[:, Q_NB]

    @property
    def rate_b(self) -> Floats:
        """Rate, bias taken off, (k, 3), rad/s."""
        return self.values[:, RATE]

    @property
    def bias_b(self) -> Floats:
        """Bias of the fused rate, (k, 3), rad/s."""
        return self.values[:, BIAS]

    @property
    def fused_b(self) -> Floats:
        """Fused rate, before the bias is taken off, (k, 3), rad/s."""
        return self.values[:, FUSED]

    @property
    def variance(self) -> Floats:
        """Variance of one sensor behind the fused rate, (k, 3), (rad/s)^2."""
        return self.values[:, VARIANCE]

    @property
    def active(self) -> NDArray[np.int64]:
        """Sensors behind the fused rate, (k, 3)."""
        return self.values[:, ACTIVE].astype(np.int64)

    @property
    def angle_std(self) -> Floats:
        """Standard deviations of roll, pitch and yaw, (k, 3), rad."""
        return self.values[:, STD]

    @property
    def ahead(self) -> Floats:
        """Of the specific force what accelerates ahead, gravity taken off, (k,), m/s^2.

        NaN: there is no accelerometer.
        """
        return self.values[:, AHEAD]

    @property
    def yaw_std(self) -> Floats:
        """Standard deviation of yaw, (k,), rad."""
        return self.values[:, YAW_STD]

    @property
    def aligned(self) -> NDArray[np.bool_]:
        """Whether yaw has been set by a heading, (k,)."""
        return self.values[:, ALIGNED] > 0.0

    def fused(self, i: int, time_us: int) -> FusedRate:
        """The fused rate of one epoch."""
        row = self.values[i]
        active = row[ACTIVE].astype(np.int64)
        return FusedRate(
            time_us, row[FUSED], row[VARIANCE], active, int(row[VALID]), row[NOISE], row[WALK]
        )

    def attitude(self, i: int, time_us: int) -> AttitudeState:
        """The attitude at one epoch."""
        row = self.values[i]
        roll, pitch, yaw, aligned, resets = row[STD.start : RESETS + 1].tolist()
        known = aligned > 0.0, int(resets), row[COMMON], row[BIAS_STD]
        return AttitudeState(time_us, row[Q_NB], row[RATE], row[BIAS], roll, pitch, yaw, *known)


def _ahead(q_nb: Floats, force_b: Floats) -> float:
    w, x, y, z = q_nb.tolist()
    ahead: float = force_b[0].item() + GRAVITY * 2.0 * (x * z - w * y)
    return ahead
