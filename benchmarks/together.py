"""The live service and what it is compared with, at the same time: what each takes of a core.

python benchmarks/together.py [--seconds S] [--sensors N] [--rate HZ]

`risaf-link bench --only live` runs them one after another. Where the processor is shared with other
machines it may be half as fast a minute later, and their ratio says nothing. Here all of them run
at once, and every epoch is sent to each of them, in turns, so that what slows one slows all.

An answer is timed while its sender waits for it, until the next one's turn: what takes longer than
that is late by a period more.
"""

import argparse
import gc
import time
from contextlib import ExitStack
from statistics import quantiles

from risaf_link.bench.feed import bursts
from risaf_link.bench.live import SEED, Meter, rival, service, worked_s
from risaf_link.bench.reading import COMMAND
from risaf_link.sim.scenario import scenario

OURS, REFERENCE, ECHO = "risaf-link", "pymavlink and NumPy", "echo"


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--sensors", type=int, default=150)
    parser.add_argument("--rate", type=float, default=100.0)
    told = parser.parse_args()
    length = min(told.seconds, 30.0)
    chosen = scenario("circle", SEED, sensors=told.sensors, rate=told.rate, duration=length)
    meters = {name: Meter() for name in (OURS, REFERENCE, ECHO)}
    sent: dict[str, dict[int, float]] = {name: {} for name in meters}
    with ExitStack() as stack:
        for meter in meters.values():
            stack.callback(meter.close)
        processes = {
            OURS: stack.enter_context(service(meters[OURS], COMMAND, chosen.rate)),
            REFERENCE: stack.enter_context(rival(meters[REFERENCE], "robust", chosen)),
            ECHO: stack.enter_context(rival(meters[ECHO], "echo", chosen)),
        }
        gc.disable()
        worked = {name: worked_s(process) for name, process in processes.items()}
        began = time.perf_counter()
        turn_s = 1.0 / told.rate / len(meters)
        for burst in bursts(chosen, told.seconds):
            for k, (name, meter) in enumerate(meters.items()):
                due = began + burst.due_s + k * turn_s
                time.sleep(max(due - time.perf_counter(), 0.0))
                sent_s = meter.send(burst)
                if burst.stamp_ms is not None:
                    sent[name][burst.stamp_ms] = sent_s
                while (left := due + turn_s - time.perf_counter()) > 0.0:
                    meter.hear(left)
        passed = time.perf_counter() - began
        shares = {name: (worked_s(processes[name]) - worked[name]) / passed for name in meters}
    print("                      of a core   of the reference   p50 us   p99 us")
    for name, meter in meters.items():
        times_us = [1e6 * (at - sent[name][ms]) for ms, at in meter.answered.items()]
        percentiles = quantiles(times_us, n=100)
        print(
            f"{name:20} {shares[name]:10.2%} {shares[name] / shares[REFERENCE]:18.2f} "
            f"{percentiles[49]:8.0f} {percentiles[98]:8.0f}"
        )


if __name__ == "__main__":
    main()
