"""A sweep on a cluster: a real scheduler, two worker processes on loopback, one of them killed."""

import os
import signal

import pytest
from msgspec import Struct

from risaf_link.errors import ConfigError
from risaf_link.experiments.case import Case
from risaf_link.sweep import Sweep

distributed = pytest.importorskip("distributed")
pytestmark = pytest.mark.filterwarnings("ignore")  # what Dask itself warns of is not ours


class Mortal(Struct, frozen=True):
    """A case whose first run tells its process id and waits for a signal that kills it."""

    mark: str
    key: str = "mortal"

    def run(self):
        try:
            os.close(os.open(self.mark, os.O_CREAT | os.O_EXCL))
        except FileExistsError:
            return {"survived": True}
        os.kill(os.getpid(), signal.SIGKILL)
        return {}


@pytest.fixture
def cluster():
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, host="127.0.0.1"
    ) as made:
        yield made


def test_a_sweep_is_complete_though_a_worker_is_killed(tmp_path, cluster):
    drives = [
        Case("circle", seed, ("mean", "ours"), ((2.0, 4.0),), duration=4.0, sensors=5)
        for seed in range(6)
    ]
    work = [*drives[:3], Mortal(str(tmp_path / "mark")), *drives[3:]]
    results = Sweep(tmp_path / "cases", cluster=cluster.scheduler_address).run(work, "")
    assert (tmp_path / "mark").exists()
    assert results.pop(3) == {"survived": True}
    assert results == Sweep(tmp_path / "here", workers=1).run(drives, "")


def test_a_scheduler_that_is_not_there_is_told_in_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr("risaf_link.sweep.PATIENCE", 0.2)
    with pytest.raises(ConfigError, match="no scheduler answers") as told:
        Sweep(tmp_path, cluster="tcp://127.0.0.1:9").run([Mortal(str(tmp_path / "mark"))], "")
    assert "\n" not in str(told.value)
