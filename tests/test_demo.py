"""The demonstration: one command, and nothing is left of it."""

import builtins
import json
import os
import re
import select
import signal
import socket
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path
from urllib.request import urlopen

import pytest
from click.testing import CliRunner

from risaf_link.cli import main

SAFETY_S = 60


def children(pid: int) -> list[int]:
    """Processes that a process has started."""
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def is_there(pid: int) -> bool:
    """Whether a process runs."""
    return Path(f"/proc/{pid}").exists()


@contextmanager
def running():
    """A demonstration that has told all that it tells: the process, and what it told."""
    run = [sys.executable, "-m", "risaf_link.cli", "demo", "--listen", "127.0.0.1:0"]
    with subprocess.Popen(run, stderr=subprocess.PIPE, text=True) as process:
        try:
            lines = []
            while not lines or "Ctrl-C" not in lines[-1]:
                lines.append(process.stderr.readline())
            yield process, "".join(lines)
        finally:
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=SAFETY_S)


def test_the_demo_shows_a_vehicle_and_ends_with_all_its_processes():
    with running() as (process, told):
        started = children(process.pid)
        assert len(started) == 2 + ("MQTT" in told)
        url = re.search(r"http://\S+", told)[0]
        with urlopen(f"{url}/updates", timeout=SAFETY_S) as updates:  # noqa: S310
            for line in updates:
                update = json.loads(line.removeprefix(b"data: ")) if line.strip() else {}
                if (update.get("known") or {}).get("array"):
                    break
        assert update["known"]["array"]["sensors"] == 120
        assert update["chosen"] == [1, 191]
        broker = re.search(r"mosquitto_sub -p (\d+)", told)
        if broker:
            socket.create_connection(("127.0.0.1", int(broker[1])), timeout=SAFETY_S).close()
    assert process.returncode == 0
    assert not any(map(is_there, started))


def test_a_demo_that_is_killed_takes_all_its_processes_with_it():
    with running() as (process, _):
        handles = [os.pidfd_open(pid) for pid in children(process.pid)]
        process.kill()
        for handle in handles:
            ended, *_ = select.select([handle], [], [], SAFETY_S)
            os.close(handle)
            assert ended


@pytest.mark.parametrize(
    ("command", "place"),
    [(["demo"], "risaf_link.demo"), (["monitor", "udpin://127.0.0.1:0"], "risaf_link.links")],
)
def test_ctrl_c_is_no_failure_before_a_command_has_begun(command, place, monkeypatch):
    def interrupt(name, *rest):
        if name == place:
            raise KeyboardInterrupt
        return importing(name, *rest)

    importing = builtins.__import__
    monkeypatch.setattr(builtins, "__import__", interrupt)
    assert CliRunner().invoke(main, command).exit_code == 0
