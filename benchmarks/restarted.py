"""Kill the service at random moments, start it again, and see how soon and how truly it is back.

A simulated vehicle with 80 gyros drives on in real time, whatever becomes of the service, which
keeps its state and records. Each life ends by SIGKILL at a random moment; of every other restart
GPS is gone from before the kill on. Half of the lives keep their state every 0.2 s, as
docs/install.md has it for a heading that is to outlast a crash on the move; half as by default.
Of each kill it is asked:

- is the recording whole records, with everything that was answered in it?
- is the state that was kept one that can be read?
- how long after its start has the service a heading again, and how far is that off, in the
  standard deviations that it states?

    python benchmarks/restarted.py --kills 200
"""

import argparse
import json
import math
import os
import random
import select
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from killed import SAFETY_S, SENT, NotWholeError, child, in_order, records
from spoiled import SOURCES, Datagram

from risaf_link.bench.reading import COMMAND
from risaf_link.core.rotation import wrap, yaws_of
from risaf_link.mavlink.dialect import IDS, reader
from risaf_link.remembered import decoded
from risaf_link.sim.scenario import BOOT_US, Scenario, scenario
from risaf_link.sim.stream import frames

SENSORS = 80
SCENARIOS = ("drive1",)  # in turn; a vehicle that stands, as that of drive2 does, shows no heading
KILLS_A_DRIVE = 25
SETTLED_S = 25.0  # of the first life, to learn what is then remembered
LIFE_S = (0.2, 6.5)  # of a life after it is back: the moment of the kill
GONE_S = (0.0, 3.0)  # before a kill, from when on there is no GPS
PERIODS_S = (0.2, 5.0)  # of the state, in turn: what suits a heading on the move, the default
OBSERVED_S = 1.0  # after there is a heading again
PATIENCE_S = 15.0  # for it, after a start
KNOWN_RAD = 1.0  # a heading that is stated to be less certain is none
GPS, HEAD, CHECKSUM = IDS["GPS_RAW_INT"], 10, 2
_STATUS = reader("GPS_HEADING_STATUS", "time_usec", "yaw", "yaw_std")


@dataclass
class Life:
    """What was found of one life of the service, and of its end."""

    number: int
    with_gps: bool
    period_s: float
    back_s: float = math.inf  # from the start of the process to a heading
    heard_s: float = math.inf  # to the first estimate
    error: float = math.nan  # rad, of the first heading
    std: float = math.nan  # rad, that was stated
    worst: float = math.nan  # error over standard deviation in OBSERVED_S
    said: str = ""
    told: list[tuple[float, int, float, float]] = field(default_factory=list)
    """s since the start, stamp in us, rad, rad"""

    @property
    def is_back(self) -> bool:
        """Whether there is a heading again."""
        return bool(self.told) and self.told[-1][3] < KNOWN_RAD


class Vehicle:
    """Sends a scenario in real time, and listens."""

    def __init__(self, chosen: Scenario, port: int) -> None:
        self.chosen = chosen
        self.has_gps = True
        self.heard = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.heard.bind(("127.0.0.1", 0))
        self.heard.setblocking(False)
        self.port: int = self.heard.getsockname()[1]
        self._to = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._address = ("127.0.0.1", port)
        self._due: Iterator[Datagram] = frames(chosen, SOURCES)
        self._next = next(self._due)
        self._began = time.monotonic()
        self.answered: set[bytes] = set()

    def close(self) -> None:
        """Close the sockets."""
        self.heard.close()
        self._to.close()

    @property
    def is_over(self) -> bool:
        """Whether the drive is."""
        return time.monotonic() - self._began > self.chosen.duration - 30.0

    def drive(self, until: float, life: Life | None = None, started: float = 0.0) -> None:
        """Drive until a time of the monotonic clock; take down what a life tells."""
        while (now := time.monotonic()) < until:
            due = self._began + (self._next[0] - BOOT_US) / 1e6
            if due <= now:
                self._send(self._next[1])
                self._next = next(self._due)
                continue
            if select.select([self.heard], [], [], max(min(due, until) - now, 0.0))[0]:
                self._hear(life, started)

    def _send(self, raw: bytes) -> None:
        is_fix = int.from_bytes(raw[7:HEAD], "little") == GPS
        if self.has_gps or not is_fix:
            with suppress(OSError):
                self._to.sendto(raw, self._address)

    def take_answers(self) -> set[bytes]:
        """What the service has answered, that is dead now."""
        self._hear(None, 0.0)
        answered, self.answered = self.answered, set()
        return answered

    def _hear(self, life: Life | None, started: float) -> None:
        with suppress(BlockingIOError):
            while True:
                raw = self.heard.recv(65536)
                self.answered.add(raw)
                if int.from_bytes(raw[7:HEAD], "little") == IDS["GPS_HEADING_STATUS"] and life:
                    stamp_us, yaw, std = _STATUS(raw[HEAD:-CHECKSUM])
                    life.told.append((time.monotonic() - started, stamp_us, yaw, std))

    def judge(self, life: Life) -> None:
        """Hold what was told against the truth."""
        known = [told for told in life.told if told[3] < KNOWN_RAD]
        life.heard_s = life.told[0][0] if life.told else math.inf
        if not known:
            return
        stamps = np.array([(stamp_us - BOOT_US) / 1e6 for _, stamp_us, _, _ in known])
        true = yaws_of(self.chosen.trajectory(stamps).q_nb).tolist()
        errors = [wrap(yaw - truth) for (_, _, yaw, _), truth in zip(known, true, strict=True)]
        life.back_s, life.error, life.std = known[0][0], errors[0], known[0][3]
        life.worst = max(abs(e) / told[3] for e, told in zip(errors, known, strict=True))


