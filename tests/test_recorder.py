"""The files that a recorder writes, on disks that are full, broken, or emptied by others."""

import errno
import fcntl
import os
import stat
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from risaf_link.links import recorder
from risaf_link.links.recorder import Inbox, Recording, work

Disk = os.statvfs_result


def message(mark: int, size: int = 100) -> recorder.Message:
    """One record, which shows which one it is."""
    return bytes([mark]) * size, 1


class Bench:
    """A recording with a clock that is set by hand."""

    def __init__(self, folder: Path, **limits: Any) -> None:
        self.folder = folder
        self.now_s = 0.0
        self.told: list[dict[str, Any]] = []
        options = {"segment_bytes": 300, "segment_s": 1000.0} | limits
        self.recording = Recording(
            str(folder / "drive.tlog"),
            **options,
            clock_s=lambda: self.now_s,
            tell=self.told.append,
        )
        self.waiting: list[recorder.Message] = []

    def write(self, *marks: int, size: int = 100) -> None:
        self.waiting += [message(mark, size) for mark in marks]
        self.recording.open()
        self.recording.write(self.waiting)

    @property
    def files(self) -> dict[str, list[int]]:
        """Which records each file holds."""
        found = sorted(self.folder.iterdir(), key=lambda path: (len(path.name), path.name))
        return {path.name: list(path.read_bytes()[::100]) for path in found if path.is_file()}

    @property
    def names(self) -> set[str]:
        return {path.name for path in self.folder.iterdir()}


@pytest.fixture
def bench(tmp_path: Path):
    made: list[Bench] = []

    def make(**limits: Any) -> Bench:
        made.append(Bench(tmp_path, **limits))
        return made[-1]

    yield make
    for one in made:
        one.recording.close()


Make = Callable[..., Bench]


# Segments


def test_others_on_the_computer_cannot_read_where_a_vehicle_was(
    bench: Callable[..., Bench],
) -> None:
    one = bench()
    before = os.umask(0)
    try:
        one.write(1, 2, 3, 4)
    finally:
        os.umask(before)
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in one.folder.iterdir()}
    assert modes == {"drive.tlog": 0o640, "drive.1.tlog": 0o640}


def test_a_segment_that_is_full_is_followed_by_the_next(bench: Make) -> None:
    one = bench()
    one.write(*range(8))
    assert one.files == {
        "drive.tlog": [0, 1, 2],
        "drive.1.tlog": [3, 4, 5],
        "drive.2.tlog": [6, 7],
    }
    assert (one.recording.records, one.recording.bytes) == (8, 800)


def test_records_are_never_cut_where_a_segment_ends(bench: Make) -> None:
    one = bench(segment_bytes=250)
    one.write(1, 2, 3)
    assert one.files == {"drive.tlog": [1, 2], "drive.1.tlog": [3]}


def test_a_segment_that_is_old_is_followed_by_the_next_once_there_is_something_for_it(
    bench: Make,
) -> None:
    one = bench(segment_s=60.0)
    one.write(1)
    one.now_s = 59.9
    one.write(2)
    one.now_s = 3600.0
    one.write()
    assert one.names == {"drive.tlog"}
    one.write(3)
    one.now_s = 3659.9
    one.write(4)
    assert one.files == {"drive.tlog": [1, 2], "drive.1.tlog": [3, 4]}


def test_a_number_is_one_more_than_the_largest_there_is(bench: Make, tmp_path: Path) -> None:
    for name in ("drive.3.tlog", "drive.12.tlog", "drive.7.txt", "driver.40.tlog"):
        (tmp_path / name).write_bytes(b"theirs")
    (tmp_path / "drive.13.tlog").mkdir()
    one = bench()
    one.write(1)
    assert one.recording.path == str(tmp_path / "drive.14.tlog")
    assert (tmp_path / "drive.12.tlog").read_bytes() == b"theirs"


def test_numbers_go_on_after_everything_was_removed(bench: Make, tmp_path: Path) -> None:
    one = bench()
    one.write(1, 2, 3, 4)
    for path in tmp_path.iterdir():
        path.unlink()
    one.write(5, 6, 7)
    assert one.names == {"drive.2.tlog"}


