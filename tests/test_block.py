"""A log that is read in blocks of epochs gives what it gives frame by frame, however spoiled."""

import struct
from dataclasses import fields, is_dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from streams import seeded

from risaf_link.core.fusion import EpochBlock
from risaf_link.core.heading import GpsFix
from risaf_link.mavlink.block import BlockReader
from risaf_link.mavlink.clock import VehicleClock
from risaf_link.mavlink.dialect import IDS, MESSAGES, pack
from risaf_link.mavlink.epoch import (
    REVIEW,
    SHRINK_AFTER,
    ArrayParameters,
    EpochAssembler,
    GyroChunk,
)
from risaf_link.mavlink.frame import FrameParser, encode
from risaf_link.mavlink.ingest import GpsParameters, Ingest
from risaf_link.mavlink.tlog import TlogReader, record

ARRAY, OTHER, AUTOPILOT, OWN = (1, 158), (1, 159), (1, 1), (1, 191)
PERIOD_US = 10_000
BOOT_US = 5_000_000
START_US = 1_700_000_000_000_000
CHUNK = struct.Struct("<QHH120hBB")
INVALID = -32768
REMEMBERING = ("Choice", "Streams", "_Stream")


class Log:
    """Frames, each with its time of arrival, as a list of (time, name, fields, sender)."""

    def __init__(self, seed=0, epochs=300, gyros=5, accels=3, part=2, forces_first=False):
        self.random = np.random.default_rng(seed)
        self.shape = (gyros, accels, part, forces_first)
        self.sent = [sent for k in range(epochs) for sent in self.epoch(k)]

    def epoch(self, k):
        """Frames of an epoch and around it, one after another."""
        for place, (time_us, *sent) in enumerate(self.frames(k)):
            yield time_us + 40 * place, *sent

    def frames(self, k, sender=ARRAY):
        gyros, accels, part, forces_first = self.shape
        time_us = START_US + k * PERIOD_US
        if k % 100 == 0:
            info = told(gyros, accels, time_usec=BOOT_US + k * PERIOD_US)
            yield time_us, "IMU_ARRAY_INFO", info, sender
        kinds = [("GYRO_ARRAY", gyros), ("ACCEL_ARRAY", accels)]
        for name, count in kinds[::-1] if forces_first else kinds:
            for first in range(0, count, part):
                size = min(part, count - first)
                counts = self.random.integers(-2000, 2000, 3 * size)
                yield time_us, name, (BOOT_US + k * PERIOD_US, k, first, size, counts), sender
        if k % 20 == 7:
            fix = {"fix_type": 3, "lat": 470000000 + k, "lon": 80000000, "vel": 500, "cog": 100}
            yield time_us, "GPS_RAW_INT", fix | {"time_usec": BOOT_US + k * PERIOD_US}, AUTOPILOT
        if k % 100 == 50:
            yield time_us, "HEARTBEAT", {"type": 10, "autopilot": 3}, AUTOPILOT
            boot_ms = 77_000_000 + k * PERIOD_US // 1000
            yield time_us, "SYSTEM_TIME", {"time_boot_ms": boot_ms}, AUTOPILOT
        if k % 10 == 3:
            yield time_us, "HIL_STATE_QUATERNION", {"attitude_quaternion": [1, 0, 0, 0]}, AUTOPILOT

    def chunks(self):
        """Places of the array's frames."""
        return [i for i, sent in enumerate(self.sent) if sent[1] in ("GYRO_ARRAY", "ACCEL_ARRAY")]

    def raw(self):
        return b"".join(record(sent[0], framed(*sent[1:])) for sent in self.sent)


def told(gyros, accels, **other):
    scale = 0.01 if accels else float("nan")
    return {
        "gyro_scale": 1e-3,
        "gyro_range": 10.0,
        "accel_scale": scale,
        "accel_range": 100.0,
        "sensor_count": gyros,
        "name": "bench",
        **other,
    }


