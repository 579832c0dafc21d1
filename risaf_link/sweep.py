"""Many independent cases on all cores or on a cluster; what is done stays done.

A case is one small file when it is finished, named by all that its result depends on: parameters,
seed and program. A sweep that was interrupted goes on where it was, and none of its numbers depends
on how many workers there were, or where. A worker that dies costs the time of its case, which
another one takes; a case that kills whoever takes it costs only itself.
"""

import hashlib
import os
import sys
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import contextmanager
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Protocol

import msgspec

from risaf_link.errors import ConfigError, RisafError
from risaf_link.parent import end_with

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
ATTEMPTS = 4  # at a case whose worker dies; as many as Dask makes by default
PATIENCE = 10  # s, for a scheduler to answer

PACKAGE = Path(__file__).parent
Row = dict[str, Any]
Outcome = bytes | RisafError  # JSON, or why there is none


class Work(Protocol):
    """One case: data that can be sent to another process, and know what they are."""

    @property
    def key(self) -> str:
        """Name of its result."""
        ...

    def run(self) -> Row:
        """Make the result: what JSON can hold."""
        ...


def execute(work: Work) -> Outcome:
    """Run a case, anywhere; its result as JSON, or the error that it ended with."""
    try:
        return msgspec.json.encode(work.run())
    except RisafError as error:
        return error


@cache
def program(*parts: str) -> str:
    """Digest of parts of this package, as far as results depend on them.

    Parameters
    ----------
    *parts : str
        Modules and directories, such as `pipeline.py` and `core`.
    """
    paths = [PACKAGE / part for part in parts]
    files = {
        file
        for path in paths
        for file in (path.rglob("*") if path.is_dir() else [path])
        if file.suffix in {".py", ".so"}
    }
    digest = hashlib.sha256()
    for file in sorted(files):
        digest.update(file.relative_to(PACKAGE).as_posix().encode() + file.read_bytes())
    return digest.hexdigest()


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

    def run(
        self,
        cases: Sequence[Work],
        label: str,
        alone: bool = False,
        failed: Callable[[Work, RisafError], Row] | None = None,
    ) -> list[Row]:
        """Run those cases that are not done yet; the results of all, in their order.

        Parameters
        ----------
        cases : sequence
        label : str
            For the progress bar.
        alone : bool
            Whether a case must have the machine for itself, this one: it is timed.
        failed : callable or None
            Makes the result of a case that ended with an error, or whose workers died; it is not
            kept. None: such a case ends the sweep.

        Raises
        ------
        RisafError
            If the cluster does not answer or is lost, or a case failed and that ends the sweep.
        """
        try:
            self._directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"{self._directory}: {error.strerror or error}") from None
        missing = [case for case in cases if not self._path(case).exists()]
        failures: dict[str, Row] = {}
        with _progress(label, len(missing)) as advance:
            for case, outcome in self._execute(missing, alone):
                if isinstance(outcome, bytes):
                    self._keep(case, outcome)
                elif failed:
                    failures[case.key] = failed(case, outcome)
                else:
                    raise outcome
                advance()
        return [failures.get(case.key) or self._kept(case) for case in cases]

    def _path(self, case: Work) -> Path:
        return self._directory / f"{case.key}.json"

    def _keep(self, case: Work, content: bytes) -> None:
        path = self._path(case)
        fresh = path.with_suffix(f".{os.getpid()}")
        fresh.write_bytes(content)
        fresh.replace(path)

    def _kept(self, case: Work) -> Row:
        row: Row = msgspec.json.decode(self._path(case).read_bytes())
        return row

    def _execute(self, cases: Sequence[Work], alone: bool) -> Iterator[tuple[Work, Outcome]]:
        if not cases:
            return iter(())
        if self._cluster and not alone:
            return _on_cluster(cases, self._cluster)
        return _on_cores(cases, 1 if alone else min(self._workers, len(cases)))


class _Worker:
    """A process of its own: when it dies, the case that it ran is known, and no other is lost."""

    def __init__(self) -> None:
        self._pool = self._process()

    def submit(self, case: Work) -> Future[Outcome]:
        """Start a case, in a new process if the last one has died."""
        try:
            return self._pool.submit(execute, case)
        except BrokenExecutor:
            self._pool = self._process()
            return self._pool.submit(execute, case)

    def close(self) -> None:
        """Wait for the case that runs, and end the process."""
        self._pool.shutdown()

    @staticmethod
    def _process() -> ProcessPoolExecutor:
        context = get_context("spawn")
        return ProcessPoolExecutor(
            1, mp_context=context, initializer=end_with, initargs=(os.getpid(),)
        )


def _on_cores(cases: Sequence[Work], workers: int) -> Iterator[tuple[Work, Outcome]]:
    waiting = deque((case, 1) for case in cases)
    idle = [_Worker() for _ in range(workers)]
    running: dict[Future[Outcome], tuple[_Worker, Work, int]] = {}
    with _one_thread_each():
        try:
            while waiting or running:
                while waiting and idle:
                    worker, (case, attempt) = idle.pop(), waiting.popleft()
                    running[worker.submit(case)] = worker, case, attempt
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    worker, case, attempt = running.pop(future)
                    idle.append(worker)
                    died = isinstance(future.exception(), BrokenExecutor)
                    if died and attempt < ATTEMPTS:
                        waiting.append((case, attempt + 1))
                    else:
                        yield case, _lost(case) if died else future.result()
        finally:
            for worker in [*idle, *(worker for worker, _, _ in running.values())]:
                worker.close()


def _on_cluster(cases: Sequence[Work], address: str) -> Iterator[tuple[Work, Outcome]]:
    try:
        from distributed import Client, KilledWorker
        from distributed import as_completed as completed
    except ImportError:
        raise ConfigError(
            "--cluster needs dask.distributed: install risaf-link with the extra `cluster`"
        ) from None
    try:
        client = Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ConfigError(f"--cluster {address}: no scheduler answers: {error}") from None
    suspects = []

    def died(future: Any) -> bool:
        return isinstance(future.exception(), KilledWorker)

    try:
        with client:
            futures = {client.submit(execute, case, pure=False): case for case in cases}
            for future in completed(futures, loop=client.loop):
                if died(future):
                    suspects.append(futures[future])
                else:
                    yield futures[future], future.result()
            for case in suspects:  # alone: it may have waited behind one that killed its workers
                last = client.submit(execute, case, pure=False)
                yield case, _lost(case) if died(last) else last.result()
    except CancelledError:
        raise RisafError(
            f"--cluster {address}: the scheduler was lost; what was finished is kept"
        ) from None


def _lost(case: Work) -> RisafError:
    return RisafError(f"{case.key}: every worker process that ran it died, out of memory perhaps")


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
