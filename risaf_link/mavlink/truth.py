"""The true attitude, where a simulator states it: for scoring only."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from risaf_link.core.rotation import Floats, quaternion_from_euler
from risaf_link.mavlink.dialect import IDS, name_of, reader
from risaf_link.mavlink.frame import Frame, FrameTable
from risaf_link.mavlink.tlog import Stamps

HIL_STATE = IDS["HIL_STATE_QUATERNION"]
HIL_HEAD = np.dtype([("time_us", "<u8"), ("q_nb", "<f4", 4)])  # how its payload begins

_read_hil_state = reader("HIL_STATE_QUATERNION", "time_usec", "attitude_quaternion")
_SIM_STATES = {
    IDS[name]: reader(name, "roll", "pitch", "yaw") for name in ("SIM_STATE", "SIMSTATE")
}


@dataclass(frozen=True, slots=True)
class Truth:
    """The true attitude at an instant."""

    time_us: int | None  # on the vehicle's clock; None: the message has no time
    q_nb: Floats


def truth_of(frame: Frame) -> Truth | None:
    """The true attitude, if a simulator states it in this frame."""
    if frame.message_id == HIL_STATE:
        time_us, q_nb = _read_hil_state(frame.payload)
        stated = any(q_nb) and all(map(math.isfinite, q_nb))
        return Truth(time_us, np.array(q_nb)) if stated else None
    if frame.message_id in _SIM_STATES:
        angles = _SIM_STATES[frame.message_id](frame.payload)
        stated = all(map(math.isfinite, angles))
        return Truth(None, quaternion_from_euler(*angles)) if stated else None
    return None


@dataclass(frozen=True, slots=True)
class Truths:
    """The true attitude at m instants."""

    time_us: Floats  # (m,)
    received_us: Stamps  # (m,)
    q_nb: Floats  # (m, 4)
    by_boot: bool  # whether the times are those of the vehicle's clock, not of the arrival
    message: str  # that states it


def truths_in(table: FrameTable, times_us: Stamps) -> Iterator[Truths]:
    """True attitudes that are stated in a table.

    Parameters
    ----------
    table : FrameTable
    times_us : ndarray of uint64
        When each frame came.
    """
    ids, sizes = table.cuts["message_id"], table.cuts["size"]
    whole = (ids == HIL_STATE) & (sizes >= HIL_HEAD.itemsize)
    starts = table.payloads[whole]
    payloads = np.frombuffer(table.buffer, np.uint8)[starts[:, None] + np.arange(HIL_HEAD.itemsize)]
    heads = payloads.view(HIL_HEAD)[:, 0]
    stated = np.isfinite(heads["q_nb"]).all(axis=1)
    stated[stated] = heads["q_nb"][stated].any(axis=1)
    received_us = times_us[whole][stated]
    sent_us, q_nb = (heads[name][stated].astype(float) for name in ("time_us", "q_nb"))
    yield Truths(sent_us, received_us, q_nb, True, name_of(HIL_STATE))
    others = np.isin(ids, [HIL_STATE, *_SIM_STATES]) & ~whole
    for row in np.flatnonzero(others).tolist():
        truth = truth_of(table.frame(row))
        if truth:
            by_boot = truth.time_us is not None
            time_us = truth.time_us if truth.time_us is not None else int(times_us[row])
            yield Truths(
                np.array([float(time_us)]),
                times_us[row : row + 1],
                truth.q_nb[np.newaxis],
                by_boot,
                name_of(int(ids[row])),
            )
