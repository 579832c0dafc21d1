"""Calibration of an array: raw readings of n sensors -> rates in the body frame."""

from typing import Annotated

import numpy as np
from msgspec import Meta, Struct, field

from risaf_link.core.rotation import Floats, matrix_from_quaternion

Vector = Annotated[list[float], Meta(min_length=3, max_length=3)]


class TriadCalibration(Struct, frozen=True, forbid_unknown_fields=True):
    """What turns a triad's raw reading u into its true value: `R M diag(scale) (u - bias)`.

    The model of Tedaldi, Pretto and Menegatti, "A robust and easy to implement method for IMU
    calibration without external equipments", ICRA 2014, as their IMU-TK states it
    (`X' = T K (X - B)`), with the mounting R besides.
    """

    bias: Vector = field(default_factory=lambda: [0.0, 0.0, 0.0])
    """rad/s or m/s^2, in the sensor's own axes, as read."""
    scale: Vector = field(default_factory=lambda: [1.0, 1.0, 1.0])
    """True value per reading, each axis; not 0."""
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
        In one line: which entry, what was found, what was expected. A value that is not finite, a
        scale of 0, a mounting that is no rotation, more accelerometers than gyros.
    """

    def __init__(self, array: ArrayCalibration) -> None:
        if len(array.accels) > len(array.gyros):
            raise ValueError(
                f"accels: found {len(array.accels)}, expected at most {len(array.gyros)}, as gyros"
            )
        self._name = array.name
        self._gyros = _Triads("gyros", array.gyros)
        self._accels = _Triads("accels", array.accels)

    def mismatch(self, sensors: int, name: str) -> str:
        """Why this is not the calibration of an array, in one line; empty if it may be.

        Parameters
        ----------
        sensors : int
            Gyros that the array has. There may be fewer than the calibration knows: the first.
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
        """Correct the readings of one epoch, or of many.

        Parameters
        ----------
        rates_s, forces_s : ndarray, shapes (..., n, 3) and (..., m, 3)
            Raw readings, rad/s and m/s^2, each in its sensor's own axes; NaN where not valid. The
            first n and m sensors are meant; n at most as many as are calibrated. Accelerometers
            without a calibration stay as they are.

        Returns
        -------
        rates_b, forces_b : ndarray, shapes (..., n, 3) and (..., m, 3)
            In the body frame. A reading that is not valid spoils the other axes of its sensor as
            far as they depend on it.
        """
        known = len(self._accels.bias)
        forces_b = self._accels.apply(forces_s[..., :known, :]), forces_s[..., known:, :]
        return self._gyros.apply(rates_s), np.concatenate(forces_b, axis=-2)


class _Triads:
    """Calibration of all triads of one quantity."""

    def __init__(self, what: str, triads: list[TriadCalibration]) -> None:
        for i, triad in enumerate(triads):
            _check(f"{what}[{i}]", triad)
        n = len(triads)
        mounting = np.array([t.mounting for t in triads], dtype=float).reshape(n, 4)
        rotation_bs = matrix_from_quaternion(mounting / np.linalg.norm(mounting, axis=1)[:, None])
        shape = np.tile(np.eye(3), (n, 1, 1))
        shape[:, ~np.eye(3, dtype=bool)] = np.array([t.misalignment for t in triads]).reshape(n, 6)
        scale = np.array([t.scale for t in triads], dtype=float).reshape(n, 3)
        self.bias = np.array([t.bias for t in triads], dtype=float).reshape(n, 3)
        self._matrix = np.moveaxis((rotation_bs @ shape) * scale[:, None, :], 0, 2).copy()
        self._unrelated = self._matrix == 0.0  # (3, 3, n): to, from, sensor

    def apply(self, readings_s: Floats) -> Floats:
        n = readings_s.shape[-2]
        centred = np.moveaxis(readings_s - self.bias[:n], -1, -2)[..., np.newaxis, :, :]
        parts = np.where(self._unrelated[:, :, :n], 0.0, self._matrix[:, :, :n] * centred)
        corrected: Floats = parts.sum(axis=-2)  # (..., to, n)
        return np.ascontiguousarray(np.moveaxis(corrected, -1, -2))


def _check(where: str, triad: TriadCalibration) -> None:
    for name in triad.__struct_fields__:
        values = getattr(triad, name)
        if not np.isfinite(values).all():
            raise ValueError(f"{where}.{name}: found {values}, expected finite numbers")
    if 0.0 in triad.scale:
        raise ValueError(f"{where}.scale: found {triad.scale}, expected numbers other than 0")
    if not 0.0 < np.linalg.norm(triad.mounting) < np.inf:
        raise ValueError(
            f"{where}.mounting: found {triad.mounting}, expected a quaternion, longer than 0"
        )