def framed(name, told_by, sender):
    if name in ("GYRO_ARRAY", "ACCEL_ARRAY"):
        time_us, k, first, size, counts, *array_id = told_by
        readings = [*counts, *[0] * (120 - len(counts))]
        payload = CHUNK.pack(time_us, k % 65536, first, *readings, size, *(array_id or [0]))
        return encode(IDS[name], payload, 0, *sender)
    empty = blank(name)
    message_id, payload = pack(name, **{**empty, **told_by})
    return encode(message_id, payload, 0, *sender)


def blank(name):
    kind = MESSAGES[IDS[name]]
    lengths = dict(zip(kind.ordered_fieldnames, kind.array_lengths, strict=True))
    return {
        field: b"" if kind_of == "char" else [0] * lengths[field] if lengths[field] else 0
        for field, kind_of in zip(kind.fieldnames, kind.fieldtypes, strict=True)
    }


class Reading:
    """What comes out of a log."""

    def __init__(self, **parameters):
        array = ArrayParameters(**parameters)
        self.ingest = Ingest(array, GpsParameters(), OWN)
        self.assembler = EpochAssembler(array)
        self.clock = VehicleClock()
        self.out = []
        self.blocks = []

    def step(self, frame, received_us):
        self.clock.hear(frame, received_us)
        datum = self.ingest.decode(frame, received_us)
        if isinstance(datum, GpsFix):
            self.out.append(("gps", repr(datum)))
        elif isinstance(datum, GyroChunk):
            self.note(self.assembler.add(datum), received_us)

    def note(self, epochs, received_us):
        for e in epochs:
            self.epoch(e.time_us, e.dt, e.rates_b, e.forces_b, e.lost, received_us)

    def epoch(self, time_us, dt, rates_b, forces_b, lost, received_us):
        boot_us = self.clock.boot_us(time_us, received_us)
        readings = (rates_b.shape, rates_b.tobytes(), forces_b.shape, forces_b.tobytes())
        self.out.append((int(time_us), float(dt), *readings, lost, int(received_us), int(boot_us)))

    def finish(self):
        self.note(self.assembler.flush(), 0)
        counts = (+self.ingest.counts, +self.assembler.counts)
        return self.out, counts, (state(self.ingest), state(self.assembler))


def frame_by_frame(raw, **parameters):
    reading = Reading(**parameters)
    for time_us, frame in TlogReader([raw]):
        reading.step(frame, time_us)
    return reading.finish()


def in_blocks(raw, size=1 << 20, **parameters):
    """As `frame_by_frame`, and the blocks."""
    reading = Reading(**parameters)
    reader = BlockReader(reading.ingest, reading.assembler)
    if reader._finder is None:
        pytest.skip("no kernel was built: that takes a C++ compiler")
    for table, times_us in TlogReader(raw[i : i + size] for i in range(0, len(raw), size)).tables():
        for item in reader.read(table, times_us):
            if isinstance(item, EpochBlock):
                reading.blocks.append(item)
                columns = (item.time_us, item.dt, item.rates_b, item.forces_b)
                for *epoch, received_us in zip(*columns, item.received_us, strict=True):
                    reading.epoch(*epoch, 0, received_us)
            else:
                reading.step(*item)
    return reading.finish(), reading.blocks


def state(of):
    """All that is remembered, in a form that can be compared."""
    if isinstance(of, np.ndarray):
        return of.shape, of.tobytes()
    if isinstance(of, dict):
        if hasattr(of, "most_common"):  # counted in another order
            of = dict(sorted((+of).items()))
        return [(key, state(value)) for key, value in of.items()]
    if isinstance(of, GyroChunk):
        return of.source, of.time_us, of.received_us, of.sequence
    if type(of).__name__ == "Instant":  # what was handed on is kept to know which samples came
        return of.came.tolist(), of.count
    if type(of).__name__ == "Roster":
        gone = {time_us: of.recall(time_us) for time_us in list(of.gone)}
        rest = {name: value for name, value in vars(of).items() if name != "_whole"}
        return state({**rest, "gone": gone, "_attended": of.attended})
    if is_dataclass(of):
        return [state(getattr(of, field.name)) for field in fields(of)]
    if isinstance(of, (Ingest, EpochAssembler)) or type(of).__name__ in REMEMBERING:
        return [state(value) for name, value in vars(of).items() if name != "_readers"]
    return repr(of)


