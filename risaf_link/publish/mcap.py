"""Estimates as MCAP, with JSON messages and their schemas, for Foxglove, PlotJuggler and others.

The logged time of a message is when it was received, its published time that of the vehicle's boot
clock at which samples were taken. Every message of ours has `time_us`, the time as samples were
stamped. What is not known is left out.
"""

import math
from collections import deque
from collections.abc import Iterable, Sequence
from importlib.util import find_spec
from typing import BinaryIO, Self

import msgspec
import numpy as np

from risaf_link import __version__
from risaf_link.core.attitude import Innovation
from risaf_link.core.estimate import Estimate, EstimateBlock
from risaf_link.core.heading import HeadingState
from risaf_link.core.outage import Errors
from risaf_link.core.rotation import Floats, eulers_of
from risaf_link.errors import RisafError
from risaf_link.mavlink.notices import Severity
from risaf_link.mavlink.truth import Truths
from risaf_link.publish.events import Event, Events, Looks
from risaf_link.publish.mcap_schemas import (
    ACTIVE,
    ATTITUDE,
    AXES,
    FUSED,
    IN_DEGREES,
    QUATERNION,
    SCHEMAS,
    Message,
)

TURN = 0.04  # s, from one pose for a three-dimensional view to the next
HEALTH = 1.0  # s, from one account of every sensor to the next
REMEMBERED = 65536  # blocks: a reference may come as late as the scorer remembers epochs
LATEST_NS = (1 << 63) - 1
LEVELS = {  # of foxglove.Log
    Severity.CRITICAL: 5,
    Severity.ERROR: 4,
    Severity.WARNING: 3,
    Severity.NOTICE: 2,
    Severity.INFO: 2,
}
ENU_OF_NED = {"x": math.sqrt(0.5), "y": math.sqrt(0.5), "z": 0.0, "w": 0.0}
"""Quaternion from north-east-down to east-north-up, in which viewers stand."""


def require() -> None:
    """Make sure that MCAP can be written.

    Raises
    ------
    RisafError
        Without the package mcap.
    """
    if not find_spec("mcap"):
        raise RisafError("--mcap needs the package mcap: install risaf-link with the extra `mcap`")


