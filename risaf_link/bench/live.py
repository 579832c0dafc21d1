"""The service on a socket: what it answers, when, and what that takes of a core."""

import gc
import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from statistics import quantiles

from risaf_link.bench.extent import Extent
from risaf_link.bench.feed import Burst, bursts
from risaf_link.bench.figure import Figure, Spread, seconds_of
from risaf_link.bench.machine import has
from risaf_link.bench.reading import COMMAND
from risaf_link.errors import RisafError
from risaf_link.mavlink.dialect import IDS, reader
from risaf_link.sim.array import count_scale
from risaf_link.sim.scenario import Scenario, scenario

SEED = 1
PATIENCE_S = 30.0  # for a service to start
LINGER_S = 0.5  # after the last epoch
PARTS = 5  # of a run, for the spread
RECEIVE_BUFFER = 4 << 20  # bytes
HEAD = 10  # bytes before the payload
P99_US, CORE_PERCENT = 480.0, 2.0  # goals
START_S, HELP_S, MEMORY_MB = 0.5, 0.2, 80.0  # likewise
WITHOUT_UVLOOP = (
    "import sys; sys.modules['uvloop'] = None; "
    "from risaf_link.cli import main; main(prog_name='risaf-link')"
)
_ARRAY_STATUS = reader("ARRAY_STATUS", "epochs", "epochs_incomplete", "samples_lost")


class Meter:
    """The other end of the service's link.

    Attributes
    ----------
    port : int
    answered : dict
        When the attitude of an epoch came, s, by its time stamp, ms.
    samples_lost : int
        As the service says.
    """

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self.port: int = self._socket.getsockname()[1]
        self.answered: dict[int, float] = {}
        self.samples_lost = 0
        self._peer: tuple[str, int] | None = None

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def meet(self) -> None:
        """Wait until a service speaks."""
        until = time.perf_counter() + PATIENCE_S
        while self._peer is None:
            if time.perf_counter() > until:
                raise RisafError(f"the service has not spoken in {PATIENCE_S:.0f} s")
            self.hear(0.1)

    def send(self, burst: Burst) -> float:
        """Send the frames of one instant, a datagram each; when the last one went, s."""
        for raw in burst.frames[:-1]:
            self._socket.sendto(raw, self._peer or ())
        sent_s = time.perf_counter()
        self._socket.sendto(burst.frames[-1], self._peer or ())
        return sent_s

    def hear(self, seconds: float) -> None:
        """Take what comes, wait for it no longer than that."""
        if not select.select([self._socket], [], [], max(seconds, 0.0))[0]:
            return
        while True:
            try:
                raw, peer = self._socket.recvfrom(65536)
            except BlockingIOError:
                return
            now_s, self._peer = time.perf_counter(), peer
            message_id = int.from_bytes(raw[7:HEAD], "little")
            if message_id == IDS["ATTITUDE_QUATERNION"]:
                self.answered[int.from_bytes(raw[HEAD : HEAD + 4], "little")] = now_s
            elif message_id == IDS["ARRAY_STATUS"]:
                _, _, self.samples_lost = _ARRAY_STATUS(raw[HEAD:-2])


@dataclass(slots=True)
class Course:
    """How a live run went."""

    latencies_us: list[float] = field(default_factory=list)  # of epochs that were answered
    epochs: int = 0  # that were sent
    behind_us: list[float] = field(default_factory=list)  # how late each was sent
    samples_lost: int = 0
    core_percent: float = 0.0
    memory_mb: list[float] = field(default_factory=list)  # resident, after a quarter, at the end

    @property
    def unanswered(self) -> int:
        """Epochs without an attitude."""
        return self.epochs - len(self.latencies_us)

    def percentile(self, percent: int) -> Spread | None:
        """Of the latency, us: of all, and the least and most of five parts of the run."""
        size = len(self.latencies_us) // PARTS
        if size < 2:
            return None
        parts = [self.latencies_us[k * size : (k + 1) * size] for k in range(PARTS)]
        values = [_percentile(part, percent) for part in parts]
        return Spread(_percentile(self.latencies_us, percent), min(values), max(values))