def assert_same(log, sizes=(1 << 20,), **parameters):
    raw = log.raw() if isinstance(log, Log) else log
    expected = frame_by_frame(raw, **parameters)
    for size in sizes:
        found, blocks = in_blocks(raw, size, **parameters)
        for got, wanted in zip(found, expected, strict=True):
            assert got == wanted
    return expected, blocks


def share(blocks, expected):
    return sum(map(len, blocks)) / sum(out[0] != "gps" for out in expected[0])


class TestUsual:
    @pytest.mark.parametrize("forces_first", [False, True])
    @pytest.mark.parametrize(
        ("gyros", "accels", "part"),
        [(1, 0, 40), (5, 3, 2), (40, 40, 40), (150, 0, 40), (90, 90, 30)],
    )
    def test_epochs_come_in_blocks(self, gyros, accels, part, forces_first):
        log = Log(1, 1200, gyros, accels, part, forces_first)
        expected, blocks = assert_same(log, (1 << 20, 30_000))
        assert share(blocks, expected) > 0.95

    def test_it_does_not_matter_where_the_log_is_cut(self):
        assert_same(Log(2, 60), range(300, 1500, 97))

    def test_the_sequence_number_turns_over(self):
        log = Log(3, 0)
        log.sent = [sent for k in range(65_400, 65_700) for sent in log.epoch(k)]
        expected, blocks = assert_same(log)
        assert share(blocks, expected) > 0.95

    def test_gps_in_the_middle_of_an_epoch_does_not_break_it(self):
        log = Log(4, 300, accels=0)
        log.sent = [sent for sent in log.sent if sent[1] != "GPS_RAW_INT"]
        fix = next(sent for sent in Log(4, 20).sent if sent[1] == "GPS_RAW_INT")
        for place in log.chunks()[-1:10:-50]:
            log.sent.insert(place, (log.sent[place][0], *fix[1:]))
        expected, blocks = assert_same(log)
        assert share(blocks, expected) > 0.95

    def test_what_has_nothing_to_do_with_the_array_does_not_end_a_run(self, monkeypatch):
        runs = []
        take_block = EpochAssembler.take_block
        monkeypatch.setattr(
            EpochAssembler, "take_block", lambda *args: runs.append(take_block(*args))
        )
        log = Log(4, 10 * REVIEW)
        repeated = {name for _, name, *_ in log.sent} - {"GYRO_ARRAY", "ACCEL_ARRAY"}
        assert repeated >= {"GPS_RAW_INT", "HEARTBEAT", "IMU_ARRAY_INFO"}
        in_blocks(log.raw())
        assert len(runs) < 15

    def test_nor_do_the_sensors_of_an_autopilot_that_are_not_listened_to(self):
        log = Log(4)
        imus(log, 0, 2)
        expected, blocks = assert_same(log)
        assert share(blocks, expected) > 0.95
        assert len(blocks) < len(Log(4).sent) / 20
        assert expected[1][0]["other_source"] > 100

    def test_invalid_and_saturated_readings_are_nan_and_counted(self):
        log = Log(5)
        for place in log.chunks()[::3]:
            counts = log.sent[place][2][4]
            counts[log.random.integers(len(counts))] = log.random.choice(
                [INVALID, 32767, 9999, -10000]
            )
        expected, blocks = assert_same(log)
        assert share(blocks, expected) > 0.95
        assert expected[1][0]["invalid"] > 50 < expected[1][0]["saturated"]

    @pytest.mark.parametrize("gyro_range", [0.0, 1.5])
    def test_the_configuration_may_tell_the_scale(self, gyro_range):
        log = Log(6, accels=0)
        log.sent = [sent for sent in log.sent if "INFO" not in sent[1]]
        _, blocks = assert_same(log, gyro_scale=1e-3, gyro_range=gyro_range)
        assert blocks


