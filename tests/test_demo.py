"""The demonstration: one command, and nothing is left of it."""

import json
import re
import signal
import subprocess
import sys
from pathlib import Path
from urllib.request import urlopen

SAFETY_S = 60


def children(pid: int) -> list[int]:
    """Processes that a process has started."""
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def is_there(pid: int) -> bool:
    """Whether a process runs."""
    return Path(f"/proc/{pid}").exists()


def test_the_demo_shows_a_vehicle_and_ends_with_all_its_processes():
    run = [sys.executable, "-m", "risaf_link.cli", "demo", "--listen", "127.0.0.1:0"]
    with subprocess.Popen(run, stderr=subprocess.PIPE, text=True) as process:
        try:
            lines = []
            while not lines or "Ctrl-C" not in lines[-1]:
                lines.append(process.stderr.readline())
            url = re.search(r"http://\S+", "".join(lines))[0]
            started = children(process.pid)
            assert len(started) == 2 + ("MQTT" in "".join(lines))
            with urlopen(f"{url}/updates", timeout=SAFETY_S) as updates:  # noqa: S310
                for line in updates:
                    update = json.loads(line.removeprefix(b"data: ")) if line.strip() else {}
                    if (update.get("known") or {}).get("array"):
                        break
            assert update["known"]["array"]["sensors"] == 120
            assert update["chosen"] == [1, 191]
        finally:
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=SAFETY_S)
    assert process.returncode == 0
    assert not any(map(is_there, started))