class McapWriter:
    """Writes the estimates of one run.

    Parameters
    ----------
    file : binary file
        Written to; it ends when the block ends well that the writer is the context of.
    log : str
        Name of what was replayed.

    Raises
    ------
    RisafError
        Without the package mcap.
    """

    def __init__(self, file: BinaryIO, log: str) -> None:
        require()
        from mcap.writer import CompressionType, Writer

        self._writer = Writer(file, compression=CompressionType.ZSTD)
        self._writer.start(library=f"risaf-link {__version__}")
        self._writer.add_metadata("risaf_link", {"log": log, "version": __version__})
        self._channels: dict[str, int] = {}
        self._counts: dict[str, int] = {}
        self._looks, self._events = Looks(), Events()
        self._innovation: Innovation | None = None
        self._turned = self._told = -np.inf  # s: when a pose, and the sensors, were last written
        self._errors: list[Errors] = []  # wait until their times are known
        self._times: deque[tuple[float, ...]] = deque(maxlen=REMEMBERED)

    def take(self, block: EstimateBlock) -> None:
        """Write the next estimates."""
        self._write_epochs(block)
        self._write_poses(block)
        self._write_innovation(block)
        looked = self._looks.estimate if self._looks.look(block) else None
        if looked:
            self._write_look(block, looked)
        for event in self._events.take(block, looked):
            self._write_event(event)
        last = block.elapsed[-1], block.time_us[-1], block.received_us[-1], block.boot_us[-1]
        self._times.append(tuple(each.item() for each in last))
        self._write_errors()

    def take_truth(self, truths: Truths) -> None:
        """Write true attitudes."""
        angles = np.degrees(eulers_of(truths.q_nb)).T
        sent_us = np.minimum(truths.time_us, LATEST_NS // 1000).astype(np.int64)
        times_us = sent_us if truths.by_boot else np.zeros_like(sent_us)
        rows = _rows((*QUATERNION, *IN_DEGREES), np.hstack((truths.q_nb, angles)))
        received_us = truths.received_us.tolist()
        for time_us, came_us, row in zip(times_us.tolist(), received_us, rows, strict=True):
            self._write("/truth", came_us, time_us or came_us, {"time_us": time_us, **row})

    def take_errors(self, errors: Errors) -> None:
        """Write heading errors, as soon as the estimates have come that they are of."""
        self._errors.append(errors)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self._write_errors()
            self._writer.finish()  # type: ignore[no-untyped-call]

    def _write_epochs(self, block: EstimateBlock) -> None:
        track = block.track
        angles = np.degrees(np.hstack((eulers_of(track.q_nb).T, track.angle_std)))
        attitudes = _rows(ATTITUDE, np.hstack((track.q_nb, angles)))
        rates = _rows(FUSED, np.hstack((track.fused_b, track.variance)))
        times = (each.tolist() for each in (block.time_us, block.received_us, block.boot_us))
        active = track.active.tolist()
        for time_us, received_us, boot_us, attitude, rate, behind in zip(
            *times, attitudes, rates, active, strict=True
        ):
            when = received_us, boot_us
            self._write("/attitude", *when, {"time_us": time_us, **attitude})
            counts = zip(ACTIVE, behind, strict=True)
            self._write("/fused_rate", *when, {"time_us": time_us, **rate, **dict(counts)})

    def _write_poses(self, block: EstimateBlock) -> None:
        steps = np.floor(block.elapsed / TURN)
        for i in np.flatnonzero(np.diff(steps, prepend=self._turned) > 0.0).tolist():
            stamp = _timestamp(int(block.received_us[i]))
            w, x, y, z = block.track.q_nb[i].tolist()
            body = {"x": x, "y": y, "z": z, "w": w}
            links = (("enu", "ned", ENU_OF_NED), ("ned", "body", body))
            transforms = [
                {
                    "timestamp": stamp,
                    "parent_frame_id": parent,
                    "child_frame_id": child,
                    "translation": dict.fromkeys(AXES, 0.0),
                    "rotation": rotation,
                }
                for parent, child, rotation in links
            ]
            self._write("/tf", *_when(block, i), {"transforms": transforms})
        self._turned = float(steps[-1])

    def _write_innovation(self, block: EstimateBlock) -> None:
        heading, innovation = block.heading.heading, block.heading.innovation
        if innovation is None or heading is None or innovation is self._innovation:
            return
        self._innovation = innovation
        degrees = np.degrees((heading.heading % (2.0 * np.pi), innovation.value))
        message = {
            "time_us": int(block.time_us[0]),
            "heading_deg": float(degrees[0]),
            "innovation_deg": float(degrees[1]),
            "std_deg": float(np.degrees(np.sqrt(innovation.variance))),
            "gate": innovation.gate,
            "test_ratio": innovation.test_ratio,
            "fused": innovation.fused,
            "reset": innovation.reset,
            "source": heading.source.name,
        }
        self._write("/innovation", *_when(block, 0), message)

    def _write_look(self, block: EstimateBlock, looked: Estimate) -> None:
        when = _when(block, len(block) - 1)
        names = *(f"bias_{axis}" for axis in AXES), *(f"bias_std_{axis}" for axis in AXES)
        biases = *looked.attitude.bias_b.tolist(), *looked.attitude.bias_std.tolist()
        stamp = {"time_us": looked.time_us}
        self._write("/bias", *when, stamp | _known(names, biases))
        heading = looked.heading
        numbers = {
            "yaw_deg": float(np.degrees(heading.yaw)) % 360.0,
            "yaw_std_deg": float(np.degrees(heading.yaw_std)),
            "speed": heading.speed,
            "time_since_fused": heading.time_since_fused,
        }
        rest = {
            "fused_count": heading.fused_count,
            "rejected_count": heading.rejected_count,
            "heading_state": HeadingState(heading.state).name,
            "heading_state_number": int(heading.state),
        }
        self._write("/heading", *when, stamp | _known(numbers.keys(), numbers.values()) | rest)
        if looked.elapsed - self._told >= HEALTH:
            self._told = looked.elapsed
            self._write_array(looked, when)

    def _write_array(self, looked: Estimate, when: tuple[int, int]) -> None:
        status, health = looked.array, looked.array.health
        stamp = {"time_us": looked.time_us}
        counts = {state: int((health.state == i).sum()) for i, state in enumerate(_STANDINGS)}
        names = "epochs", "epochs_incomplete", "samples_lost", "sensors"
        account = {name: getattr(status, name) for name in names}
        self._write("/array_status", *when, stamp | account | counts)
        biases = health.relative_bias.T.tolist()
        sensors = {
            "state": health.state.tolist(),
            "reason": health.reason.tolist(),
            "rejected": health.rejected.tolist(),
            **{f"relative_bias_{axis}": bias for axis, bias in zip(AXES, biases, strict=True)},
        }
        self._write("/sensor_health", *when, stamp | sensors)

    def _write_event(self, event: Event) -> None:
        message = {
            "timestamp": _timestamp(event.received_us),
            "level": LEVELS[event.severity],
            "message": event.text,
            "name": "risaf_link",
            "file": "",
            "line": 0,
        }
        self._write("/events", event.received_us, event.boot_us, message)

    def _write_errors(self) -> None:
        if not self._errors or not self._times:
            return
        elapsed, *clocks = zip(*self._times, strict=True)
        for errors in self._errors:
            times = [np.interp(errors.elapsed, elapsed, clock) for clock in clocks]
            stamps = (each.astype(np.int64).tolist() for each in times)
            values = np.degrees(np.column_stack((errors.error, errors.std)))
            rows = _rows(("error_deg", "std_deg"), values)
            for time_us, received_us, boot_us, row in zip(*stamps, rows, strict=True):
                message = {"time_us": time_us, "reference": errors.reference, **row}
                self._write("/heading_error", received_us, boot_us, message)
        self._errors.clear()

    def _write(self, topic: str, received_us: int, vehicle_us: int, message: Message) -> None:
        if topic not in self._channels:
            self._open(topic)
        self._counts[topic] += 1
        self._writer.add_message(
            self._channels[topic],
            log_time=_nanoseconds(received_us),
            data=msgspec.json.encode(message),
            publish_time=_nanoseconds(vehicle_us),
            sequence=self._counts[topic] & 0xFFFFFFFF,
        )

    def _open(self, topic: str) -> None:
        name, schema = SCHEMAS[topic]
        number = self._writer.register_schema(name, "jsonschema", msgspec.json.encode(schema))
        self._channels[topic] = self._writer.register_channel(topic, "json", number)
        self._counts[topic] = 0


_STANDINGS = ("healthy", "suspect", "dead")


def _rows(names: Sequence[str], values: Floats) -> list[Message]:
    """A message a row; what is not known is left out."""
    if np.isfinite(values).all():
        return [dict(zip(names, row, strict=True)) for row in values.tolist()]
    return [_known(names, row) for row in values.tolist()]


def _known(names: Iterable[str], values: Iterable[float]) -> Message:
    pairs = zip(names, values, strict=True)
    return {name: value for name, value in pairs if abs(value) < np.inf}


def _when(block: EstimateBlock, i: int) -> tuple[int, int]:
    return int(block.received_us[i]), int(block.boot_us[i])


def _nanoseconds(time_us: int) -> int:
    return min(max(time_us, 0) * 1000, LATEST_NS)


def _timestamp(time_us: int) -> Message:
    seconds, rest = divmod(_nanoseconds(time_us), 1_000_000_000)
    return {"sec": seconds, "nsec": rest}