def lose(log, at, n):
    del log.sent[at : at + n]


def double(log, at, n):
    log.sent[at:at] = log.sent[max(0, at - n) : at]


def swap(log, at, n):
    log.sent[at : at + n] = log.sent[at : at + n][::-1]


def delay(log, at, n):
    log.sent.insert(min(at + 3 * n, len(log.sent) - 1), log.sent.pop(at))


def silence(log, at, _):
    """One part of the array falls silent."""
    first = log.shape[2]
    log.sent[at:] = [s for s in log.sent[at:] if not (s[1] == "GYRO_ARRAY" and s[2][2] == first)]


def silence_forces(log, at, _):
    log.sent[at:] = [sent for sent in log.sent[at:] if sent[1] != "ACCEL_ARRAY"]


def slow_forces(log, at, n):
    log.sent[at:] = [s for s in log.sent[at:] if s[1] != "ACCEL_ARRAY" or s[2][1] % (n + 1) == 0]


def resize(log, at, n):
    """The array is another one from now on, and says so later."""
    other = Log(n, 600, *((log.shape[0] + n - 3) or 1, log.shape[1], 2))
    log.sent[at:] = [sent for sent in other.sent if sent[0] > log.sent[at][0]][: len(log.sent)]


def tell(log, at, n):
    """The array says something new of itself."""
    news = [
        told(log.shape[0], log.shape[1], gyro_scale=2e-3),
        told(log.shape[0] + 1, log.shape[1]),
        told(log.shape[0], 0),
        told(log.shape[0], log.shape[1], gyro_scale=0.0),
        told(log.shape[0], log.shape[1], gyro_range=1.0),
    ]
    log.sent.insert(at, (log.sent[at][0], "IMU_ARRAY_INFO", news[n % len(news)], ARRAY))


def be_silent_of_itself(log, at, _):
    log.sent[:at] = [sent for sent in log.sent[:at] if "INFO" not in sent[1]]


def another(log, at, n):
    """A second array sends as well."""
    sender = (OTHER, (1, 157), ARRAY, OWN)[n % 4]
    for place in range(len(log.sent) - 1, at, -7):
        time_us, name, told_by, _ = log.sent[place]
        if name == "GYRO_ARRAY":
            told_by = (*told_by[:5], 1) if sender == ARRAY else told_by
            log.sent.insert(place, (time_us, name, told_by, sender))


