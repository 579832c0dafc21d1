"""Epochs that are answered before account is taken of them: nothing is told otherwise, or later."""

import numpy as np
import pytest
from test_held import spoil
from wire import frame

from risaf_link.bench.feed import bursts
from risaf_link.config import load
from risaf_link.core.compiled import native
from risaf_link.mavlink.dialect import IDS
from risaf_link.mavlink.frame import FrameParser, encode
from risaf_link.mavlink.held import MESSAGE_ID
from risaf_link.remembered import encoded
from risaf_link.service import Service
from risaf_link.sim.scenario import scenario

BEGAN_US = 1_700_000_000_000_000
BEAT_S = 0.1
LINKS = (
    "links=[{name: array, url: 'udpout://127.0.0.1:14550', emit: {}},"
    " {name: autopilot, url: 'udpout://127.0.0.1:14551', emit: {ATTITUDE_QUATERNION: 50}},"
    " {name: ground, url: 'udpout://127.0.0.1:14552'}]"
)
ARRAY, AUTOPILOT, GROUND = range(3)
VEHICLE, STATION, OTHER = (1, 1), (255, 190), (1, 159)
US = {"target_system": 1, "target_component": 191}
GATE = US | {"param_id": b"HDG_GATE", "param_value": 3.5, "param_type": 9}

pytestmark = pytest.mark.skipif(
    native is None, reason="no kernel was built: that takes a C++ compiler"
)


class Recording:
    """Stands in for a recorder."""

    name, trouble = "recording", ""

    def __init__(self):
        self.frames = []

    def record(self, received_us, *frames):
        self.frames += [(received_us, raw) for raw in frames]


class Station:
    """A service that is given datagrams and beats by hand, and all that it tells."""

    def __init__(self, *settings, prompt=True):
        self.now_s = 0.0
        self.told, self.estimates = [], []
        self.recording = Recording()
        self.service = Service(
            load(None, [LINKS, *settings]), clock_us=lambda: BEGAN_US + round(1e6 * self.now_s)
        )
        self.service._recordings = [self.recording]
        observe = self.service._component.observe

        def note(estimate):
            self.estimates.append(row_of(estimate))
            observe(estimate)

        self.service._component.observe = note
        self.peers = [(link.name, "") for link in self.service.links]
        self.service._peers = lambda: list(self.peers)
        for link in self.service.links:
            link.send_to = lambda raw, peer, name=link.name: self.told.append(
                (self.now_s, name, peer, raw)
            )
        self.answered = 0
        answer = self.service._prompt.answer

        def count(*epoch):
            frames = answer(*epoch) if prompt else None
            self.answered += frames is not None
            return frames

        self.service._prompt.answer = count
        self._beat_s = 0.0

    def give(self, now_s, link, data):
        while self._beat_s <= now_s:
            self.now_s, self._beat_s = self._beat_s, self._beat_s + BEAT_S
            self.service._do_what_is_due(self.now_s)
        self.now_s = now_s
        self.service._receive(self.service.links[link], data, "")

    def end(self):
        self.service._take_held()
        self.service._send(self.service.pipeline.flush(self.service._received_us))


def row_of(estimate):
    """What an estimate says, but for the account of the array, which is as of now."""
    attitude, heading = estimate.attitude, estimate.heading
    return repr(
        (  # NaN is NaN here
            *(estimate.time_us, estimate.boot_us, estimate.elapsed),
            *(attitude.q_nb.tobytes(), attitude.rate_b.tobytes(), attitude.bias_b.tobytes()),
            *(attitude.yaw_std, attitude.aligned, attitude.resets),
            *(heading.state, heading.fused_count, heading.time_since_fused, heading.speed),
            estimate.fused.rate_b.tobytes(),
        )
    )


