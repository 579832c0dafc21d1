"""Many logs at once: each through a pipeline of its own, on all cores or on a cluster.

A log is replayed as it would be alone, by whichever worker is free, and what it gives depends on
nothing else. One that cannot be used costs only itself.
"""

import hashlib
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from uuid import uuid4

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from risaf_link.config import Config, load_calibration
from risaf_link.errors import ConfigError, RisafError
from risaf_link.publish.rows import RowWriter
from risaf_link.replay import Replay, Selection
from risaf_link.sweep import Row, Sweep, Work, program

PARTS = ("core", "mavlink", "pipeline.py", "config.py", "publish/rows.py", "replay.py")
DIGEST = 16  # characters that tell one configuration, program or state of a log from another
PARTIAL = "partial"  # suffix of a CSV that is being written


class LogReplay(Struct, frozen=True):
    """One log to replay; paths are absolute."""

    log: str
    name: str
    """Tells it from the others, and names its CSV."""
    digest: str
    """Of all that its result depends on."""
    config: Config
    selection: Selection
    csv_directory: str | None

    @property
    def key(self) -> str:
        """Name of its result."""
        return f"{self.name}.{self.digest}"

    @property
    def csv(self) -> Path | None:
        """Where its rows go."""
        return Path(self.csv_directory, f"{self.name}.csv") if self.csv_directory else None

    def run(self) -> Row:
        """Replay it; its summary.

        Raises
        ------
        RisafError
            If it gives none, whatever the reason.
        """
        try:
            return _write_csv(self, self.csv) if self.csv else _summary(self)
        except RisafError:
            raise
        except OSError as error:
            raise RisafError(f"{self.csv or self.log}: {error.strerror or error}") from None
        except Exception as error:  # must not cost the other logs; alone, it shows its traceback
            raise RisafError(f"{type(error).__name__}: {' '.join(str(error).split())}") from error


def replay_all(
    logs: Sequence[Path],
    config: Config,
    selection: Selection,
    csv: Path | None = None,
    workers: int | None = None,
    cluster: str | None = None,
) -> list[Row]:
    """Replay logs.

    Parameters
    ----------
    logs : sequence of Path
    config : Config
    selection : Selection
        Of each log.
    csv : Path or None
        Directory for one CSV a log. What is finished is noted in its `cases`, and not done again
        unless log, options, configuration, calibration or program are other ones; then what was
        there of this log goes first.
    workers : int or None
        Processes; None: one a core.
    cluster : str or None
        Address of a Dask scheduler, instead. Its workers need the logs, the calibration and the
        directory at the same paths.

    Returns
    -------
    list of dict
        Of each log, in their order, `Replay.summary` and `log`; or `log` and `error`.

    Raises
    ------
    ConfigError
        If the calibration or the directory cannot be used, or the cluster does not answer.
    RisafError
        If the cluster was lost.
    """
    config = _anywhere(config)
    directory = _directory(csv) if csv else None
    replays = _replays(logs, config, selection, directory)
    with TemporaryDirectory() as passing:
        kept = directory / "cases" if directory else Path(passing)
        _forget(kept, replays)
        largest_first = sorted(replays, key=lambda replay: -_size(Path(replay.log)))
        sweep = Sweep(kept, workers, cluster)
        try:
            rows = sweep.run(largest_first, "replay", failed=_failure)
        finally:
            if directory:
                _clear(directory, replays)
    found = dict(zip((replay.log for replay in largest_first), rows, strict=True))
    return [{"log": str(log), **found[str(log.absolute())]} for log in logs]


def names(logs: Sequence[Path]) -> list[str]:
    """Name each log by its own name, and by as many of its directories as tell it from the others.

    Parameters
    ----------
    logs : sequence of Path
        Absolute, each once.
    """
    paths = [(*log.parts[1:-1], log.stem) for log in logs]
    depths = [1] * len(logs)
    while True:
        found = ["_".join(path[-depth:]) for path, depth in zip(paths, depths, strict=True)]
        counts = Counter(found)
        same = [i for i, name in enumerate(found) if counts[name] > 1]
        deeper = [i for i in same if depths[i] < len(paths[i])]
        if not deeper:
            break
        for i in deeper:
            depths[i] += 1
    for i in same:  # such as of drive.tlog and drive.raw
        found[i] += "-" + hashlib.sha256(str(logs[i]).encode()).hexdigest()[:8]
    return found


def _directory(path: Path) -> Path:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise ConfigError(f"--csv {path}: found a file, expected a directory") from None
    except OSError as error:
        raise ConfigError(f"--csv {path}: {error.strerror or error}") from None
    return path.absolute()


def _replays(
    logs: Sequence[Path], config: Config, selection: Selection, directory: Path | None
) -> list[LogReplay]:
    paths = list(dict.fromkeys(log.absolute() for log in logs))
    common = hashlib.sha256(program(*PARTS).encode())
    common.update(msgspec.json.encode([config, selection, load_calibration(config)]))
    replays = []
    for path, name in zip(paths, names(paths), strict=True):
        digest = common.copy()
        digest.update(msgspec.json.encode([str(path), *_state(path)]))
        short = digest.hexdigest()[:DIGEST]
        to = str(directory) if directory else None
        replays.append(LogReplay(str(path), name, short, config, selection, to))
    return replays


def _anywhere(config: Config) -> Config:
    """The same configuration, whatever the working directory."""
    if not config.array.calibration:
        return config
    calibration = str(Path(config.array.calibration).absolute())
    return replace(config, array=replace(config.array, calibration=calibration))


def _state(path: Path) -> tuple[int, int]:
    """Size, bytes, and time of change, ns: a log with the same ones is the same."""
    try:
        found = path.stat()
    except OSError:
        return 0, 0
    return found.st_size, found.st_mtime_ns


def _size(path: Path) -> int:
    return _state(path)[0]


def _summary(replay: LogReplay, rows: RowWriter | None = None) -> Row:
    replayed = Replay(replay.config, Path(replay.log), replay.selection)
    for block in replayed.blocks():
        if rows:
            rows.write(block)
    return replayed.summary()


def _write_csv(replay: LogReplay, path: Path) -> Row:
    """Replay a log; its CSV is there when it is whole, or not at all."""
    partial = path.with_name(f".{path.name}.{uuid4().hex}.{PARTIAL}")
    try:
        with partial.open("x") as file:
            row = _summary(replay, RowWriter(file))
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
    return row


def _forget(kept: Path, replays: Sequence[LogReplay]) -> None:
    """Remove results that are not of these replays, or whose CSV is gone."""
    named = {replay.name: replay for replay in replays}
    for note in list(kept.glob("*.json")):
        replay = named.get(note.stem.rpartition(".")[0])
        if replay and replay.csv and not (note.stem == replay.key and replay.csv.exists()):
            note.unlink(missing_ok=True)
            replay.csv.unlink(missing_ok=True)


def _clear(directory: Path, replays: Sequence[LogReplay]) -> None:
    """Remove what workers that died have left half written."""
    written = {f"{replay.name}.csv" for replay in replays}
    for partial in list(directory.glob(f".*.{PARTIAL}")):
        if partial.name[1:].rsplit(".", 2)[0] in written:
            partial.unlink(missing_ok=True)


def _failure(work: Work, error: RisafError) -> Row:
    """Tell why there is no summary."""
    assert isinstance(work, LogReplay)  # noqa: S101 they all are
    return {"error": str(error).removeprefix(f"{work.log}: ").removeprefix(f"{work.key}: ")}
