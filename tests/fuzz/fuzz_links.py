"""Targets: what comes over links."""

import hashlib
import json
import math
import sys
from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from itertools import pairwise
from typing import Any

import numpy as np
from fuzz_checks import (
    ALL_GPS,
    ROOM,
    check_config,
    check_estimates,
    configs,
    decoded_all,
    done,
    frame_of,
)
from fuzz_script import INPUTS, ORDERS, PEERS, START_US, Sent, messages
from msgspec import structs
from network import OWN, Network
from pymavlink.generator.mavcrc import x25crc
from streams import KEY

from risaf_link.config import Config
from risaf_link.core.estimate import EstimateBlock
from risaf_link.core.fusion import EpochBlock
from risaf_link.errors import LogError
from risaf_link.mavlink.block import BlockReader
from risaf_link.mavlink.dialect import CRC_EXTRA, IDS
from risaf_link.mavlink.epoch import ArrayParameters, EpochAssembler, GyroChunk
from risaf_link.mavlink.frame import Frame, FrameParser
from risaf_link.mavlink.ingest import Ingest
from risaf_link.mavlink.parameters import rounded
from risaf_link.mavlink.peers import EMITTED
from risaf_link.mavlink.signing import LinkSigning, SigningKey, SigningParameters
from risaf_link.mavlink.tlog import LEAP_US, record
from risaf_link.publish.access import MqttParameters, MqttRates
from risaf_link.publish.scrape import MetricsParameters
from risaf_link.remembered import decoded, encoded
from risaf_link.replay import Replay, Selection
from risaf_link.service import Service

ARRAYS = [
    ArrayParameters(),
    ArrayParameters(sensors=5, max_wait=0.0),
    ArrayParameters(encodings=("IMU", "GYRO_ARRAY"), gyro_range=1.0),
    ArrayParameters(encodings=("DEBUG_FLOAT_ARRAY",), gyro_scale=1e-3),
]


def ingest(data: bytes) -> None:
    """What cannot be used is counted; whole epochs at once are what single frames make."""
    array = ARRAYS[data[0] % len(ARRAYS)] if data else ARRAYS[0]
    sent = list(messages(data[1:], INPUTS))
    one, by_one = _Reading(array), _Reading(array)
    parser = FrameParser()
    table = parser.receive_table(b"".join(each.raw for each in sent))
    assert table.raw(but=-1) == [each.raw for each in sent]
    times_us = np.array([each.received_us for each in sent], np.uint64)
    for row, each in enumerate(sent):
        by_one.take(table.frame(row), each.received_us)
    if sent:
        for item in BlockReader(one.ingest, one.assembler).read(table, times_us):
            one.take_block(item) if isinstance(item, EpochBlock) else one.take(*item)
    assert one.told() == by_one.told()


class _Reading:
    """Epochs of one array, and the account of them."""

    def __init__(self, array: ArrayParameters) -> None:
        self.ingest = Ingest(array, ALL_GPS, OWN)
        self.assembler = EpochAssembler(array)
        self._out: list[tuple[Any, ...]] = []
        self._last_us: int | None = None
        self._samples = 0

    def take(self, frame: Frame, received_us: int) -> None:
        datum = self.ingest.decode(frame, received_us)
        if isinstance(datum, GyroChunk):
            self._samples += datum.samples
            self._note(self.assembler.add(datum))
        elif datum is not None:
            self._out.append((repr(datum),))

    def take_block(self, block: EpochBlock) -> None:
        self._samples += block.rates_b.shape[0] * block.rates_b.shape[1]
        self._samples += block.forces_b.shape[0] * block.forces_b.shape[1]
        for each in zip(
            block.time_us.tolist(), block.dt.tolist(), block.rates_b, block.forces_b, strict=True
        ):
            self._out.append((*each[:2], each[2].tobytes(), each[3].tobytes(), 0))

    def told(self) -> tuple[Any, ...]:
        self._note(self.assembler.flush())
        counts = +self.assembler.counts
        epochs = [each for each in self._out if len(each) > 1]
        assert counts["epochs"] == len(epochs)
        assert counts["incomplete"] == sum(lost > 0 for *_, lost in epochs)
        return self._out, +self.ingest.counts, counts

    def _note(self, epochs: Iterable[Any]) -> None:
        for e in epochs:
            assert e.rates_b.ndim == e.forces_b.ndim == 2
            assert 0 <= e.dt < math.inf
            assert not np.isinf(e.rates_b).any()
            assert not np.isinf(e.forces_b).any()
            self._out.append((e.time_us, e.dt, e.rates_b.tobytes(), e.forces_b.tobytes(), e.lost))


SILENT = structs.replace(Config(), emit={}, gps=ALL_GPS)