def drive(name, seconds=6.0, how="in order", **other):
    """Datagrams of a scenario with what else goes over a vehicle's links: (s, link, bytes)."""
    generator = np.random.default_rng(5)
    chosen = scenario(name, seed=3, duration=seconds, **other)
    next_s = 0.0
    for burst in bursts(chosen, seconds):
        for place, raw in enumerate(spoil(burst.frames, how, generator)):
            yield burst.due_s + 50e-6 * place, ARRAY, raw
        if burst.due_s >= next_s:
            next_s += 1.0
            boot_ms = 5000 + round(1000 * burst.due_s)
            yield burst.due_s + 1e-3, AUTOPILOT, sent("HEARTBEAT", VEHICLE, type=10, autopilot=3)
            yield burst.due_s + 2e-3, AUTOPILOT, sent("SYSTEM_TIME", VEHICLE, time_boot_ms=boot_ms)
            yield burst.due_s + 3e-3, GROUND, sent("HEARTBEAT", STATION, type=6, autopilot=8)


def sent(name, sender, **fields):
    """A frame, whose other fields are 0."""
    return frame(name, sender, **fields).raw


def order(command, *parameters):
    """A command to us."""
    told = {f"param{i}": value for i, value in enumerate(parameters, 1)}
    return sent("COMMAND_LONG", STATION, command=command, **US, **told)


def both(events, *settings):
    """A service that answers at once what it can, and one that takes all as it comes."""
    stations = Station(*settings), Station(*settings, prompt=False)
    for event in events:
        for station in stations:
            station.give(*event)
    for station in stations:
        station.end()
    return stations


def assert_same(prompt, usual):
    assert by_peer(prompt.told) == by_peer(usual.told)
    assert prompt.recording.frames == usual.recording.frames
    assert prompt.estimates == usual.estimates
    assert prompt.service.account() == usual.service.account()
    assert prompt.service._component.status == usual.service._component.status
    assert memory_of(prompt) == memory_of(usual)


def memory_of(station):
    memory = station.service.pipeline.memory()
    return memory and encoded(memory)


def by_peer(told):
    return sorted(told, key=lambda each: each[1:3])


@pytest.mark.parametrize("how", ["in order", "shuffled", "repeated", "lost"])
@pytest.mark.parametrize("name", ["circle", "drive1"])
def test_the_same_is_told_at_the_same_time(name, how):
    prompt, usual = both(drive(name, how=how, sensors=100))
    assert prompt.answered > (0 if how == "shuffled" else 100)
    assert len(prompt.told) > 300
    assert_same(prompt, usual)


def test_attitude_is_told_first_whatever_the_order_of_rates():
    late = "emit: {ARRAY_STATUS: 10, ATTITUDE_QUATERNION: 10, GPS_HEADING_STATUS: 10}"
    links = LINKS.replace("emit: {ATTITUDE_QUATERNION: 50}", late)
    prompt, usual = both(drive("circle", 3.0, sensors=100), links)
    assert prompt.answered > 200
    told = [int.from_bytes(raw[MESSAGE_ID], "little") for *_, raw in prompt.told]
    assert told.index(IDS["ATTITUDE_QUATERNION"]) < told.index(IDS["ARRAY_STATUS"])
    assert_same(prompt, usual)


@pytest.mark.parametrize("method", ["mean", "median", "risaf"])
def test_by_every_method(method):
    prompt, usual = both(drive("circle", 3.0, sensors=100), f"fusion.method={method}")
    assert prompt.answered > 200
    assert_same(prompt, usual)


def test_an_array_whose_epoch_is_one_datagram():
    prompt, usual = both(drive("circle", 3.0, sensors=30))
    assert prompt.answered > 200
    assert_same(prompt, usual)


def test_what_is_calibrated(tmp_path):
    triad = "{bias: [0.01, -0.02, 0.005], scale: [1.01, 0.99, 1.0]}"
    triads = ", ".join([triad] * 100)
    path = tmp_path / "calibration.yaml"
    path.write_text(f"gyros: [{triads}]\naccels: [{triads}]\n")
    prompt, usual = both(drive("drive1", 3.0, sensors=100), f"array.calibration={path}")
    assert prompt.answered > 200
    assert_same(prompt, usual)


