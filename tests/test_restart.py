"""The daemon killed and started again: what it kept, what it says of its heading, what replays."""

import asyncio
import json
import math
import signal
import sys
import time

import numpy as np
import pytest
from daemon import SAFETY_S, Running, bursts, config_for, feed, outputs, replayed
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs
from ports import free_port
from vehicle import Vehicle

from risaf_link.config import Config, StateParameters
from risaf_link.core.rotation import wrap
from risaf_link.kept import load_for_replay
from risaf_link.mavlink import risaf
from risaf_link.mavlink.frame import FrameParser
from risaf_link.pipeline import Pipeline
from risaf_link.remembered import MemoryFile, decoded, encoded
from risaf_link.sim.scenario import scenario
from risaf_link.sim.stream import frames

SENSORS, NOISE, BIAS = 12, 1e-3, 5e-3  # rad/s


class Drive:
    """A vehicle whose clock is that of the host, in curves; what it says is answered at once."""

    def __init__(self, ground, port, seed):
        self.generator = np.random.default_rng(seed)
        self.ground, self.to = ground, ("127.0.0.1", port)
        self.biases = self.generator.normal(0.0, BIAS, (SENSORS, 3))
        self.vehicle = Vehicle(SENSORS)
        self.began, self.last_us, self.fixed_us, self.told_us = time.monotonic(), 0, 0, 0
        self.errors = []  # (s, rad, rad)

    def yaw(self, time_us):
        return 0.5 + 0.8 * math.sin(0.35 * time_us / 1e6)

    def send(self, gps):
        now_us = round((time.monotonic() - self.began) * 1e6) + 2_000_000
        if now_us - self.told_us > 300_000:
            self.told_us = now_us
            self._post(self.vehicle.info())
        rate = (self.yaw(now_us) - self.yaw(self.last_us)) / ((now_us - self.last_us) / 1e6)
        noise = NOISE * self.generator.normal(size=self.biases.shape)
        self._post(self.vehicle.epoch(now_us, self.biases + noise + (0.0, 0.0, rate)))
        self.last_us = now_us
        if gps and now_us - self.fixed_us > 200_000:
            self.fixed_us = now_us
            course = wrap(self.yaw(now_us - 110_000) + 0.01 * self.generator.normal())
            self._post(self.vehicle.fix(now_us, course))

    def _post(self, frame):
        self.ground.transport.sendto(frame.raw, self.to)

    async def go(self, seconds, gps=True):
        """Drive until the daemon has told of its heading for so long."""
        first_us, before_us = None, self.last_us
        self.errors = []
        async with asyncio.timeout(SAFETY_S + seconds):
            while first_us is None or self.last_us - first_us < seconds * 1e6:
                # A fix is 0.11 s old: before that the vehicle has to be seen.
                self.send(gps and first_us is not None and self.last_us - first_us > 200_000)
                try:
                    async with asyncio.timeout(0.05):
                        frame = await self.ground.next("GPS_HEADING_STATUS")
                except TimeoutError:
                    continue
                told = risaf.MAVLink(None).parse_buffer(frame.raw)[0]
                if told.time_usec <= before_us:  # of the one that was killed
                    continue
                first_us = told.time_usec if first_us is None else first_us
                error = wrap(told.yaw - self.yaw(told.time_usec)) if told.yaw_std < 3.0 else 0.0
                self.errors.append(((told.time_usec - first_us) / 1e6, error, told.yaw_std))

    @property
    def ratios(self):
        return [abs(error) / std for _, error, std in self.errors]


@pytest.mark.parametrize("seed", range(2))
async def test_killed_at_any_moment_it_is_back_at_a_heading_within_its_deviation(
    ground, tmp_path, seed
):
    state, said, port = tmp_path / "state.json", tmp_path / "said", free_port()
    links = (
        f"links=[{{name: vehicle, url: 'udpin://127.0.0.1:{port}', emit: {{}}}},"
        f"{{name: ground, url: 'udpout://127.0.0.1:{ground.port}',"
        "emit: {GPS_HEADING_STATUS: 10000}}]"
    )
    settings = [f"--set={each}" for each in (links, f"state.file={state}", "state.period=0.2")]
    command = [sys.executable, "-m", "risaf_link.cli", "run", "-v", *settings]
    drive = Drive(ground, port, seed)
    for attempt in range(3):
        with said.open("wb") as log:
            daemon = await asyncio.create_subprocess_exec(*command, stderr=log)
            try:
                await drive.go(2.0 + drive.generator.uniform(0.0, 1.5), gps=attempt != 1)
            finally:
                daemon.send_signal(signal.SIGKILL)
                await daemon.wait()
        assert max(drive.ratios) < 3.5  # of hundreds, hardly independent
        assert decoded(state.read_bytes()).array.sensors == SENSORS
        if attempt:
            assert "warm start: " in said.read_text()
        if attempt != 1:
            assert all(std < 0.2 for seconds, _, std in drive.errors if seconds > 2.0)