def _percentile(values: Sequence[float], percent: int) -> float:
    return quantiles(values, n=100, method="inclusive")[percent - 1]


@contextmanager
def service(
    meter: Meter,
    command: Sequence[str],
    rate: float = 100.0,
    settings: Sequence[str] = (),
    links: Sequence[str] = (),
) -> Iterator[int]:
    """Run the service beside a meter, for every epoch an attitude; its process id.

    `settings` are `KEY=VALUE` over the defaults, `links` others beside that to the meter, in YAML.
    """
    emit = f"emit: {{ATTITUDE_QUATERNION: {2 * rate}, GPS_HEADING_STATUS: 5, ARRAY_STATUS: 5}}"
    link = f"{{name: meter, url: 'udpout://127.0.0.1:{meter.port}', {emit}}}"
    all_links = f"links=[{', '.join([link, *links])}]"
    told = [part for setting in (all_links, *settings) for part in ("--set", setting)]
    with _process([*command, "run", *told], meter) as number:
        yield number


@contextmanager
def rival(meter: Meter, method: str, chosen: Scenario) -> Iterator[int]:
    """Run one of the services to compare with; its process id."""
    told = [str(meter.port), method, str(chosen.sensors), repr(count_scale(chosen.gyros))]
    with _process([sys.executable, "-m", "risaf_link.bench.rival", *told], meter) as number:
        yield number


@contextmanager
def _process(command: Sequence[str], meter: Meter) -> Iterator[int]:
    with subprocess.Popen(command) as process:  # noqa: S603
        try:
            meter.meet()
            yield process.pid
        finally:
            process.send_signal(signal.SIGTERM)


def drive(meter: Meter, process: int, chosen: Scenario, seconds: float) -> Course:
    """Send a scenario in real time, and take down what comes back."""
    course, sent = Course(), {}
    due = bursts(chosen, seconds)
    gc.disable()
    try:
        before_s, began = worked_s(process), time.perf_counter()
        for burst in due:
            while (left := began + burst.due_s - time.perf_counter()) > 0:
                meter.hear(left)
            sent_s = meter.send(burst)
            if burst.stamp_ms is not None:
                sent[burst.stamp_ms] = sent_s
                course.behind_us.append((sent_s - began - burst.due_s) * 1e6)
            if not course.memory_mb and burst.due_s >= seconds / 4:
                course.memory_mb.append(memory_mb(process))
        passed = time.perf_counter() - began
        course.core_percent = 100.0 * (worked_s(process) - before_s) / passed
        until = time.perf_counter() + LINGER_S
        while time.perf_counter() < until:
            meter.hear(0.01)
        course.memory_mb.append(memory_mb(process))
    finally:
        gc.enable()
    answered = meter.answered
    course.epochs, course.samples_lost = len(sent), meter.samples_lost
    course.latencies_us = [1e6 * (answered[ms] - s) for ms, s in sent.items() if ms in answered]
    return course


def at_100_hz(extent: Extent) -> Iterator[Figure]:
    """150 gyros at 100 Hz: latency, share of a core, losses; beside others."""
    chosen = scenario("circle", SEED, sensors=150, rate=100.0, duration=extent.live_s)
    ours = _course(chosen, extent.live_s, "ours")
    plain, echo = (_course(chosen, extent.live_s, method) for method in ("robust", "echo"))
    text, against = "150 gyros at 100 Hz, wire to wire", "pymavlink and NumPy"
    for percent, goal in ((50, None), (99, P99_US)):
        figure = f"live_p{percent}", f"{text}, p{percent}", "us", ours.percentile(percent)
        yield Figure(*figure, against, plain.percentile(percent), goal=goal)
    core = _one(ours.core_percent), against, _one(plain.core_percent)
    yield Figure("live_core", "150 gyros at 100 Hz, of a core", "%", *core, goal=CORE_PERCENT)
    yield _lost("live_lost", "150 gyros at 100 Hz, epochs lost", ours)
    figure = "live_memory", "resident memory", "MB", _one(ours.memory_mb[-1])
    yield Figure(*figure, against, _one(plain.memory_mb[-1]), goal=MEMORY_MB)
    for percent in (50, 99):
        floor = echo.percentile(percent)
        yield Figure(f"limit_live_p{percent}", f"an echo in Python, p{percent}", "us", floor)
    yield from _gain_of_uvloop(chosen, extent.live_s, ours)


