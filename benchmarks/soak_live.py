"""Run the service for long on a full stream, with faults on the wire drawn at random.

    python benchmarks/soak_live.py --minutes 30 --sensors 300 --rate 1000

An array sends over UDP in real time. By the seed, spells of some seconds come in which datagrams
are withheld, repeated, sent in another order or garbled, in which the array is silent, or in which
a stranger sends noise to the service from another address. Asked is whether every epoch of which a
datagram arrived whole is answered, whether all that is counted as lost was withheld or garbled, and
whether memory grows.
"""

import argparse
import gc
import random
import socket
import sys
import time
from collections import Counter
from statistics import quantiles

from risaf_link.bench.feed import Burst, bursts
from risaf_link.bench.live import COMMAND, LINGER_S, SEED, Meter, memory_mb, service
from risaf_link.mavlink.dialect import IDS
from risaf_link.sim.scenario import scenario

KINDS = ("withheld", "repeated", "reordered", "garbled", "silent", "stranger")
SPELL_S = (2.0, 8.0)
PAUSE_S = (5.0, 25.0)
SHARE = 0.05  # of the datagrams that a spell hits
NOISE = 200  # datagrams of a stranger a second
GYROS = IDS["GYRO_ARRAY"].to_bytes(3, "little")
PART = 40  # sensors of a datagram


class Known(Meter):
    """A meter that tells where the service is."""

    @property
    def service(self) -> tuple[str, int]:
        """Its address."""
        return self._peer or ("127.0.0.1", 9)


class Wire:
    """What becomes of the datagrams of an instant.

    Attributes
    ----------
    withheld : int
        Samples of gyros that did not arrive whole.
    happened : Counter
        Spells by kind.
    """

    def __init__(self, seed: int, sensors: int) -> None:
        self._random = random.Random(seed)  # noqa: S311
        self._last = sensors % PART or PART  # sensors of an epoch's last datagram
        self.kind = ""
        self._until_s = self._random.uniform(*PAUSE_S)
        self.withheld = 0
        self.happened: Counter[str] = Counter()

    def turn_to(self, now_s: float) -> None:
        """Begin or end a spell."""
        if now_s < self._until_s:
            return
        if self.kind:
            self.kind, pause = "", PAUSE_S
        else:
            self.kind, pause = self._random.choice(KINDS), SPELL_S
            self.happened[self.kind] += 1
        self._until_s = now_s + self._random.uniform(*pause)

    def carry(self, frames: list[bytes]) -> tuple[list[bytes], bool]:
        """Spoil the datagrams of an instant; whether one of the gyros is whole among them."""
        if not self.kind or self.kind == "stranger":
            return frames, any(map(_is_gyros, frames))
        found: list[bytes] = []
        arrives = False
        gyros = [raw for raw in frames if _is_gyros(raw)]
        for raw in frames:
            hit = self._random.random() < (1.0 if self.kind == "silent" else SHARE)
            lost = hit and self.kind in {"withheld", "silent", "garbled"}
            if _is_gyros(raw):
                arrives |= not lost
                self.withheld += lost * (self._last if raw is gyros[-1] else PART)
            if not lost:
                found.append(raw)
            elif self.kind == "garbled":
                found.append(raw[:20] + bytes((raw[20] ^ 0x55,)) + raw[21:])
            if hit and self.kind == "repeated":
                found.append(raw)
        if self.kind == "reordered":
            self._random.shuffle(found)
        return found, arrives


def _is_gyros(raw: bytes) -> bool:
    return raw[7:10] == GYROS


def main() -> None:
    """Run it, and sum up."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--sensors", type=int, default=300)
    parser.add_argument("--rate", type=float, default=1000.0, help="Hz")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    seconds = 60.0 * options.minutes
    chosen = scenario("circle", SEED, sensors=options.sensors, rate=options.rate, duration=1.0)
    wire, meter = Wire(options.seed, options.sensors), Known()
    stranger = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    noise = random.Random(options.seed)  # noqa: S311
    sent: dict[int, float] = {}
    memory: list[float] = []
    gc.disable()
    try:
        with service(meter, COMMAND, options.rate) as process:
            began = time.perf_counter()
            for burst in bursts(chosen, seconds):
                while (left := began + burst.due_s - time.perf_counter()) > 0:
                    meter.hear(left)
                wire.turn_to(burst.due_s)
                frames, arrives = wire.carry(burst.frames)
                if frames:
                    sent_s = meter.send(Burst(burst.due_s, frames, burst.stamp_ms))
                    if arrives and burst.stamp_ms is not None:
                        sent[burst.stamp_ms] = sent_s
                if wire.kind == "stranger" and noise.random() < NOISE / options.rate:
                    stranger.sendto(noise.randbytes(200), meter.service)
                if burst.due_s >= 60.0 * (len(memory) + 1):
                    memory.append(memory_mb(process))
            until = time.perf_counter() + LINGER_S
            while time.perf_counter() < until:
                meter.hear(0.01)
            memory.append(memory_mb(process))
    finally:
        gc.enable()
        meter.close()
    unanswered = sum(stamp not in meter.answered for stamp in sent)
    late_ms = [1e3 * (meter.answered[ms] - s) for ms, s in sent.items() if ms in meter.answered]
    centiles = quantiles(late_ms, n=100)
    print(f"{options.minutes:g} min of {options.sensors} gyros at {options.rate:g} Hz")
    print(f"spells: {dict(wire.happened)}")
    print(f"epochs of which something arrived: {len(sent)}, not answered: {unanswered}")
    print(f"samples that did not arrive: {wire.withheld}, counted as lost: {meter.samples_lost}")
    print(f"latency: p50 {centiles[49]:.2f} ms, p99 {centiles[98]:.2f} ms")
    print(f"memory, MB, minute by minute: {[round(mb, 1) for mb in memory]}")
    sys.exit(unanswered > 0)


if __name__ == "__main__":
    main()