def component(data: bytes) -> None:
    """Every command and request to us alone is answered, and nothing that is not for us."""
    network = Network(SILENT, keep=lambda _: None)
    lists: Counter[Any] = Counter()
    for k, sent in enumerate(messages(data, [*ORDERS, "HEARTBEAT", "COMMAND_ACK", "TIMESYNC"])):
        frame = frame_of(sent.raw)
        network.now_us = max(network.now_us, sent.received_us % 10**12)
        heard = network.take(frame, sent.peer)
        _check_answer(network, frame, heard)
        lists[sent.peer] += frame.message_id == 21 and _to(frame) in {OWN, (0, 0)}
        if k % 3 == 0:
            network.wait(0.1)
    _check_parameters(network)


def _to(frame: Frame) -> tuple[int, int]:
    """Whom an order is for, as pymavlink reads it."""
    message = decoded_all([frame.raw])[0]
    return message.target_system, message.target_component


def _check_answer(network: Network, frame: Frame, heard: list[Any]) -> None:
    (asked,) = decoded_all([frame.raw])
    kind = asked.get_type()
    if (frame.system, frame.component) == OWN or kind not in ORDERS:
        return
    to = asked.target_system, asked.target_component
    acks = [m for m in heard if m.get_type() == "COMMAND_ACK"]
    told = [m for m in heard if m.get_type() in {"PARAM_VALUE", "PARAM_ERROR"}]
    if not (to[0] in {0, OWN[0]} and to[1] in {0, OWN[1]}):
        assert not heard
    elif kind in {"COMMAND_LONG", "COMMAND_INT"} and to == OWN:
        mine = [m for m in acks if m.command == asked.command]
        assert 1 <= len(mine) <= (2 if asked.command in {241, 246} else 1)
    elif kind in {"PARAM_REQUEST_READ", "PARAM_SET"} and to == OWN:
        assert told
    if kind == "PARAM_SET":
        for value in (m for m in told if m.get_type() == "PARAM_VALUE"):
            in_force = network.parameters.value(value.param_index)
            assert value.param_value == rounded(in_force)


def _check_parameters(network: Network) -> None:
    """Whatever was set, the configuration is one that a file may hold."""
    check_config(network.parameters.tuned, SILENT)


def service(data: bytes) -> None:
    """Whatever is sent to the service, all that it says is sound, and a replay says the same."""
    base = configs()[data[0] % len(configs()) if data else 0]
    hertz = data[-1] % 51 if data else 0
    outputs = {"mqtt": MqttParameters("mqtt://nobody", rates=MqttRates(*[hertz] * 4))}
    outputs |= {"metrics": MetricsParameters("127.0.0.1:1")}
    config = structs.replace(base, emit=dict.fromkeys(EMITTED.values(), 8.0), **outputs)
    all_sent = list(messages(data[1:]))
    running = Deaf(config).given(all_sent)
    usual = Deaf(config, prompt=False).given(all_sent)
    assert sorted(usual.sent, key=_peer) == sorted(running.sent, key=_peer)
    assert usual.account() == running.account()
    assert usual.published() == running.published()
    _check_replay(config, running.recorded, running.tracks)
    last: dict[Any, int] = {}
    for (peer, raw), message in zip(
        running.sent, decoded_all(raw for _, raw in running.sent), strict=True
    ):
        if peer in last:
            assert raw[4] == (last[peer] + 1) % 256
        last[peer] = raw[4]
        _check_message(message)
    memory = running.pipeline.memory()
    if memory is not None:
        decoded(encoded(memory))


