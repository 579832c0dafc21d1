"""Recordings, written by a process of their own."""

import os
import resource
import select
import signal
import socket
import struct
from pathlib import Path

import pytest
from pymavlink import mavutil
from test_links import FRAME, SOON, running, until

from risaf_link.links import RecordingParameters, TlogLink, tlog
from risaf_link.mavlink.dialect import IDS
from risaf_link.mavlink.frame import encode
from risaf_link.mavlink.tlog import TlogReader

SOON_S = 0.01


def records(path: Path, size: int = len(FRAME)) -> list[tuple[int, bytes]]:
    data = path.read_bytes()
    return [
        (struct.unpack_from(">Q", data, at)[0], data[at + 8 : at + 8 + size])
        for at in range(0, len(data), 8 + size)
    ]


def times(path: Path, size: int = len(FRAME)) -> list[int]:
    return [time_us for time_us, _ in records(path, size)]


def no_clock() -> int:
    raise AssertionError("the clock was read")


def recorder_of(link: TlogLink) -> int:
    """Its process."""
    assert link._process is not None
    return link._process.pid


async def stop(link: TlogLink) -> None:
    """Stop it, as a disk does that does not answer."""
    os.kill(recorder_of(link), signal.SIGSTOP)
    tasks = Path("/proc") / str(recorder_of(link)) / "task"

    def state(task: Path) -> str:
        return (task / "stat").read_text().rpartition(")")[2].split()[0]

    await until(lambda: all(state(task) == "T" for task in tasks.iterdir()))