class Service:
    """One life."""

    def __init__(self, folder: Path, ports: tuple[int, int], period_s: float) -> None:
        self.folder = folder
        folder.mkdir()
        every = "emit: {GPS_HEADING_STATUS: 10000, ATTITUDE_QUATERNION: 10}"
        limits = "recording: {segment_bytes: 1000000, least_free_bytes: 0}"
        links = (
            f"{{name: recording, url: 'tlog://{folder}/drive.tlog', {every}, {limits}}}, "
            f"{{name: vehicle, url: 'udpin://127.0.0.1:{ports[0]}', emit: {{}}}}, "
            f"{{name: ground, url: 'udpout://127.0.0.1:{ports[1]}', {every}}}"
        )
        self.state = folder.parent / "state.json"
        settings = f"links=[{links}]", f"state={{file: {self.state}, period: {period_s}}}"
        told = [part for setting in settings for part in ("--set", setting)]
        self._log = (folder / "log").open("wb")
        self.process = subprocess.Popen(  # noqa: S603
            [*COMMAND, "run", "-v", *told], stderr=self._log
        )
        self.recorder = -1

    def note_recorder(self) -> None:
        """Take hold of its recorder, to know when that has ended."""
        with suppress(NotWholeError, OSError):
            self.recorder = os.pidfd_open(child(self.process.pid))

    def kill(self) -> None:
        """End it."""
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()
        self._log.close()

    @property
    def said(self) -> str:
        """What it said of its state."""
        lines = (self.folder / "log").read_text().splitlines()
        return next((line for line in lines if "warm start" in line or "state" in line), "")

    def judge(self, answered: set[bytes]) -> None:
        """Look into the recording.

        Raises
        ------
        NotWholeError
            If it does not end with a whole record, or lacks what was answered.
        """
        if self.recorder >= 0:
            if not select.select([self.recorder], [], [], SAFETY_S)[0]:
                raise NotWholeError(f"the recorder has not ended in {SAFETY_S:.0f} s")
            os.close(self.recorder)
        held = [row for path in in_order(self.folder) for row in records(path)]
        told = {raw for link, raw in held if link == SENT}
        ours = {raw for raw in answered if raw[7:HEAD] in EACH}
        if not ours <= told:
            raise NotWholeError(f"{len(ours - told)} answers are missing")


EACH = {IDS[name].to_bytes(3, "little") for name in ("GPS_HEADING_STATUS", "ATTITUDE_QUATERNION")}