class Deaf(Service):
    """The service, whose links are handed frames and whose own frames are kept."""

    def __init__(self, config: Config, prompt: bool = True) -> None:
        super().__init__(config, clock_us=lambda: self.now_us)
        if not prompt:
            self._prompt.answer = lambda *_: None  # type: ignore[method-assign]
        self.now_us = START_US
        self.steady_us = 0  # a clock that does not jump
        self.sent: list[tuple[Any, bytes]] = []
        self.tracks: list[bytes] = []
        self.recorded: list[tuple[int, bytes]] = []
        self._recordings = [self]  # type: ignore[list-item]
        self._outputs._leave_out = _fail

    def record(self, received_us: int, *frames: bytes) -> None:
        """Stand in for a recording."""
        self.recorded += [(received_us, raw) for raw in frames]

    def _peers(self) -> list[tuple[str, str]]:
        return PEERS

    def _hand_out(self, frames: list[tuple[Any, bytes]]) -> None:
        self.sent += frames

    def _send(self, blocks: list[EstimateBlock]) -> None:
        self._look(blocks)
        super()._send(blocks)

    def _catch_up(self, blocks: list[EstimateBlock]) -> None:
        self._look(blocks)
        super()._catch_up(blocks)

    def _look(self, blocks: list[EstimateBlock]) -> None:
        for block in blocks:
            check_estimates(block)
            self.tracks.append(block.track.values.tobytes())

    def given(self, all_sent: list[Sent]) -> "Deaf":
        """Take all that is sent, to the end."""
        for sent in all_sent:
            self.receive(sent)
        self.end()
        return self

    def receive(self, sent: Sent) -> None:
        """Take a frame from a peer, and do what is due by time."""
        self.steady_us += max(sent.received_us - self.now_us, 0)
        self.now_us = sent.received_us
        link = next(link for link in self.links if link.name == sent.peer[0])
        self._receive(link, sent.raw, sent.peer[1])
        if sent.sequence % 4 == 0:
            self._take_held()
            self._component.advance(self.steady_us, self.now_us)
            self._hand_out(self._component.collect(PEERS))

    def published(self) -> list[bytes]:
        """What was last told over MQTT."""
        _, mqtt = self._outputs.running
        return [topic.last for topic in mqtt._topics]

    def end(self) -> None:
        """Do what is done at the end."""
        self._take_held()
        self._send(self.pipeline.flush(self.now_us))
        for payload in self.published():
            json.loads(payload or b"{}", parse_constant=_refuse)
        metrics, _ = self._outputs.running
        if len(self.sent) % 4 == 0:  # it takes as long as an epoch
            assert b"risaf_link" in done(metrics._make())


def _peer(sent: tuple[Any, bytes]) -> Any:
    return sent[0]


def _fail(output: Any) -> None:
    raise AssertionError(f"{output} failed") from sys.exception()


def _check_replay(config: Config, recorded: list[tuple[int, bytes]], tracks: list[bytes]) -> None:
    """A recording gives the same estimates, unless its stamps are such as no log has."""
    steps_us = [after - before for (before, _), (after, _) in pairwise(recorded)]
    if not recorded or not all(0 <= step <= LEAP_US for step in steps_us):
        return
    path = ROOM / "recorded.tlog"
    path.write_bytes(b"".join(record(*each) for each in recorded))
    blocks, again = Replay(config, path, Selection()).blocks(), []
    with suppress(LogError):  # it may hold nothing that can be used
        again += [block.track.values.tobytes() for block in blocks]
    assert b"".join(again) == b"".join(tracks)


def _check_message(message: Any) -> None:
    if message.get_type() == "ATTITUDE_QUATERNION":
        norm = math.hypot(message.q1, message.q2, message.q3, message.q4)
        assert abs(norm - 1.0) < 1e-5
        assert math.isfinite(message.rollspeed + message.pitchspeed + message.yawspeed)
    if message.get_type() == "ODOMETRY":
        assert abs(math.hypot(*message.q) - 1.0) < 1e-5


def signing(data: bytes) -> None:
    """A signed frame is taken if it is rightly signed and later than the one before; else not."""
    take_all = data[:1] < b"\x20"
    parameters = SigningParameters("key", accept_unsigned=take_all)
    ours = LinkSigning(SigningKey(KEY), 0, parameters)
    ours.key.advance(START_US)
    taken: Counter[Any] = Counter()
    latest: dict[Any, int] = {}
    for k, sent in enumerate(messages(data[1:])):
        spoiled = data[k % len(data)]
        frame = frame_of(_signed(sent, spoiled))
        accepted = ours.accepts(frame)
        taken[accepted] += 1
        if frame.signature and accepted:
            stream = frame.signature[0], frame.system, frame.component
            ticks = int.from_bytes(frame.signature[1:7], "little")
            assert spoiled & 7 != 7, "the signature is wrong"
            assert ticks > latest.get(stream, -1)
            latest[stream] = ticks
        elif not frame.signature:
            assert accepted == (take_all or sent.name == "RADIO_STATUS")
    assert ours.rejected.total() == taken[False]


def _signed(sent: Sent, spoiled: int) -> bytes:
    """A frame as a signing sender makes it: by pymavlink, the last bytes spoiled or not."""
    if spoiled & 24 == 24:
        return sent.raw
    raw = bytearray(sent.raw[:-2])
    raw[2] = 1
    crc = x25crc(bytes(raw[1:]) + bytes((CRC_EXTRA[IDS[sent.name]],))).crc
    raw += crc.to_bytes(2, "little")
    ticks = max(sent.received_us // 10 - 142_007_040_000_000 + (spoiled >> 6) * 100, 0) % 2**48
    raw += bytes((spoiled >> 5,)) + ticks.to_bytes(6, "little")
    digest = bytearray(hashlib.sha256(KEY + bytes(raw)).digest()[:6])
    digest[spoiled % 6] ^= 0x10 if spoiled & 7 == 7 else 0
    return bytes(raw + digest)


def _refuse(number: str) -> None:
    raise AssertionError(f"{number} is no JSON")