def test_where_a_calibration_does_not_fit_nothing_is_told(tmp_path):
    path = tmp_path / "calibration.yaml"
    path.write_text("gyros: [{}]\n")
    prompt, usual = both(drive("circle", 2.0, sensors=100), f"array.calibration={path}")
    assert (prompt.answered, len(prompt.estimates)) == (0, 0)
    assert_same(prompt, usual)


def test_another_filter_takes_every_epoch_as_it_comes():
    prompt, usual = both(drive("circle", 2.0, sensors=40), "attitude.filter=paper")
    assert prompt.answered == 0
    assert_same(prompt, usual)


def test_outputs_are_told_the_same():
    rates = "rates: {attitude: 5, heading: 2, array: 1, sensors: 0.5}"
    settings = "metrics.listen=127.0.0.1:1", f"mqtt={{url: 'mqtt://nobody', {rates}}}"
    stations = Station(*settings), Station(*settings, prompt=False)
    published = [watch_mqtt(station) for station in stations]
    for event in drive("circle", 4.0, sensors=100):
        for station in stations:
            station.give(*event)
    for station in stations:
        station.end()
        metrics, _ = station.service._outputs.running
        assert sum(metrics._latencies._counts) == len(station.estimates)
    assert stations[0].answered > 200
    assert len(published[0]) > 30
    assert published[0] == published[1]
    assert_same(*stations)


def watch_mqtt(station):
    """What is published from now on, and when."""
    _, mqtt = station.service._outputs.running
    published, take = [], mqtt.take

    def watched(*told):
        take(*told)
        for topic in mqtt._topics:
            published.extend((station.now_s, topic.name, payload) for payload in topic.waiting)
            topic.waiting.clear()

    mqtt.take = watched
    return published


@pytest.mark.parametrize("seed", range(6))
def test_whatever_comes_in_between(seed):
    """Garbage, cut datagrams, other arrays, orders, and silence, each at any moment."""
    generator = np.random.default_rng(seed)

    def disturbance(raw):
        interval = generator.choice([5e3, 1e5])
        return [
            (ARRAY, generator.bytes(30)),
            (ARRAY, raw[: generator.integers(len(raw))]),
            (ARRAY, raw + raw[:20]),
            (AUTOPILOT, raw),
            (AUTOPILOT, other_array(raw)),
            (ARRAY, sent("RAW_IMU", VEHICLE, time_usec=5_000_000, xgyro=5)),
            (GROUND, order(511, IDS["ATTITUDE_QUATERNION"], interval)),
            (GROUND, order(511, IDS["ATTITUDE_QUATERNION_COV"], 2e4)),
            (GROUND, order(512, IDS["ARRAY_STATUS"])),
            (GROUND, order(246, 1)),  # restarts the filter
            (GROUND, order(241, 1)),  # calibrates
            (GROUND, sent("PARAM_SET", STATION, **GATE)),
        ][generator.integers(12)]

    def disturbed():
        late_s = 0.0
        for now_s, link, raw in drive("drive1", 4.0, sensors=60):
            yield now_s + late_s, link, raw
            if generator.random() < 0.02:
                yield now_s + late_s + 10e-6, *disturbance(raw)
            if generator.random() < 0.001:
                late_s += generator.choice([0.3, 3.0])

    prompt, usual = both(disturbed())
    assert prompt.answered > 50
    assert_same(prompt, usual)


def other_array(raw):
    """The same, of an array with another id."""
    (read,) = FrameParser().receive_data(raw)
    payload = read.payload.ljust(254, b"\0")
    return encode(read.message_id, payload[:-1] + b"\1", read.sequence, *OTHER)


def test_a_peer_that_is_new_is_told_of_the_next_epoch():
    stations = Station(), Station(prompt=False)
    for now_s, link, raw in drive("circle", 3.0, sensors=100):
        for station in stations:
            if now_s > 1.5 and len(station.peers) == 3:
                station.peers.append(("ground", "another"))
            station.give(now_s, link, raw)
    for station in stations:
        station.end()
    prompt, usual = stations
    assert prompt.answered > 200
    assert any(peer == "another" for _, _, peer, _ in prompt.told)
    assert_same(prompt, usual)