def _gain_of_uvloop(chosen: Scenario, seconds: float, ours: Course) -> Iterator[Figure]:
    text = "150 gyros at 100 Hz, with uvloop"
    if not has("uvloop"):
        note = "uvloop is not installed"
        yield Figure("live_uvloop_p99", f"{text}, p99", "us", None, "asyncio alone", note=note)
        return
    alone = _course(chosen, seconds, "asyncio")
    for percent in (50, 99):
        values = ours.percentile(percent), "asyncio alone", alone.percentile(percent)
        yield Figure(f"live_uvloop_p{percent}", f"{text}, p{percent}", "us", *values)
    core = _one(ours.core_percent), "asyncio alone", _one(alone.core_percent)
    yield Figure("live_uvloop_core", f"{text}, of a core", "%", *core)


def _course(chosen: Scenario, seconds: float, who: str) -> Course:
    meter = Meter()
    commands = {"ours": COMMAND, "asyncio": (sys.executable, "-c", WITHOUT_UVLOOP)}
    try:
        running = (
            service(meter, commands[who], chosen.rate)
            if who in commands
            else rival(meter, who, chosen)
        )
        with running as process:
            return drive(meter, process, chosen, seconds)
    finally:
        meter.close()


def at_1_khz(extent: Extent) -> Iterator[Figure]:
    """300 gyros at 1 kHz: nothing may be lost, and memory must not grow."""
    rate = extent.fast_rate
    chosen = scenario("circle", SEED, sensors=300, rate=rate, duration=min(1.0, extent.fast_s / 2))
    course = _course(chosen, extent.fast_s, "ours")
    text = f"300 gyros at {rate:.0f} Hz for {extent.fast_s:.0f} s"
    yield _lost("fast_lost", f"{text}, epochs lost", course)
    before, after = course.memory_mb
    note = f"{before:.1f} MB after a quarter, {after:.1f} MB at the end"
    growth = _one(after - before)
    yield Figure("fast_growth", f"{text}, growth of memory", "MB", growth, goal=1.0, note=note)
    yield Figure("fast_core", f"{text}, of a core", "%", _one(course.core_percent))
    for percent in (50, 99):
        spread = course.percentile(percent)
        yield Figure(f"fast_p{percent}", f"{text}, wire to wire, p{percent}", "us", spread)


def _lost(key: str, text: str, course: Course) -> Figure:
    late = max(course.behind_us, default=0.0) / 1000
    note = (
        f"of {course.epochs}; {course.samples_lost} samples lost; sent {late:.1f} ms late at most"
    )
    return Figure(key, text, "", _one(course.unanswered), goal=0.0, note=note)


def start(extent: Extent) -> Iterator[Figure]:
    """From the command to the first HEARTBEAT, and to the end of --help."""
    heartbeat = Spread.of([_first_heartbeat_s() for _ in range(extent.runs)])
    commands = [[sys.executable, "-c", "pass"], [*COMMAND, "--help"]]
    python, help_s = (
        Spread.of(seconds_of(partial(_output, command), extent.runs)) for command in commands
    )
    against = "python -c pass"
    figure = "start", "start of the service to its first HEARTBEAT", "s", heartbeat
    yield Figure(*figure, against, python, goal=START_S)
    yield Figure("help", "risaf-link --help", "s", help_s, against, python, goal=HELP_S)


def _first_heartbeat_s() -> float:
    meter = Meter()
    try:
        began = time.perf_counter()
        with service(meter, COMMAND):
            return time.perf_counter() - began
    finally:
        meter.close()


def _output(command: Sequence[str]) -> bytes:
    return subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout  # noqa: S603


def _one(value: float) -> Spread:
    return Spread(value, value, value)


def memory_mb(process: int) -> float:
    """Resident memory of a process, MB; Linux tells it."""
    pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def worked_s(process: int) -> float:
    """Time of a core that a process has taken, s."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
