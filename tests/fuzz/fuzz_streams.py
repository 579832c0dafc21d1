"""Targets: streams of frames, and logs as a user has them."""

import json
import math
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from fuzz_checks import (
    ROOM,
    check_estimates,
    check_line,
    check_update,
    configs,
)
from pymavlink.generator.mavcrc import x25crc
from streams import chunks

from risaf_link.config import Config
from risaf_link.errors import ConfigError, LogError
from risaf_link.mavlink import search
from risaf_link.mavlink.dialect import CRC_EXTRA
from risaf_link.mavlink.frame import Frame, FrameParser
from risaf_link.mavlink.tlog import TlogReader
from risaf_link.monitor.recording import Player, Recording
from risaf_link.monitor.source import Log as PlayedLog
from risaf_link.monitor.view import View
from risaf_link.replay import Replay, Selection
from risaf_link.survey import survey
from risaf_link.words import pace_rows, survey_text


def stream(data: bytes) -> None:
    """Frames are the same however a stream is cut, and those that pymavlink takes for frames."""
    prefix, sizes, data = (8 if data[:1] > b"\x7f" else 0), [*data[1:5]], data[5:]
    whole = _parsed([data], prefix)
    assert whole == _parsed(chunks(data, sizes), prefix)
    parser = FrameParser(prefix)
    tables = parser.receive_table(data), parser.end_table()
    frames, dropped, skipped = whole
    assert [table.frame(row) for table in tables for row in range(len(table))] == frames
    cuts, *_, by_reason = search.cut(data, prefix, 0, True, True)
    found = np.frombuffer(cuts, search.CUTS)[["start", "prefix", "message_id"]].tolist()
    assert [each[1:] for each in found] == [(len(f.prefix), f.message_id) for f in frames]
    assert Counter(dict(zip(search.REASONS, by_reason, strict=True))) == dropped
    used: set[int] = set()
    for (start, before, _), frame in zip(found, frames, strict=True):
        assert data[start - before :].startswith(frame.prefix + frame.raw)
        used.update(range(start - before, start + len(frame.raw)))
        _check_frame(frame)
    twice = sum(len(f.prefix) + len(f.raw) for f in frames) - len(used)  # within signatures
    assert 0 <= len(used) + skipped - len(data) <= twice


def _parsed(pieces: Iterable[bytes], prefix: int) -> tuple[list[Frame], Counter[str], int]:
    parser = FrameParser(prefix)
    frames = [frame for piece in pieces for frame in parser.receive_data(piece)]
    return frames + parser.end(), parser.dropped, parser.skipped


def _check_frame(frame: Frame) -> None:
    """Hold a frame against pymavlink."""
    assert frame.known == (frame.message_id in CRC_EXTRA)
    if frame.known:
        end = len(frame.raw) - len(frame.signature)
        extra = bytes((CRC_EXTRA[frame.message_id],))
        checksum = x25crc(frame.raw[1 : end - 2] + extra).crc
        assert checksum.to_bytes(2, "little") == frame.raw[end - 2 : end]


def tlog(data: bytes) -> None:
    """Records are the same however a log is cut; times are stamps, and are played in order."""
    sizes, log = [*data[:4]], data[4:]
    whole, in_pieces = TlogReader([log]), TlogReader(chunks(log, sizes))
    records = list(whole)
    assert records == list(in_pieces)
    assert whole.stamps_replaced == in_pieces.stamps_replaced
    stamps = {int.from_bytes(r.frame.prefix, "big") & ~3 for r in records if r.frame.prefix}
    assert {record.time_us for record in records} <= stamps | {0}
    recording = Recording([log])
    assert len(recording) == len(records)
    assert (recording.times_us[1:] >= recording.times_us[:-1]).all()
    if records:
        _play(recording)


def _play(recording: Recording) -> None:
    player = Player(recording)
    view = View(PlayedLog("a log", player))
    begin_us, end_us = (int(recording.times_us[i]) for i in (0, -1))
    for _ in range(3):
        player.advance(0.7)
        assert begin_us <= player.now_us <= end_us
        check_update(view)
    player.seek((begin_us + end_us) / 2)
    player.seek(math.inf)
    assert player.now_us == end_us
    check_update(view)


def replay(data: bytes) -> None:
    """A log is read, or said in one line to be none; in blocks and frame by frame alike."""
    path, config = ROOM / "any.tlog", configs()[data[0] % len(configs()) if data else 0]
    path.write_bytes(data[1:])
    try:
        found = survey(config, path)
        if data[-1] & 7 == 0:  # it takes as long as all the rest
            survey_text(path, found)
            pace_rows(found)
    except LogError as error:
        check_line(error)
    in_blocks, singly = (_replayed(config, path, each) for each in (False, True))
    assert in_blocks == singly


def _replayed(config: Config, path: Path, singly: bool) -> tuple[bytes, str, str]:
    """Estimates of a log, what is said of them, and what was wrong."""
    log, tracks, problem = Replay(config, path, Selection()), [], ""
    try:
        for block in log.blocks(singly=singly):
            check_estimates(block)
            tracks.append(block.track.values.tobytes())
    except (LogError, ConfigError) as error:
        problem = str(error)
        check_line(error)
    summary = log.summary()
    summary["realtime_factor"] = 0.0
    summary["unused"] = sorted(summary["unused"].items())
    return b"".join(tracks), json.dumps(summary), problem
