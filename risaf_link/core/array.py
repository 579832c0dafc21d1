"""Calibration of an array: raw readings of n sensors -> rates in the body frame."""

from typing import Annotated

import numpy as np
from msgspec import Meta, Struct, field

from risaf_link.core.rotation import Floats, matrix_from_quaternion

Vector = Annotated[list[float], Meta(min_length=3, max_length=3)]


class TriadCalibration(Struct, frozen=True, forbid_unknown_fields=True):
    """What turns a triad's raw reading u into its true value: `R M diag(scale) (u - bias)`.

    Skog et al., "Calibration of a MEMS inertial measurement unit", 2006, writes the same model.
    """

    bias: Vector = field(default_factory=lambda: [0.0, 0.0, 0.0])
    """rad/s or m/s^2, in the sensor's own axes, as read."""
    scale: Vector = field(default_factory=lambda: [1.0, 1.0, 1.0])
    """True value per reading, each axis."""
    misalignment: Annotated[list[float], Meta(min_length=6, max_length=6)] = field(
        default_factory=lambda: [0.0] * 6
    )
    """Off-diagonal elements of M, which is 1 on its diagonal: xy, xz, yx, yz, zx, zy; rad."""
    mounting: Annotated[list[float], Meta(min_length=4, max_length=4)] = field(
        default_factory=lambda: [1.0, 0.0, 0.0, 0.0]
    )
    """Quaternion (w, x, y, z) of R: sensor to body. Its length does not matter."""


class ArrayCalibration(Struct, frozen=True, forbid_unknown_fields=True):
    """Calibration of every sensor of one array, as it stands in a file."""

    gyros: Annotated[list[TriadCalibration], Meta(min_length=1)]
    accels: list[TriadCalibration] = field(default_factory=list)
    name: str = ""
    """IMU_ARRAY_INFO.name of the array that it belongs to; empty: any."""


class Calibration:
    """A calibration, ready to be applied to all sensors at once.

    Parameters
    ----------
    array : ArrayCalibration

    Raises
    ------
    ValueError
        If a mounting is no rotation, or if there are more accelerometers than gyros.
    """

    def __init__(self, array: ArrayCalibration) -> None:
        if len(array.accels) > len(array.gyros):
            raise ValueError(f"accels: {len(array.accels)}, expected at most {len(array.gyros)}")
        self._name = array.name
        self._gyros = _Triads("gyros", array.gyros)
        self._accels = _Triads("accels", array.accels)

    def mismatch(self, sensors: int, name: str) -> str:
        """Why this is not the calibration of an array, in one line; empty if it may be.

        Parameters
        ----------
        sensors : int
            Gyros that the array has.
        name : str
            Name of the array; empty: not known.
        """
        if self._name and name and self._name != name:
            return f"the calibration is for array {self._name!r}, this is {name!r}"
        if sensors > len(self._gyros.bias):
            return (
                f"the calibration is for {len(self._gyros.bias)} sensors, the array has {sensors}"
            )
        return ""

    def apply(self, rates_s: Floats, forces_s: Floats) -> tuple[Floats, Floats]:
        """Correct the readings of one epoch.

        Parameters
        ----------
        rates_s, forces_s : ndarray, shapes (n, 3) and (m, 3)
            Raw readings, each in its sensor's own axes; NaN where not valid. The first n and m
            sensors are meant. Accelerometers without a calibration stay as they are.

        Returns
        -------
        rates_b, forces_b : ndarray, shapes (n, 3) and (m, 3)
            In the body frame. A reading that is not valid spoils the other axes of its sensor as
            far as they depend on it.
        """
        calibrated = self._accels.apply(forces_s[: len(self._accels.bias)])
        return self._gyros.apply(rates_s), np.vstack([calibrated, forces_s[len(calibrated) :]])


class _Triads:
    """Calibration of all triads of one quantity."""

    def __init__(self, what: str, triads: list[TriadCalibration]) -> None:
        n = len(triads)
        mounting = np.array([t.mounting for t in triads], dtype=float).reshape(n, 4)
        length = np.linalg.norm(mounting, axis=1)
        for bad in np.flatnonzero(~((length > 0) & np.isfinite(length))):
            raise ValueError(f"{what}[{bad}].mounting: {triads[bad].mounting} is no rotation")
        shape = np.tile(np.eye(3), (n, 1, 1))
        shape[:, ~np.eye(3, dtype=bool)] = np.array([t.misalignment for t in triads]).reshape(n, 6)
        scale = np.array([t.scale for t in triads], dtype=float).reshape(n, 3)
        self.bias = np.array([t.bias for t in triads], dtype=float).reshape(n, 3)
        rotation_bs = matrix_from_quaternion(mounting / length[:, None])
        self._matrix = (rotation_bs @ shape) * scale[:, None, :]

    def apply(self, readings_s: Floats) -> Floats:
        matrix = self._matrix[: len(readings_s)]
        centred = readings_s - self.bias[: len(readings_s)]
        parts = np.where(matrix == 0.0, 0.0, matrix * centred[:, None, :])
        corrected: Floats = parts.sum(axis=2)
        return corrected
