"""The service is killed at random moments; `benchmarks/killed.py` does it more often."""

import struct
from pathlib import Path

import pytest
from killed import NotWholeError, kill_once, records

from risaf_link.mavlink.frame import encode


@pytest.mark.parametrize("seed", range(5))
def test_what_was_received_and_answered_before_a_kill_is_in_the_recording(
    tmp_path: Path, seed: int
) -> None:
    outcome = kill_once(tmp_path, seed, most_answers=400)
    assert outcome.recorded <= outcome.sent
    assert outcome.answered


@pytest.mark.parametrize("spoil", [lambda log: log[:-1], lambda log: log + b"x"])
def test_a_recording_that_does_not_end_on_a_whole_record_is_found_out(
    tmp_path: Path, spoil
) -> None:
    path = tmp_path / "drive.tlog"
    log = struct.pack(">Q", 4) + encode(0, bytes(9), 0, 1, 1)
    path.write_bytes(log)
    assert len(list(records(path))) == 1
    path.write_bytes(spoil(log))
    with pytest.raises(NotWholeError):
        list(records(path))