async def test_a_warm_start_replays_bit_for_bit_from_what_it_found(ground, tmp_path):
    state, recording = tmp_path / "state.json", tmp_path / "drive.tlog"
    config = config_for(ground, f"{{name: recording, url: 'tlog://{recording}'}}")
    config = structs.replace(config, state=StateParameters(str(state)))
    sent = bursts(400)
    async with Running(config, up=3) as service:
        await feed(ground, service, sent[:250])
    assert service.pipeline.recalled == ""
    ground.heard.clear()
    recording.unlink()
    async with Running(config, up=3) as service:
        await feed(ground, service, [sent[0][:1], *sent[250:]])
    assert "warm start: heading of " in service.pipeline.recalled
    found = structs.replace(config, state=StateParameters(f"{state}.used"))
    live = outputs(ground.heard)
    assert len(live) > 150
    assert replayed(found, recording) == live
    assert replayed(structs.replace(config, state=StateParameters()), recording) != live


def test_a_replay_uses_no_state_but_the_one_it_is_given(tmp_path):
    written = tmp_path / "vehicle.yaml"
    written.write_text("state: {file: /var/lib/risaf_link/state.json, period: 1.0}\n")
    assert load_for_replay(written).state.file == ""
    assert load_for_replay(written, ["state.file=old.json"]).state.file == "old.json"


@pytest.fixture(scope="module")
def memory():
    pipeline, parser = Pipeline(Config(), (1, 191)), FrameParser()
    for time_us, raw in frames(scenario("drive1", seed=1, duration=1.5, sensors=6)):
        for frame in parser.receive_data(raw):
            pipeline.step(frame, 1_700_000_000_000_000 + round(time_us))
    return pipeline.memory()


def test_what_is_written_is_read_again(memory, tmp_path):
    file = MemoryFile(tmp_path / "state.json")
    assert file.read() is None
    assert file.write(memory)
    again = file.read()
    assert (again.array, again.time_us) == (memory.array, memory.time_us)
    np.testing.assert_array_equal(again.attitude.covariance, memory.attitude.covariance)
    np.testing.assert_allclose(again.gyros.channels, memory.gyros.channels, atol=1e-3)
    np.testing.assert_allclose(again.gyros.bias, memory.gyros.bias, atol=1e-10)
    assert encoded(again) == encoded(memory)


@pytest.mark.parametrize("axes", [(0, 1, 2), (1,)])
def test_an_epoch_without_a_valid_reading_leaves_the_state_as_it_was(axes):
    vehicle, pipeline = Vehicle(4), Pipeline(Config(), (1, 191))
    pipeline.step(vehicle.info(), 1)
    for k in range(1, 6):
        pipeline.step(vehicle.epoch(10_000 * k), 10_000 * k)
    assert decoded(encoded(pipeline.memory())).time_us == 50_000
    rate = np.zeros((4, 3))
    rate[:, axes] = np.nan
    pipeline.step(vehicle.epoch(60_000, rate), 60_000)
    assert pipeline.memory() is None
    pipeline.step(vehicle.epoch(70_000), 70_000)
    assert decoded(encoded(pipeline.memory())).time_us == 70_000


@given(st.data())
def test_a_file_that_is_not_a_state_is_an_error_and_nothing_else(memory, data):
    content = bytearray(encoded(memory))
    kind = data.draw(st.sampled_from(["any", "cut", "flipped"]))
    if kind == "any":
        content = data.draw(st.binary())
    elif kind == "cut":
        content = content[: data.draw(st.integers(0, len(content) - 1))]
    else:
        for _ in range(data.draw(st.integers(1, 5))):
            content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    complaint = ""
    try:
        found = decoded(bytes(content))
    except ValueError as error:
        complaint = str(error)
    assert complaint.startswith("found ") if complaint else found.is_sound
    assert len(complaint) < 100


@pytest.mark.parametrize(
    "tree",
    [
        {},
        [],
        None,
        1,
        {"version": 1},
        {"version": 2, "memory": {}},
        {"version": 1, "memory": {"gyros": 3}},
    ],
)
def test_a_foreign_file_is_said_and_the_start_is_cold(tree, tmp_path, caplog):
    path = tmp_path / "state.json"
    path.write_text(json.dumps(tree))
    assert MemoryFile(path).read() is None
    (line,) = [record.getMessage() for record in caplog.records]
    assert line.startswith(f"{path}: found ")
    assert "\n" not in line


def test_a_disk_that_cannot_be_written_is_said_once(memory, tmp_path, caplog):
    file = MemoryFile(tmp_path / "none" / "state.json")
    assert [file.write(memory) for _ in range(3)] == [False] * 3
    assert len(caplog.records) == 1