def drive(seed: int, kills: int, first: int) -> Iterator[tuple[Life, list[str]]]:
    """Kill the service so many times on one drive; each life, and what was wrong with its end."""
    moment = random.Random(seed)  # noqa: S311
    name = SCENARIOS[seed % len(SCENARIOS)]
    # When there is GPS is decided here.
    chosen = replace(scenario(name, seed, sensors=SENSORS, duration=3600.0), outages=())
    port = _free_port()
    vehicle = Vehicle(chosen, port)
    with tempfile.TemporaryDirectory(
        prefix="restarted",
        ignore_cleanup_errors=True,  # the last recorder may still write
    ) as place:
        folder, ports = Path(place), (port, vehicle.port)
        service = Service(folder / "life", ports, PERIODS_S[0])
        try:
            vehicle.drive(time.monotonic() + SETTLED_S)
            service.note_recorder()
            for number in range(first, first + kills):
                life = Life(number, moment.random() < 0.5, PERIODS_S[number % len(PERIODS_S)])
                if not life.with_gps:
                    vehicle.has_gps = False
                    vehicle.drive(time.monotonic() + moment.uniform(*GONE_S))
                service.kill()
                answered = vehicle.take_answers()
                wrong = _state_of(service.state)
                before = service
                started = time.monotonic()
                service = Service(folder / f"life{number}", ports, life.period_s)
                while not life.is_back and time.monotonic() < started + PATIENCE_S:
                    vehicle.drive(time.monotonic() + 0.1, life, started)
                vehicle.drive(time.monotonic() + OBSERVED_S, life, started)
                service.note_recorder()
                vehicle.judge(life)
                vehicle.has_gps = True
                try:
                    before.judge(answered)
                except NotWholeError as error:
                    wrong.append(str(error))
                life.said = service.said.partition(": ")[2] or service.said
                yield life, wrong
                vehicle.drive(time.monotonic() + moment.uniform(*LIFE_S))
        finally:
            service.kill()
            vehicle.close()


def _state_of(path: Path) -> list[str]:
    try:
        decoded(path.read_bytes())
    except (OSError, ValueError) as error:
        return [f"state: {error}"]
    return []


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def main() -> None:
    """Kill many times, and sum up."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path, help="where each life is written, a line each")
    options = parser.parse_args()
    lives: list[Life] = []
    wrong: list[str] = []
    seed = options.seed
    while len(lives) < options.kills:
        kills = min(KILLS_A_DRIVE, options.kills - len(lives))
        for life, found in drive(seed, kills, len(lives)):
            lives.append(life)
            wrong += [f"kill {life.number}: {each}" for each in found]
            told = asdict(life) | {"told": len(life.told), "seed": seed, "wrong": found}
            if options.json:
                with options.json.open("a") as file:
                    print(json.dumps(told), file=file)
            else:
                print(json.dumps(told), flush=True)
        seed += 1
    for line in wrong:
        print(line)
    print(f"{len(lives)} kills, {len(wrong)} recordings or states that are not whole")
    for with_gps in (True, False):
        for period_s in PERIODS_S:
            # What is found was kept by the life before.
            some = [
                life
                for before, life in pairwise(lives)
                if (life.with_gps, before.period_s) == (with_gps, period_s)
            ]
            if some:
                told = "with GPS" if with_gps else "without"
                print(f"{told}, state every {period_s} s: {summary(some)}")
    print(f"all: {summary(lives)}")
    sys.exit(bool(wrong))


def summary(lives: Sequence[Life]) -> str:
    """A line about some lives."""
    back = np.array([life.back_s for life in lives])
    after = np.array([life.back_s - life.heard_s for life in lives])
    known = [life for life in lives if math.isfinite(life.error)]
    if not known:
        return f"{len(lives)} restarts, none with a heading"
    ratio = np.array([abs(life.error) / life.std for life in known])
    worst = np.array([life.worst for life in known])
    within = ", ".join(f"{100 * np.mean(ratio <= k):.1f} % within {k}" for k in (1, 2, 3))
    return (
        f"{len(lives)} restarts: heading after {np.median(back):.2f} s, "
        f"{np.quantile(back, 0.9, method='higher'):.2f} s in 9 of 10, {back.max():.2f} s at most; "
        f"{np.mean(back <= 2.0) * 100:.1f} % within 2 s; after the first estimate "
        f"{np.median(after):.2f} s, {after.max():.2f} s at most; error over standard deviation: "
        f"RMS {math.sqrt(np.mean(ratio**2)):.2f}, {within}, {ratio.max():.2f} at most; "
        f"{worst.max():.2f} in the seconds after; "
        f"stated {math.degrees(np.median([life.std for life in known])):.2f} deg"
    )


if __name__ == "__main__":
    main()
