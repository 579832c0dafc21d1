"""Files that are there whole, or as they were before: a disk that is full, a run that fails."""

import resource
from contextlib import contextmanager

import pytest
from command import call

from risaf_link.errors import ConfigError, RisafError
from risaf_link.mavlink.tlog import record
from risaf_link.sim.scenario import scenario
from risaf_link.sim.stream import frames
from risaf_link.whole import written

LIMIT = 20_000  # bytes: more than a library's buffers, less than what is written here


@contextmanager
def small_disk():
    """No file may become larger than the limit."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (LIMIT, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("logs") / "drive.tlog"
    drive = scenario("circle", 1, duration=20.0, sensors=5)
    path.write_bytes(b"".join(record(time_us, raw) for time_us, raw in frames(drive)))
    return path


@pytest.mark.parametrize("option", ["--csv", "--mcap", "--out"])
def test_a_full_disk_is_told_in_a_line_and_the_file_is_as_before(option, log, tmp_path):
    pytest.importorskip("mcap")
    out = tmp_path / "out"
    out.write_text("of yesterday")
    with small_disk():
        told = call("replay", log, option, out)
    assert (told.exit_code, told.stderr) == (1, f"risaf-link: {out}: File too large\n")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert out.read_text() == "of yesterday"


def test_a_full_device_is_told_in_a_line(log):
    told = call("replay", log, "--csv", "/dev/full")
    assert (told.exit_code, told.stderr) == (1, "risaf-link: /dev/full: No space left on device\n")


def test_a_log_that_was_not_simulated_to_its_end_is_not_there(tmp_path):
    with small_disk():
        told = call("simulate", "circle", "--seed", 1, "--out", tmp_path / "out.tlog")
    assert (told.exit_code, told.stderr.count("\n")) == (1, 1)
    assert not list(tmp_path.iterdir())


def test_a_log_that_cannot_be_read_leaves_no_empty_file(tmp_path):
    assert call("replay", tmp_path / "none.tlog", "--csv", tmp_path / "out.csv").exit_code == 3
    assert not list(tmp_path.iterdir())


def test_a_pipe_is_written_as_it_is(log):
    whole, piped = (call("replay", log, "--csv", to) for to in ("/dev/null", "/dev/stdout"))
    assert (whole.exit_code, piped.exit_code) == (0, 0)


def test_what_a_link_points_to_is_replaced(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "file")
    with written(tmp_path / "link", "w") as file:
        file.write("new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "file").read_text() == "new"


def test_a_file_that_cannot_be_made_is_the_users_mistake(tmp_path):
    with (
        pytest.raises(ConfigError, match="No such file or directory"),
        written(tmp_path / "none" / "out", "wb"),
    ):
        pass


def test_nothing_is_left_of_what_failed(tmp_path):
    def fail():
        with written(tmp_path / "out", "w") as file:
            file.write("half")
            raise RisafError("of ours")

    with pytest.raises(RisafError, match="of ours"):
        fail()
    assert not list(tmp_path.iterdir())
