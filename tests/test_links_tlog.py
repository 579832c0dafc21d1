"""Recordings."""

import resource
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from test_links import FRAME, SOON, running, until

from risaf_link.links import TlogLink, tlog


def records(path: Path, size: int = len(FRAME)) -> list[tuple[int, bytes]]:
    data = path.read_bytes()
    return [
        (struct.unpack_from(">Q", data, at)[0], data[at + 8 : at + 8 + size])
        for at in range(0, len(data), 8 + size)
    ]


def no_clock() -> int:
    raise AssertionError("the clock was read")


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
    async with running(link):
        link.record(8, FRAME)
    assert [time_us for time_us, _ in records(path)] == [4, 8]


async def test_the_file_is_written_while_the_link_runs(tmp_path: Path) -> None:
    link = TlogLink("recorder", tmp_path / "flight.tlog", no_clock, flush_s=0.001)
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
    assert [records(tmp_path / name)[0][0] for name in names] == [0, 4, 8]
    assert link.path == tmp_path / "flight.2.tlog"


async def test_a_file_that_cannot_be_made_yet_is_retried_and_loses_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "logs").touch()  # where a folder should be
    link = TlogLink("recorder", tmp_path / "logs" / "flight.tlog", no_clock, SOON)
    async with running(link, up=False):
        link.record(4, FRAME)
        await until(lambda: "recorder: down" in caplog.text)
        (tmp_path / "logs").unlink()
        await until(lambda: link.counts.connections == 1)
    assert records(link.path) == [(4, FRAME)]


@pytest.fixture
def small_disk() -> Iterator[Callable[[int], None]]:
    """Limit how far files can grow."""
    unlimited = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, unlimited[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, unlimited)


async def test_a_full_disk_leaves_whole_records_and_is_waited_for(
    tmp_path: Path, small_disk: Callable[[int], None], caplog: pytest.LogCaptureFixture
) -> None:
    link = TlogLink("recorder", tmp_path / "flight.tlog", no_clock, SOON, flush_s=0.001)
    frame = bytes(100)
    async with running(link):
        link.record(4, frame)
        await until(lambda: link.counts.bytes_out == 108)
        small_disk(150)
        link.record(8, frame)
        await until(lambda: "recorder: down" in caplog.text)
        assert link.path.stat().st_size <= 150
        small_disk(1 << 20)
        await until(lambda: link.counts.connections == 2)
    assert [time_us for time_us, _ in records(link.path, 100)] == [4, 8]
    assert link.counts.dropped_out == 0


async def test_records_that_were_never_written_are_counted_as_dropped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(tlog, "MOST_WAITING", 3)
    (tmp_path / "logs").touch()
    link = TlogLink("recorder", tmp_path / "logs" / "flight.tlog", no_clock, SOON)
    async with running(link, up=False):
        for _ in range(5):
            link.record(4, FRAME)
        assert link.counts.dropped_out == 2
        await until(lambda: "recorder: down" in caplog.text)
    assert link.counts.dropped_out == 5