def test_a_name_that_another_takes_at_the_same_time_is_left_to_it(
    bench: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = bench()
    monkeypatch.setattr(one.recording, "_found", list)
    (tmp_path / "drive.tlog").write_bytes(b"theirs")
    one.write(1)
    assert one.names == {"drive.tlog", "drive.1.tlog"}
    assert (tmp_path / "drive.tlog").read_bytes() == b"theirs"


# Limits


def test_the_oldest_are_deleted_beyond_the_limit_of_all(bench: Make) -> None:
    one = bench(segment_bytes=200, most_bytes=800)
    one.write(*range(9))
    assert one.files == {
        "drive.1.tlog": [2, 3],
        "drive.2.tlog": [4, 5],
        "drive.3.tlog": [6, 7],
        "drive.4.tlog": [8],
    }
    deleted = [{"deleted": str(one.folder / "drive.tlog"), "why": "most_bytes"}]
    assert one.told == deleted


def test_all_together_never_exceed_the_limit(bench: Make) -> None:
    one = bench(segment_bytes=250, most_bytes=1000)
    for mark in range(50):
        one.write(mark)
        assert sum(path.stat().st_size for path in one.folder.iterdir()) <= 1000


def test_a_segment_takes_no_more_than_a_quarter_of_all(bench: Make) -> None:
    one = bench(segment_bytes=300, most_bytes=400)
    one.write(1, 2, 3, 4, 5)
    assert [*one.files.values()] == [[2], [3], [4], [5]]


def test_the_age_of_a_recording_is_its_number(bench: Make, tmp_path: Path) -> None:
    for number in (10, 9, 2):
        path = tmp_path / f"drive.{number}.tlog"
        path.write_bytes(bytes(100))
        os.utime(path, (number, 1e9 / number))
    one = bench(segment_bytes=100, most_bytes=400)
    one.write(1, 2)
    assert one.names == {"drive.9.tlog", "drive.10.tlog", "drive.11.tlog", "drive.12.tlog"}


def test_only_files_of_the_recordings_own_names_are_deleted(bench: Make, tmp_path: Path) -> None:
    others = ["drive.txt", "drive.x.tlog", "drive.01.tlog", "drive.1.tlog.gz", "my drive.2.tlog"]
    for name in [*others, "kept"]:
        (tmp_path / name).write_bytes(bytes(5000))
    (tmp_path / "drive.3.tlog").symlink_to(tmp_path / "kept")
    (tmp_path / "drive.4.tlog").mkdir()
    one = bench(segment_bytes=100, most_bytes=400)
    one.write(*range(9))
    newest = {f"drive.{number}.tlog" for number in (10, 11, 12, 13)}
    assert one.names == {*others, "kept", "drive.3.tlog", "drive.4.tlog", *newest}


class SmallDisk:
    """What `statvfs` says: so many bytes less than a size as files take."""

    def __init__(self, folder: Path, size: int) -> None:
        self.folder, self.size = folder, size
        self.lags = False

    def __call__(self, _: str) -> Disk:
        taken = sum(path.stat().st_size for path in self.folder.iterdir())
        free = 0 if self.lags else self.size - taken
        return Disk((1, 1, 0, 0, free, 0, 0, 0, 0, 255))


@pytest.fixture
def disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SmallDisk:
    disk = SmallDisk(tmp_path, 1000)
    monkeypatch.setattr(os, "statvfs", disk)
    return disk


@pytest.mark.usefixtures("disk")
def test_the_oldest_are_deleted_as_far_as_others_need_room(bench: Make) -> None:
    one = bench(segment_bytes=200, least_free_bytes=400)
    for mark in range(9):
        one.now_s += 2.0
        one.write(mark)
    assert one.files == {"drive.2.tlog": [4, 5], "drive.3.tlog": [6, 7], "drive.4.tlog": [8]}
    assert [told["why"] for told in one.told] == ["least_free_bytes"] * 2


def test_without_anything_to_delete_nothing_is_written_until_there_is_room(
    bench: Make, disk: SmallDisk
) -> None:
    one = bench(segment_bytes=10_000, least_free_bytes=400)
    one.write(*range(6))
    for mark in (6, 7):
        one.now_s += 2.0
        with pytest.raises(OSError, match="less than 400 bytes are free"):
            one.write(mark)
    assert one.files == {"drive.tlog": [0, 1, 2, 3, 4, 5]}
    disk.size = 2000
    one.write(8)
    assert one.files == {"drive.tlog": [0, 1, 2, 3, 4, 5, 6, 7, 8]}


def test_a_disk_without_room_gets_no_empty_files(bench: Make, disk: SmallDisk) -> None:
    disk.size = 100
    one = bench(least_free_bytes=400)
    for _ in range(3):
        with pytest.raises(OSError, match="less than 400 bytes are free"):
            one.write(1)
    assert one.names == set()


def test_what_was_deleted_counts_though_the_disk_does_not_show_it_yet(
    bench: Make, disk: SmallDisk
) -> None:
    one = bench(segment_bytes=100, least_free_bytes=150)
    one.write(*range(6))
    disk.lags = True
    one.now_s += 2.0
    one.write(6)
    assert len(one.told) == 3  # 150 bytes and the record itself
    one.write(7)
    assert len(one.told) <= 6


# Trouble


def refuse_after(monkeypatch: pytest.MonkeyPatch, sizes: list[int], error: int) -> None:
    """Let each write take so many bytes and no more, as a disk does that is full."""
    write = os.write

    def limited(file: int, data: bytes) -> int:
        if not sizes:
            return write(file, data)
        taken = sizes.pop(0)
        if taken == 0:
            raise OSError(error, os.strerror(error))
        return write(file, data[:taken])

    monkeypatch.setattr(os, "write", limited)


@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EIO, errno.EDQUOT])
def test_half_a_record_is_taken_back_and_written_again(
    bench: Make, monkeypatch: pytest.MonkeyPatch, error: int
) -> None:
    one = bench(segment_bytes=10_000)
    one.write(1, 2)
    refuse_after(monkeypatch, [150, 0], error)
    with pytest.raises(OSError, match=os.strerror(error)):
        one.write(3, 4)
    assert one.files == {"drive.tlog": [1, 2]}
    assert one.recording.records == 2
    one.write(5)
    assert one.files == {"drive.tlog": [1, 2, 3, 4, 5]}


