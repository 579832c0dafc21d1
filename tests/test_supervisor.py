"""A supervisor is told what is so: ready, alive while the loop turns, and nothing when it hangs."""

import os
import select
import signal
import socket
import subprocess
import sys
import time

import pytest
from network import Network
from vehicle import Vehicle

from risaf_link.mavlink.pulse import Pulse
from risaf_link.supervisor import Supervisor

SAFETY_S = 30.0
US = 1_000_000


@pytest.fixture(params=["path", "abstract"])
def heard(request, tmp_path):
    """A socket such as systemd's, and its name."""
    name = str(tmp_path / "notify") if request.param == "path" else f"@risaf-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(name.replace("@", "\0", 1) if name.startswith("@") else name)
        listening.setblocking(False)
        yield listening, name


def waiting(listening):
    """All that has come."""
    lines = []
    while select.select([listening], [], [], 0)[0]:
        lines += listening.recv(4096).decode().split("\n")
    return lines


def until(listening, wanted, seconds=SAFETY_S):
    """What comes until something does, or for so long."""
    lines, end = [], time.monotonic() + seconds
    while not any(line.startswith(wanted) for line in lines):
        left = end - time.monotonic()
        if left <= 0 or not select.select([listening], [], [], left)[0]:
            break
        lines += listening.recv(4096).decode().split("\n")
    return lines


