"""The service's counters for Prometheus, by prometheus-client (the extra `metrics`).

They are read when somebody asks; at an epoch one latency is counted and nothing else. A page is
made piece by piece, so that an epoch that comes meanwhile waits for one piece at most.
"""

import asyncio
import math
import time
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

from prometheus_client import CONTENT_TYPE_LATEST, ProcessCollector, generate_latest
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    Metric,
)

from risaf_link import __version__
from risaf_link.address import address_in
from risaf_link.core.estimate import Estimate
from risaf_link.core.heading import HeadingState
from risaf_link.core.health import Reason, SensorState
from risaf_link.core.kernel import BUILT
from risaf_link.mavlink.notices import Notice, Severity
from risaf_link.publish.account import Account, MqttCounts
from risaf_link.publish.scrape import MetricsParameters, Page

BOUNDS_US = (
    *(50, 75, 100, 150, 200, 300, 400, 500, 750),
    *(1_000, 2_000, 5_000, 10_000, 20_000, 50_000, 100_000, 1_000_000),
)
"""Of the latencies that are told apart; the 99th percentile is to be below 480 us."""

Value = tuple[tuple[str, ...], float]


class Latencies:
    """A histogram of latencies."""

    def __init__(self) -> None:
        self._bounds_ns = [bound * 1000 for bound in BOUNDS_US]
        self._counts = [0] * (len(BOUNDS_US) + 1)
        self._sum_ns = 0

    def note(self, latency_ns: int) -> None:
        """Count one."""
        self._counts[bisect_left(self._bounds_ns, latency_ns)] += 1
        self._sum_ns += latency_ns

    def family(self) -> Metric:
        """As Prometheus has it: how many were at most so long, s."""
        bounds = [*(repr(bound / 1e6) for bound in BOUNDS_US), "+Inf"]
        buckets = list(zip(bounds, map(float, accumulate(self._counts)), strict=True))
        return HistogramMetricFamily(
            "risaf_link_latency_seconds",
            "From the receipt of what made an epoch whole until its estimate was handed to all "
            "links",
            buckets=buckets,
            sum_value=self._sum_ns / 1e9,
        )


class Metrics:
    """Serves the service's counters.

    Parameters
    ----------
    parameters : MetricsParameters
        With an address to listen at.
    account : callable
        Tells the counters of the service.
    mqtt : callable or None
        Tells those of MQTT; None: there is none.

    Attributes
    ----------
    page : Page
    """

    next_s = math.inf  # who reads the page reads what is known by then

    def __init__(
        self,
        parameters: MetricsParameters,
        account: Callable[[], Account],
        mqtt: Callable[[], MqttCounts] | None = None,
    ) -> None:
        where = address_in(parameters.listen)
        if where is None:
            raise ValueError(f"listen: found {parameters.listen!r}, expected ADDRESS:PORT")
        self.page = Page(*where, self._make, CONTENT_TYPE_LATEST)
        self._account = account
        self._mqtt = mqtt
        self._latencies = Latencies()
        self._notices: Counter[Severity] = Counter()
        self._estimate: Estimate | None = None
        self._began_ns = 0  # of that estimate
        self._process = ProcessCollector(registry=None)

    def take(self, estimate: Estimate, received_us: int, began_ns: int, done_ns: int) -> None:  # noqa: ARG002
        """Take the next estimate, and count its latency."""
        self._latencies.note(done_ns - began_ns)
        self._estimate, self._began_ns = estimate, began_ns

    def tell(self, notice: Notice, time_us: int, unix_us: int) -> None:  # noqa: ARG002
        """Count what the operator is told."""
        self._notices[notice.severity] += 1

    async def run(self) -> None:
        """Serve until cancelled."""
        await self.page.run()

    async def _make(self) -> bytes:
        """Make the page, and let others have their turn in between."""
        pieces = []
        for family in self._families():
            pieces.append(generate_latest(_One(family)))
            await asyncio.sleep(0)
        return b"".join(pieces)

    def _families(self) -> Iterator[Metric]:
        built = "kernel" if BUILT else "numpy"
        yield _gauge("build", "What runs", ("version", "form"), [((__version__, built), 1.0)])
        yield from _of_traffic(self._account())
        yield self._latencies.family()
        severities = [((severity.name,), self._notices[severity]) for severity in Severity]
        yield _counter("notices", "Lines for the operator (STATUSTEXT)", ("severity",), severities)
        if self._mqtt:
            yield from _of_mqtt(self._mqtt())
        if self._estimate:
            age = (time.perf_counter_ns() - self._began_ns) / 1e9
            yield _gauge("estimate_age_seconds", "Since the last estimate", (), [((), age)])
            yield from _of_array(self._estimate)
            yield from _of_heading(self._estimate)
        yield from self._process.collect()


@dataclass(frozen=True, slots=True)
class _One:
    """One family, as a registry."""

    family: Metric

    def collect(self) -> Iterable[Metric]:
        return (self.family,)