def test_a_write_that_takes_only_a_part_goes_on(
    bench: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = bench()
    refuse_after(monkeypatch, [50, 70], errno.EIO)
    one.write(1, 2)
    assert one.files == {"drive.tlog": [1, 2]}


def test_a_file_that_may_not_grow_is_followed_by_the_next(
    bench: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = bench(segment_bytes=10_000)
    one.write(1)
    refuse_after(monkeypatch, [30, 0], errno.EFBIG)
    one.write(2, 3)
    assert one.files == {"drive.tlog": [1], "drive.1.tlog": [2, 3]}


def test_what_cannot_be_made_durable_is_written_again(
    bench: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_: int) -> None:
        raise OSError(errno.EIO, "no")

    one = bench(segment_bytes=10_000)
    one.write(1, 2)
    assert one.recording.flush(one.waiting, at_once=True)
    one.write(3, 4)
    with monkeypatch.context() as patch:
        patch.setattr(os, "fdatasync", broken)
        with pytest.raises(OSError, match="no"):
            one.recording.flush(one.waiting, at_once=True)
    assert (one.files, one.recording.records) == ({"drive.tlog": [1, 2]}, 2)
    one.write(5)
    assert one.files == {"drive.tlog": [1, 2, 3, 4, 5]}
    assert one.recording.records == 5


def test_half_a_record_that_cannot_be_taken_back_is_the_end_of_its_file(
    bench: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_: int, __: int) -> None:
        raise OSError(errno.EIO, "no")

    one = bench(segment_bytes=10_000)
    one.write(1)
    refuse_after(monkeypatch, [30, 0], errno.EIO)
    with monkeypatch.context() as patch:
        patch.setattr(os, "ftruncate", broken)
        with pytest.raises(OSError, match="Input/output"):
            one.write(2)
    one.write(3)
    assert (one.folder / "drive.tlog").stat().st_size == 130
    assert one.files["drive.1.tlog"] == [2, 3]


def test_a_file_that_was_removed_is_followed_by_the_next(bench: Make) -> None:
    one = bench(segment_bytes=10_000)
    one.write(1)
    (one.folder / "drive.tlog").unlink()
    one.recording.flush(one.waiting, at_once=True)
    one.write(2)
    assert one.files == {"drive.1.tlog": [2]}


def test_a_folder_that_was_removed_is_made_again(bench: Make, tmp_path: Path) -> None:
    one = bench()
    one.folder = tmp_path / "logs"
    one.recording._directory = str(one.folder)
    one.write(1)
    (one.folder / "drive.tlog").unlink()
    one.folder.rmdir()
    one.recording.flush(one.waiting, at_once=True)
    one.write(2)
    assert one.files == {"drive.1.tlog": [2]}


# Time


def test_what_was_written_is_durable_once_a_second(
    bench: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[int] = []
    monkeypatch.setattr(os, "fdatasync", synced.append)
    one = bench(segment_bytes=10_000)
    assert one.recording.rest_s is None
    for step in range(1, 31):
        one.now_s = step / 10
        one.write(step)
        one.recording.flush(one.waiting)
        assert one.recording.rest_s is None or one.recording.rest_s <= 1.0
    assert len(synced) == 3


# The pipe


def packed(*marks: int) -> bytes:
    """Messages whose numbers are their marks."""
    data = b""
    for mark in marks:
        record, count = message(mark)
        data += recorder.HEAD.pack(recorder.MARK, len(record), count, mark) + record
    return data


@pytest.mark.parametrize("at", range(1, 2 * 114, 7))
def test_messages_are_whole_however_they_are_cut(at: int) -> None:
    data = packed(1, 2)
    first, rest = recorder.cut(data[:at])
    second, left = recorder.cut(rest + data[at:])
    assert (first + second, left) == ([(1, message(1)), (2, message(2))], b"")


def test_half_a_message_at_the_end_is_no_message() -> None:
    assert recorder.cut(packed(1, 2)[:-1])[0] == [(1, message(1))]


def filled(*contents: bytes, written: Callable[[], int] = lambda: 0) -> Inbox:
    """What is in pipes that nobody holds any more."""
    outs = []
    for data in contents:
        out, into = os.pipe()
        os.write(into, data)
        os.close(into)
        outs.append(out)
    inbox = Inbox(outs)
    inbox.fill(written)
    for out in outs:
        os.close(out)
    return inbox


def test_messages_of_several_pipes_are_written_in_the_order_of_their_numbers() -> None:
    inbox = filled(packed(3, 4, 9), packed(1, 2, 7, 8), packed(5, 6))
    assert inbox.waiting == [message(number) for number in range(1, 10)]
    assert inbox.taken == 900


def test_a_message_waits_for_those_before_it_that_are_in_another_pipe() -> None:
    out, into = os.pipe()
    inbox = Inbox([out])
    for written, delivered in [((1, 2), [1, 2]), ((4, 6), [1, 2]), ((3, 5), [1, 2, 3, 4, 5, 6])]:
        os.write(into, packed(*written))
        assert inbox._read(out)
        inbox._deliver(at_once=False)
        assert inbox.waiting == [message(number) for number in delivered]
    os.close(into)
    os.close(out)


def test_the_last_record_is_written_and_durable_when_the_pipe_ends(bench: Make) -> None:
    one = bench(segment_bytes=10_000)
    told: list[dict[str, Any]] = []
    work(one.recording, filled(packed(1, 2, 3)), told.append, retry_s=1000.0)
    assert one.files == {"drive.tlog": [1, 2, 3]}
    path = str(one.folder / "drive.tlog")
    assert told == [{"path": path, "failure": "", "records": 3, "bytes": 300}]


def test_the_pipe_is_emptied_while_the_disk_hangs(
    bench: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    hangs, goes_on = threading.Event(), threading.Event()

    def hang(_: int) -> None:
        hangs.set()
        assert goes_on.wait(20.0)

    monkeypatch.setattr(os, "fdatasync", hang)
    one = bench(segment_bytes=100_000_000, flush_s=0.0)
    out, into = os.pipe()
    fcntl.fcntl(into, fcntl.F_SETPIPE_SZ, recorder.PIPE_BYTES)
    inbox = Inbox([out])
    filling = threading.Thread(target=inbox.fill, args=[lambda: one.recording.bytes])
    working = threading.Thread(target=work, args=[one.recording, inbox, one.told.append, 1000.0])
    filling.start()
    working.start()
    os.write(into, packed(0))
    assert hangs.wait(20.0)
    for number in range(1, 30_000):  # three times what the pipe holds
        data, count = message(number % 256)
        os.write(into, recorder.HEAD.pack(recorder.MARK, len(data), count, number) + data)
    goes_on.set()
    os.close(into)
    filling.join()
    working.join()
    os.close(out)
    assert one.files == {"drive.tlog": [number % 256 for number in range(30_000)]}


def test_a_pipe_that_ends_is_emptied_though_memory_is_full(
    bench: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder, "MOST_WAITING", 0)
    inbox = filled(packed(1, 2), written=lambda: -1)
    work(bench().recording, inbox, lambda _: None, retry_s=1000.0)
    assert not inbox.waiting


def test_trouble_at_the_end_is_tried_once_and_told(bench: Make, tmp_path: Path) -> None:
    one = bench()
    one.recording._directory = str(tmp_path / "none" / "there")
    (tmp_path / "none").touch()
    told: list[dict[str, Any]] = []
    work(one.recording, filled(packed(1)), told.append, retry_s=1000.0)
    (state,) = told
    assert state["failure"] == f"{tmp_path}/none/there: Not a directory"
    assert state["records"] == 0