async def test_a_record_is_a_time_a_link_number_and_the_frame(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "down" / "flight.tlog"
    link = TlogLink("recorder", path, lambda: 1_700_000_000_000_001)
    async with running(link):
        link.record(1_700_000_000_000_007, FRAME)
        link.send(FRAME)
    assert records(path) == [(1_700_000_000_000_004, FRAME), (1_700_000_000_000_003, FRAME)]
    assert link.counts.bytes_out == 2 * (8 + len(FRAME))
    assert link.counts.dropped_out == 0


async def test_frames_that_come_before_the_file_is_open_are_recorded(tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    link = TlogLink("recorder", path, no_clock)
    link.record(4, FRAME)
    assert not path.exists()
    async with running(link, up=False):
        await until(lambda: link._process)
        link.record(8, FRAME)
        await until(lambda: link.counts.connections == 1)
        link.record(12, FRAME)
    assert times(path) == [4, 8, 12]


async def test_the_file_is_written_while_the_link_runs(tmp_path: Path) -> None:
    link = TlogLink("recorder", tmp_path / "flight.tlog", no_clock)
    async with running(link):
        for n in 1, 2, 3:
            link.record(4 * n, FRAME)
            await until(lambda n=n: len(records(link.path)) == n)


async def test_a_recording_that_exists_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    for n in range(3):
        link = TlogLink("recorder", path, no_clock)
        link.record(4 * n, FRAME)
        async with running(link):
            pass
    names = ["flight.tlog", "flight.1.tlog", "flight.2.tlog"]
    assert [times(tmp_path / name) for name in names] == [[0], [4], [8]]
    assert link.path == tmp_path / "flight.2.tlog"


async def test_every_segment_is_a_log_by_itself_and_all_together_are_one(tmp_path: Path) -> None:
    limits = RecordingParameters(segment_bytes=2000)
    link = TlogLink("recorder", tmp_path / "flight.tlog", no_clock, limits=limits)
    frames = [encode(IDS["HEARTBEAT"], bytes([n + 1] * 9), n, 1, 1) for n in range(250)]
    async with running(link):
        for n, frame in enumerate(frames):
            link.record(1_700_000_000_000_000 + n, frame)
    paths = [tmp_path / "flight.tlog", *(tmp_path / f"flight.{n}.tlog" for n in range(1, 4))]
    assert link.path == paths[-1]
    assert [path.stat().st_size for path in paths[:-1]] == [68 * 29] * 3
    heard = [read.frame.raw for path in paths for read in TlogReader([path.read_bytes()])]
    assert heard == frames
    together = TlogReader([b"".join(path.read_bytes() for path in paths)])
    assert [read.frame.raw for read in together] == frames
    by_pymavlink = [raw for path in paths for raw in read_by_pymavlink(path)]
    assert by_pymavlink == frames


def read_by_pymavlink(path: Path) -> list[bytes]:
    log = mavutil.mavlink_connection(str(path))
    try:
        return [bytes(message.get_msgbuf()) for message in iter(log.recv_msg, None)]
    finally:
        log.close()


# Trouble with the disk


async def test_a_file_that_cannot_be_made_yet_is_retried_and_loses_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "logs").touch()  # where a folder should be
    path = tmp_path / "logs" / "flight.tlog"
    link = TlogLink("recorder", path, no_clock, flush_s=SOON_S)
    async with running(link, up=False):
        link.record(4, FRAME)
        await until(lambda: "recorder: down: " in caplog.text)
        (tmp_path / "logs").unlink()
        await until(lambda: link.counts.connections == 1)
    assert times(link.path) == [4]
    assert f"{tmp_path}/logs: File exists" in caplog.text


def limit_files(link: TlogLink, size: int) -> None:
    """Limit how far files of the recorder can grow."""
    _, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.prlimit(recorder_of(link), resource.RLIMIT_FSIZE, (size, most))


async def test_a_full_disk_leaves_whole_records_and_is_waited_for(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    link = TlogLink("recorder", tmp_path / "flight.tlog", no_clock, flush_s=SOON_S)
    frame = bytes(100)
    async with running(link):
        limit_files(link, 50)
        link.record(4, frame)
        await until(lambda: "recorder: down: " in caplog.text)
        assert "flight.tlog: File too large" in caplog.text
        assert link.path.stat().st_size <= 50
        limit_files(link, 1 << 20)
        await until(lambda: link.counts.connections == 2)
    assert times(link.path, 100) == [4]
    assert link.counts.dropped_out == 0


async def test_a_file_system_with_small_files_gets_more_of_them(tmp_path: Path) -> None:
    link = TlogLink("recorder", tmp_path / "flight.tlog", no_clock, flush_s=SOON_S)
    frame = bytes(100)
    async with running(link):
        limit_files(link, 150)
        for n in 1, 2, 3:
            link.record(4 * n, frame)
            await until(lambda n=n: link.counts.bytes_out == 108 * n)
    names = ["flight.tlog", "flight.1.tlog", "flight.2.tlog"]
    assert [times(tmp_path / name, 100) for name in names] == [[4], [8], [12]]


async def test_records_that_were_never_written_are_counted_as_dropped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(tlog, "MOST_WAITING", 3)
    (tmp_path / "logs").touch()
    link = TlogLink("recorder", tmp_path / "logs" / "flight.tlog", no_clock)
    for _ in range(5):
        link.record(4, FRAME)
    assert link.counts.dropped_out == 2
    async with running(link, up=False):
        link.record(4, FRAME)
        await until(lambda: "recorder: down: " in caplog.text)
    assert link.counts.dropped_out == 6
    assert "recorder: 6 records lost so far" in caplog.text


async def test_a_recorder_that_hangs_holds_nobody_up_and_loses_nothing_as_long_as_memory_lasts(
    tmp_path: Path,
) -> None:
    link = TlogLink("recorder", tmp_path / "flight.tlog", no_clock, flush_s=SOON_S)
    frame, count = bytes(250), 40_000
    async with running(link):
        await stop(link)
        for n in range(count):
            link.record(4 * n, frame)
        os.kill(recorder_of(link), signal.SIGCONT)
        await until(lambda: link.counts.bytes_out == count * 258)
    assert times(link.path, 250) == [4 * n for n in range(count)]
    assert link.counts.dropped_out == 0


async def test_what_a_recorder_that_hangs_cannot_take_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(tlog, "MOST_WAITING", 100)
    link = TlogLink("recorder", tmp_path / "flight.tlog", no_clock, flush_s=SOON_S)
    frame, count = bytes(250), 40_000
    async with running(link):
        await stop(link)
        for n in range(count):
            link.record(4 * n, frame)
        assert "recorder: 1 records lost so far" in caplog.text
        os.kill(recorder_of(link), signal.SIGCONT)
        dropped = link.counts.dropped_out
        await until(lambda: link.counts.bytes_out == (count - dropped) * 258)
    kept = times(link.path, 250)
    assert kept == [4 * n for n in range(len(kept))]
    assert len(kept) * 272 >= 0.8 * tlog.PIPES * tlog.recorder.PIPE_BYTES
    assert link.counts.dropped_out == count - len(kept)
    assert f"recorder: {count - len(kept)} records lost so far" in caplog.text


async def test_a_disk_that_hangs_at_the_end_is_left_to_the_recorder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(tlog, "LEAVE_S", 0.01)
    link = TlogLink("recorder", tmp_path / "flight.tlog", no_clock)
    async with running(link):
        process = link._process
        assert process is not None
        await stop(link)
        link.record(4, FRAME)
    assert "recorder: the disk hangs: the recorder goes on alone" in caplog.text
    process.send_signal(signal.SIGCONT)
    assert process.wait() == 0
    assert times(link.path) == [4]


# The recorder's life


async def test_a_recorder_that_is_killed_is_followed_by_another_that_goes_on_in_the_next_file(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    link = TlogLink("recorder", tmp_path / "flight.tlog", no_clock, SOON)
    async with running(link):
        link.record(4, FRAME)
        await until(lambda: link.counts.bytes_out)
        await stop(link)
        link.record(8, FRAME, FRAME)
        os.kill(recorder_of(link), signal.SIGKILL)
        await until(lambda: link.counts.connections == 2)
        link.record(12, FRAME)
    assert times(tmp_path / "flight.tlog") == [4]
    assert times(tmp_path / "flight.1.tlog") == [8, 8, 12]
    assert link.counts.dropped_out == 0
    assert "recorder: down: the recorder has ended with status -9" in caplog.text


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
async def test_signals_to_the_whole_service_do_not_end_the_recorder(
    tmp_path: Path, number: signal.Signals
) -> None:
    link = TlogLink("recorder", tmp_path / "flight.tlog", no_clock)
    async with running(link):
        os.kill(recorder_of(link), number)
        link.record(4, FRAME)
        await until(lambda: len(records(link.path)) == 1)
        assert os.getsid(recorder_of(link)) == recorder_of(link)
        assert link.counts.connections == 1


async def test_the_recorder_is_small_and_holds_nothing_of_the_service(tmp_path: Path) -> None:
    link = TlogLink("recorder", tmp_path / "flight.tlog", no_clock)
    with socket.create_server(("127.0.0.1", 0)):
        async with running(link):
            process = Path("/proc") / str(recorder_of(link))
            held = {str(file.readlink()).partition(":")[0] for file in (process / "fd").iterdir()}
            assert held == {"pipe", "/dev/null", str(link.path)}
            assert "site-packages" not in (process / "maps").read_text()


async def test_nothing_is_left_open(tmp_path: Path) -> None:
    before = set(os.listdir("/proc/self/fd"))  # noqa: PTH208 they are numbers
    link = TlogLink("recorder", tmp_path / "flight.tlog", no_clock)
    async with running(link):
        ended = os.pidfd_open(recorder_of(link))
    assert select.select([ended], [], [], 0)[0]
    os.close(ended)
    assert set(os.listdir("/proc/self/fd")) == before  # noqa: PTH208