def _of_traffic(account: Account) -> Iterator[Metric]:
    assembly = Counter(account.assembly)
    epochs = assembly.pop("epochs", 0), assembly.pop("incomplete", 0)
    lost = assembly.pop("samples_lost", 0)
    yield _counter("epochs", "Epochs that were estimated from", (), [((), epochs[0])])
    yield _counter("epochs_incomplete", "Of these, with samples missing", (), [((), epochs[1])])
    yield _counter("samples_lost", "Readings of one gyro that never came", (), [((), lost)])
    told = "What came but did not fit an epoch, and resets of what makes epochs"
    yield _counter("assembly", told, ("reason",), _by_name(assembly))
    told = "Frames and readings that were not used"
    yield _counter("unused", told, ("reason",), _by_name(account.unused))
    told = "Frames lost in parsing, from all links"
    yield _counter("frames_dropped", told, ("reason",), _by_name(account.dropped))
    rejected = [
        ((link, reason), count)
        for (link, _, reason), count in (
            (key.rpartition(": "), count) for key, count in account.rejected.items()
        )
    ]
    told = "Frames not taken for their signatures"
    yield _counter("frames_rejected", told, ("link", "reason"), rejected)
    links = account.links
    both = "link", "direction"
    bytes_ = [((t.link, "in"), t.bytes_in) for t in links]
    bytes_ += [((t.link, "out"), t.bytes_out) for t in links]
    yield _counter("link_bytes", "Bytes over a link", both, bytes_)
    frames = [((t.link, "in"), t.frames_in) for t in links]
    frames += [((t.link, "out"), t.frames_out) for t in links]
    yield _counter("link_frames", "Frames over a link, once for each peer", both, frames)
    told = "Frames that a peer did not get, or that nobody was there for"
    dropped = [((t.link,), t.dropped_out) for t in links]
    yield _counter("link_frames_dropped_out", told, ("link",), dropped)
    told = "Datagrams and connections of those who want too much"
    refused = [((t.link,), t.dropped_in) for t in links]
    yield _counter("link_dropped_in", told, ("link",), refused)
    ups = [((t.link,), t.connections) for t in links]
    yield _counter("link_connections", "How often a link came up", ("link",), ups)
    peers = [((t.link,), t.peers) for t in links]
    yield _gauge("link_peers", "Who can be reached over a link", ("link",), peers)


def _of_mqtt(counts: MqttCounts) -> Iterator[Metric]:
    yield _gauge("mqtt_up", "Whether the broker has taken us in", (), [((), counts.is_up)])
    connections = [((), counts.connections)]
    yield _counter("mqtt_connections", "How often it did", (), connections)
    topic = ("topic",)
    yield _counter("mqtt_published", "Messages published", topic, _by_name(counts.published))
    yield _counter("mqtt_dropped", "Messages that nobody got", topic, _by_name(counts.dropped))
    yield _gauge("mqtt_waiting", "Messages that wait", topic, _by_name(counts.waiting))


def _of_array(estimate: Estimate) -> Iterator[Metric]:
    array, fused = estimate.array, estimate.fused
    yield _gauge("sensors_expected", "Gyros of the array", (), [((), array.sensors)])
    yield _gauge("sensors_valid", "Gyros with a valid reading", (), [((), fused.valid)])
    states = [((state.name,), array.health.count(state)) for state in SensorState]
    yield _gauge("sensors", "Gyros by their standing", ("state",), states)
    reasons = [((reason.name,), int((array.health.reason == reason).sum())) for reason in Reason]
    yield _gauge("sensors_reason", "Gyros by why they stand so", ("reason",), reasons)
    active = _by_axis(fused.active.tolist())
    yield _gauge("sensors_active", "Gyros behind the fused rate", ("axis",), active)
    std = _by_axis([math.sqrt(value) for value in fused.noise.tolist()])
    told = "Standard deviation of the fused rate"
    yield _gauge("rate_std_radians_per_second", told, ("axis",), std)
    bias = _by_axis(estimate.attitude.bias_b.tolist())
    told = "Bias of the fused rate, as estimated"
    yield _gauge("rate_bias_radians_per_second", told, ("axis",), bias)


def _of_heading(estimate: Estimate) -> Iterator[Metric]:
    status, attitude = estimate.heading, estimate.attitude
    states = [((state.name,), state is status.state) for state in HeadingState]
    yield _gauge("heading_state", "1 of the present state of GPS heading", ("state",), states)
    yield _counter("heading_fused", "GPS headings fused", (), [((), status.fused_count)])
    yield _counter("heading_rejected", "GPS headings rejected", (), [((), status.rejected_count)])
    std = [(("roll",), attitude.roll_std), (("pitch",), attitude.pitch_std)]
    std.append((("yaw",), attitude.yaw_std))
    yield _gauge("attitude_std_radians", "Standard deviation of an angle", ("angle",), std)
    since = [((), status.time_since_fused)]
    yield _gauge("heading_since_fused_seconds", "Since a GPS heading was fused", (), since)
    innovation = status.innovation
    if innovation:
        told = "Of the last GPS heading, measured minus predicted"
        yield _gauge("heading_innovation_radians", told, (), [((), innovation.value)])
        deviation = [((), math.sqrt(innovation.variance))]
        yield _gauge("heading_innovation_std_radians", "Its deviation", (), deviation)
        told = "|innovation| / (gate x deviation): rejected above 1"
        yield _gauge("heading_test_ratio", told, (), [((), innovation.test_ratio)])


def _by_name(counts: Any) -> list[Value]:
    return [((str(name),), count) for name, count in sorted(counts.items())]


def _by_axis(values: list[float]) -> list[Value]:
    return [((axis,), value) for axis, value in zip("xyz", values, strict=True)]


def _counter(name: str, told: str, labels: tuple[str, ...], values: Iterable[Value]) -> Metric:
    return _filled(CounterMetricFamily(f"risaf_link_{name}", told, labels=labels), values)


def _gauge(name: str, told: str, labels: tuple[str, ...], values: Iterable[Value]) -> Metric:
    return _filled(GaugeMetricFamily(f"risaf_link_{name}", told, labels=labels), values)


def _filled(family: Any, values: Iterable[Value]) -> Metric:
    for labels, value in values:
        family.add_metric(labels, float(value))
    filled: Metric = family
    return filled