def imus(log, at, n):
    """The autopilot sends what its own sensors read."""
    for place in range(len(log.sent) - 1, at, -5 - n):
        time_us = log.sent[place][0]
        boot_us = max(time_us - START_US, 0)
        messages = [
            ("SCALED_IMU", {"time_boot_ms": boot_us // 1000, "xgyro": place % 100}),
            ("SCALED_IMU3", {}),
            ("HIGHRES_IMU", {"time_usec": boot_us, "zgyro": 1.0}),
            ("RAW_IMU", {"time_usec": 1 << 63}),
            ("DEBUG_FLOAT_ARRAY", {"time_usec": boot_us, "name": "gyro"}),
            ("DEBUG_FLOAT_ARRAY", {"time_usec": boot_us, "name": "other"}),
        ]
        log.sent.insert(place, (time_us, *messages[log.random.integers(len(messages))], AUTOPILOT))


def jump(log, at, n):
    """The array's clock is set."""
    step_us = (-7_000_000, -40_000, 35_000, 1_500_000, 90_000_000, 1 << 62)[n % 6]
    for place in log.chunks():
        if place >= at:
            time_us, name, (array_us, *rest), sender = log.sent[place]
            log.sent[place] = (time_us, name, (max(0, array_us + step_us), *rest), sender)


def jump_once(log, at, n):
    kept = log.sent[at + 1 :]
    jump(log, at, n)
    log.sent[at + 1 :] = kept


def jump_number(log, at, n):
    for place in log.chunks():
        if place >= at:
            time_us, name, (array_us, k, *rest), sender = log.sent[place]
            log.sent[place] = (time_us, name, (array_us, k + n, *rest), sender)


def jump_arrival(log, at, n):
    step_us = (-3_600_000_000, 2_000_000, 5_000_000, 3_600_000_000)[n % 4]
    log.sent[at:] = [(time_us + step_us, *rest) for time_us, *rest in log.sent[at:]]


def garble(log, at, n):
    """A frame that cannot be: too many sensors, none, or some where there are none."""
    place = min(log.chunks(), key=lambda chunk: abs(chunk - at))
    time_us, name, (array_us, k, first, *_), sender = log.sent[place]
    first, size = ((first, 41), (first, 0), (65_000, 1), (700, 1), (9, 2))[n % 5]
    counts = [1] * 3 * min(size, 40)
    log.sent[place] = (time_us, name, (array_us, k, first, size, counts), sender)


def begun_at(log, at):
    """Where an epoch begins, at a place or behind it."""
    numbers = {i: log.sent[i][2][1] for i in log.chunks() if i >= at}
    return next(i for i, k in numbers.items() if k != numbers[min(numbers)])


SPOILERS = [
    *(lose, double, swap, delay, silence, silence_forces, slow_forces, resize, tell),
    *(be_silent_of_itself, another, imus, jump, jump_once, jump_number, jump_arrival, garble),
]


class TestSpoiled:
    @pytest.mark.parametrize("n", range(1, 5))
    @pytest.mark.parametrize("spoil", SPOILERS)
    def test_in_one_way(self, spoil, n):
        log = Log(n, 260, forces_first=n % 2 == 0)
        at = seeded(n).randrange(600, 1000)
        spoil(log, begun_at(log, at) if n % 2 else at, n)
        assert_same(log, (1 << 20, 4_000))

    @pytest.mark.parametrize("n", range(4))
    def test_by_an_autopilot_that_is_heard_when_the_array_has_been_silent(self, n):
        log = Log(n, 260)
        imus(log, 0, n)
        names = [sent[1] for sent in log.sent]
        jump_arrival(log, names.index("HIGHRES_IMU", 700), n)
        (_, (unused, assembly), _), _ = assert_same(log)
        assert (assembly["source_changes"] > 0) == (n != 1)
        assert unused["other_source"] > 50

    @settings(max_examples=100)
    @given(
        st.integers(0, 99),
        st.sampled_from([(5, 3, 2, False), (4, 4, 4, True), (3, 0, 1, False), (2, 2, 1, False)]),
        st.lists(
            st.tuples(st.sampled_from(SPOILERS), st.floats(0, 0.999), st.integers(1, 12)),
            max_size=5,
        ),
        st.sampled_from(
            [{}, {"sensors": 5}, {"max_wait": 0.0}, {"id": 1}, {"encodings": ("IMU", "GYRO_ARRAY")}]
        ),
    )
    def test_in_several(self, seed, shape, spoilers, parameters):
        log = Log(seed, 260, *shape)
        for spoil, place, n in spoilers:
            spoil(log, int(place * len(log.sent)), n)
            if len(log.sent) < 10:
                return
        assert_same(log, (1 << 20, 3_000), **parameters)

    def test_accelerometers_that_a_review_finds_too_seldom_to_be_waited_for(self):
        log = Log(0, 260)
        silence_forces(log, 0, 1)
        resize(log, round(0.75 * len(log.sent)), 1)
        assert_same(log, (1 << 20, 3_000))

    def test_a_size_that_shrinks_by_silence(self):
        log = Log(7, 2 * SHRINK_AFTER + 300, 4, 0, 2)
        log.sent = [s for s in log.sent if "INFO" not in s[1]]
        silence(log, 200, 0)
        _, blocks = assert_same(log, gyro_scale=1e-3)
        assert [len(block.rates_b[0]) for block in (blocks[0], blocks[-1])] == [4, 2]

    def test_blocks_go_on_behind_it(self):
        for spoil in (lose, double, swap, delay, jump, jump_once, jump_number, jump_arrival, tell):
            log = Log(8, 600)
            spoil(log, 700, 3)
            expected, blocks = assert_same(log)
            assert share(blocks, expected) > 0.7, spoil


def test_a_block_that_does_not_follow_is_refused():
    assembler = EpochAssembler(ArrayParameters())
    _, blocks = in_blocks(Log(9).raw())
    with pytest.raises(ValueError, match="block"):
        assembler.take_block(blocks[0])


def test_frames_that_mean_nothing_to_the_pipeline_are_left_out():
    reading = Reading()
    reader = BlockReader(reading.ingest, reading.assembler)
    raw = framed("HIL_STATE_QUATERNION", {}, AUTOPILOT) + framed("HEARTBEAT", {}, AUTOPILOT)
    parser = FrameParser()
    table = parser.receive_table(raw)
    items = list(reader.read(table, np.zeros(len(table), np.uint64)))
    assert [frame.message_id for frame, _ in items] == [IDS["HEARTBEAT"]]


class TestNext:
    """The next epoch alone."""

    @pytest.fixture
    def reader(self):
        """One that has read thirty epochs of `LOG`."""
        reading = Reading()
        reader = BlockReader(reading.ingest, reading.assembler)
        if reader._finder is None:
            pytest.skip("no kernel was built: that takes a C++ compiler")
        for table, times_us in TlogReader([Log(0, 30).raw()]).tables():
            for item in reader.read(table, times_us):
                if not isinstance(item, EpochBlock):
                    reading.step(*item)
        return reader

    def next(self, reader, *frames, ago=0):
        time_us, sequence = reader._assembler.last.time_us, reader._assembler.last.sequence
        return reader.next(b"".join(frames), time_us - ago * PERIOD_US, sequence - ago)

    def test_it_is_what_a_block_has(self, reader):
        time_us, dt, readings = self.next(reader, *frames_of(30))
        for table, times_us in TlogReader([stamped(frames_of(30))]).tables():
            (block,) = reader.read(table, times_us)
        assert (time_us, dt) == (block.time_us[0], block.dt[0])
        assert readings == block.rates_b.tobytes() + block.forces_b.tobytes()

    def test_what_is_more_less_or_other_is_not(self, reader):
        epoch, info = frames_of(30), framed("IMU_ARRAY_INFO", told(5, 3), ARRAY)
        broken = bytearray(epoch[0])
        broken[20] ^= 1
        for frames in (
            [],
            epoch[:-1],
            epoch[1:],
            epoch[::-1],
            [*epoch, epoch[-1]],
            [*epoch, *frames_of(31)],
            [*epoch, info],
            [info, *epoch],
            [*epoch, b"\0"],
            [b"\0", *epoch],
            [*epoch, epoch[0][:30]],
            [broken, *epoch[1:]],
            frames_of(29),
            frames_of(31),
        ):
            assert self.next(reader, *map(bytes, frames)) is None
        assert self.next(reader, *epoch) is not None

    def test_nothing_is_taken(self, reader):
        assert self.next(reader, *frames_of(30)) == self.next(reader, *frames_of(30))
        assert self.next(reader, *frames_of(29), ago=1) is not None


def frames_of(epoch):
    """Frames of the array at one epoch of `Log(0)`, each."""
    log = Log(0, 0)
    sent = (each for each in log.frames(epoch) if each[1] in ("GYRO_ARRAY", "ACCEL_ARRAY"))
    return [framed(*each[1:]) for each in sent]


def stamped(frames):
    return b"".join(record(START_US, raw) for raw in frames)
