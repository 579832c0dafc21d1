"""Many independent cases on all cores or on a cluster; what is done stays done.

A case is one small file when it is finished, named by all that its result depends on: parameters,
seed and program. A sweep that was interrupted goes on where it was, and none of its numbers depends
on how many workers there were, or where.
"""

import os
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Protocol

import msgspec

from risaf_link.errors import ConfigError, RisafError

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
RETRIES = 5  # of a case whose worker was lost
PATIENCE = 10  # s, for a scheduler to answer

Row = dict[str, Any]


class Work(Protocol):
    """One case: data that can be sent to another process, and know what they are."""

    @property
    def key(self) -> str:
        """Name of its result."""
        ...

    def run(self) -> Row:
        """Make the result: what JSON can hold."""
        ...


def execute(work: Work) -> bytes:
    """Run a case, anywhere; its result as JSON."""
    return msgspec.json.encode(work.run())


class Sweep:
    """Runs cases, and remembers them in a directory.

    Parameters
    ----------
    directory : Path
        Where results are kept.
    workers : int or None
        Processes; None: one for every core that this process may use.
    cluster : str or None
        Address of a Dask scheduler, instead.
    """

    def __init__(
        self, directory: Path, workers: int | None = None, cluster: str | None = None
    ) -> None:
        self._directory = directory
        self._workers = workers or len(os.sched_getaffinity(0))
        self._cluster = cluster

    def run(self, cases: Sequence[Work], label: str, alone: bool = False) -> list[Row]:
        """Run those cases that are not done yet; the results of all, in their order.

        Parameters
        ----------
        cases : sequence
        label : str
            For the progress bar.
        alone : bool
            Whether a case must have the machine for itself, this one: it is timed.

        Raises
        ------
        RisafError
            If a worker was lost, or the cluster does not answer.
        """
        try:
            self._directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"{self._directory}: {error.strerror or error}") from None
        missing = [case for case in cases if not self._path(case).exists()]
        with _progress(label, len(missing)) as advance:
            for case, content in self._execute(missing, alone):
                path = self._path(case)
                fresh = path.with_suffix(f".{os.getpid()}")
                fresh.write_bytes(content)
                fresh.replace(path)
                advance()
        return [msgspec.json.decode(self._path(case).read_bytes()) for case in cases]

    def _path(self, case: Work) -> Path:
        return self._directory / f"{case.key}.json"

    def _execute(self, cases: Sequence[Work], alone: bool) -> Iterator[tuple[Work, bytes]]:
        if not cases:
            return iter(())
        if self._cluster and not alone:
            return _on_cluster(cases, self._cluster)
        return _on_cores(cases, 1 if alone else min(self._workers, len(cases)))


def _on_cores(cases: Sequence[Work], workers: int) -> Iterator[tuple[Work, bytes]]:
    with (
        _one_thread_each(),
        ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool,
    ):
        futures = {pool.submit(execute, case): case for case in cases}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        except BrokenExecutor:
            raise RisafError(
                "a worker process died; what was finished is kept, start again to go on"
            ) from None
        finally:
            pool.shutdown(cancel_futures=True)


def _on_cluster(cases: Sequence[Work], address: str) -> Iterator[tuple[Work, bytes]]:
    try:
        from distributed import Client
        from distributed import as_completed as completed
    except ImportError:
        raise ConfigError(
            "--cluster needs dask.distributed: install risaf-link with the extra `cluster`"
        ) from None
    try:
        client = Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ConfigError(f"--cluster {address}: no scheduler answers: {error}") from None
    with client:
        futures = {
            client.submit(execute, case, pure=False, retries=RETRIES): case for case in cases
        }
        for future in completed(futures, loop=client.loop):
            yield futures[future], future.result()


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Let each worker's linear algebra use one core: there is a worker on every one."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _progress(label: str, cases: int) -> Iterator[Any]:
    """Show a progress bar, on a terminal."""
    if not cases or not sys.stderr.isatty():
        yield lambda: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

    columns = "{task.description}", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(label, total=cases)
        yield lambda: bar.advance(task)