def watching(name, **more):
    return {"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "2000000", **more}


def test_it_is_told_ready_once_then_signs_of_life_four_times_in_its_patience(heard):
    listening, name = heard
    supervisor = Supervisor(watching(name, WATCHDOG_PID="7"), pid=7)
    for tick in range(41):
        supervisor.tell(tick / 10, lambda: "well", is_alive=True)
    lines = waiting(listening)
    assert lines.count("READY=1") == 1
    assert lines.count("STATUS=well") == 1
    assert lines.count("WATCHDOG=1") == 9
    supervisor.end()
    supervisor.end()
    supervisor.tell(9.0, lambda: "gone", is_alive=True)
    assert waiting(listening) == ["STOPPING=1"]


def test_a_status_is_told_when_it_changes_at_most_each_second(heard):
    listening, name = heard
    supervisor = Supervisor({"NOTIFY_SOCKET": name}, pid=7)
    for tick in range(25):
        supervisor.tell(tick / 10, lambda now=tick: f"{now}", is_alive=True)
    assert waiting(listening) == ["READY=1", "STATUS=0", "STATUS=10", "STATUS=20"]
    supervisor.end()


@pytest.mark.parametrize(
    "more", [{"WATCHDOG_PID": "8"}, {"WATCHDOG_USEC": "0"}, {"WATCHDOG_USEC": "soon"}]
)
def test_without_a_watchdog_for_this_process_there_are_no_signs_of_life(heard, more):
    listening, name = heard
    supervisor = Supervisor(watching(name, **more), pid=7)
    supervisor.tell(0.0, str, is_alive=True)
    assert waiting(listening) == ["READY=1"]
    supervisor.end()


def test_an_estimator_that_is_stuck_gives_no_sign_of_life(heard):
    listening, name = heard
    supervisor = Supervisor(watching(name), pid=7)
    supervisor.tell(0.0, str, is_alive=False)
    assert waiting(listening) == ["READY=1"]
    supervisor.end()


@pytest.mark.parametrize("name", ["", "/nowhere/notify", "@nobody-listens", "relative"])
def test_where_nobody_listens_nothing_happens(name):
    supervisor = Supervisor(watching(name), pid=7)
    supervisor.tell(0.0, str, is_alive=True)
    supervisor.end()


def test_a_supervisor_that_does_not_read_is_not_waited_for(heard):
    _, name = heard
    supervisor = Supervisor(watching(name), pid=7)
    for tick in range(5000):
        supervisor.tell(float(tick), lambda now=tick: f"{now}", is_alive=True)
    supervisor.end()


def stuck_at(gathered, estimated):
    """Seconds at which a pulse holds the estimator for stuck, by epochs so far at each second."""
    pulse, found, before = Pulse(), [], 0
    for second, (came, made) in enumerate(zip(gathered, estimated, strict=True)):
        for _ in range(made - before):
            pulse.note_epoch()
        before = made
        pulse.note_gathered(came, second * US)
        pulse.advance(second * US)
        if pulse.is_stuck:
            found.append(second)
    return found


def test_epochs_of_which_nothing_comes_are_a_fault_and_silence_is_none():
    assert stuck_at([1, 2, 3, 4, 5, 6], [1, 2, 3, 4, 5, 6]) == []
    assert stuck_at([1, 2, 2, 2, 2, 2], [1, 2, 2, 2, 2, 2]) == []  # the array is silent
    assert stuck_at([0, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0]) == []  # nor has it begun
    assert stuck_at([1, 2, 3, 4, 5, 6], [1, 2, 2, 2, 2, 2]) == [3, 4, 5]
    assert stuck_at([1, 2, 3, 4, 5, 6], [0, 0, 0, 0, 0, 0]) == [2, 3, 4, 5]  # from the first on
    assert stuck_at([1, 2, 3, 4, 5, 6], [1, 2, 2, 2, 5, 6]) == [3]  # it came back


def test_an_array_that_the_calibration_is_not_of_is_no_reason_for_a_restart():
    component = Network().component
    for second in range(5):
        healthy = component.note_gathered(second, second * US)
    assert not healthy
    component.trouble = "found 8 sensors, expected 16"
    assert component.note_gathered(5, 5 * US)
    assert component.status == "no estimates: found 8 sensors, expected 16"


def test_a_daemon_that_hangs_falls_silent_and_one_without_samples_does_not(heard):
    listening, name = heard
    environment = os.environ | watching(name, WATCHDOG_USEC="800000")
    links = "links=[{name: vehicle, url: 'udpin://127.0.0.1:0', emit: {}}]"
    command = [sys.executable, "-m", "risaf_link.cli", "run", "--set", links]
    with subprocess.Popen(command, env=environment) as daemon:
        try:
            assert "READY=1" in until(listening, "READY=1")
            for _ in range(3):
                assert "WATCHDOG=1" in until(listening, "WATCHDOG=1")
            daemon.send_signal(signal.SIGSTOP)
            os.waitid(os.P_PID, daemon.pid, os.WSTOPPED)
            waiting(listening)
            assert until(listening, "WATCHDOG=1", seconds=1.0) == []  # longer than its patience
            daemon.send_signal(signal.SIGCONT)
            assert "WATCHDOG=1" in until(listening, "WATCHDOG=1")
            daemon.send_signal(signal.SIGTERM)
            assert "STOPPING=1" in until(listening, "STOPPING=1")
            assert daemon.wait(SAFETY_S) == 0
        finally:
            daemon.kill()


def test_the_status_says_how_the_heading_is(heard):
    listening, name = heard
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    links = f"links=[{{name: vehicle, url: 'udpin://127.0.0.1:{port}', emit: {{}}}}]"
    command = [sys.executable, "-m", "risaf_link.cli", "run", "--set", links]
    vehicle, time_us = Vehicle(), US
    with (
        subprocess.Popen(command, env=os.environ | watching(name)) as daemon,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as array,
    ):
        try:
            assert "STATUS=no estimates: no samples yet" in until(listening, "STATUS=")
            array.sendto(vehicle.info().raw, ("127.0.0.1", port))
            said = []
            while not said:
                for _ in range(5):
                    array.sendto(vehicle.epoch(time_us).raw, ("127.0.0.1", port))
                    time_us += 10_000
                said = [line for line in until(listening, "STATUS=", 0.1) if "heading" in line]
            assert said == ["STATUS=heading not known yet, no fix; 5 sensors"]
        finally:
            daemon.kill()
