"""Work on a cluster: a real scheduler, two worker processes on loopback, one of them killed."""

import os
import signal
from itertools import count
from pathlib import Path

import pytest
from logs import simulated, timeless
from msgspec import Struct

from risaf_link import fleet
from risaf_link.config import Config
from risaf_link.errors import ConfigError
from risaf_link.experiments.case import Case
from risaf_link.publish.rows import RowWriter
from risaf_link.replay import Selection
from risaf_link.sweep import Sweep

dask = pytest.importorskip("dask")
distributed = pytest.importorskip("distributed")
pytestmark = pytest.mark.filterwarnings("ignore")  # what Dask itself warns of is not ours


def is_first(mark):
    """Whether nobody has asked before, in any process."""
    try:
        os.close(os.open(mark, os.O_CREAT | os.O_EXCL))
    except FileExistsError:
        return False
    return True


class Mortal(Struct, frozen=True):
    """A case that kills its worker the first time."""

    mark: str
    key: str = "mortal"

    def run(self):
        if is_first(self.mark):
            os.kill(os.getpid(), signal.SIGKILL)
        return {"survived": True}


class MortalReplay(fleet.LogReplay, frozen=True):
    """A replay that kills its worker half way through the second log, the first time."""

    def run(self):
        if self.name == "drive-1" and is_first(Path(self.log).with_suffix(".mark")):
            rows = count()

            class Killer(RowWriter):
                def write(self, estimate):
                    super().write(estimate)
                    if next(rows) == 100:
                        os.kill(os.getpid(), signal.SIGKILL)

            fleet.RowWriter = Killer
        return fleet.LogReplay.run(self)


class Deadly(Struct, frozen=True):
    """A case that kills its worker every time."""

    key: str = "deadly"

    def run(self):
        os.kill(os.getpid(), signal.SIGKILL)


@pytest.fixture
def cluster():
    few = dask.config.set({"distributed.scheduler.allowed-failures": 1})  # 3 take longer
    with (
        few,
        distributed.LocalCluster(
            n_workers=2,
            threads_per_worker=1,
            processes=True,
            dashboard_address=None,
            host="127.0.0.1",
        ) as made,
    ):
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


def test_a_case_that_kills_every_worker_costs_only_itself(tmp_path, cluster):
    work = [Mortal(str(tmp_path / "0"), "0"), Deadly(), Mortal(str(tmp_path / "2"), "2")]
    for mark in ("0", "2"):
        is_first(tmp_path / mark)

    def told(_, error):
        return {"error": str(error)}

    rows = Sweep(tmp_path / "cases", cluster=cluster.scheduler_address).run(work, "", failed=told)
    assert "deadly: every worker process" in rows.pop(1)["error"]
    assert rows == [{"survived": True}] * 2


def test_logs_are_replayed_though_a_worker_is_killed(tmp_path, cluster, monkeypatch):
    logs = [
        *(simulated(tmp_path / f"drive-{n}.tlog", 8.0, sensors=5, seed=n) for n in range(4)),
        tmp_path / "none.tlog",
    ]
    asked = Config(), Selection(outages=((4.0, 8.0),))
    expected = fleet.replay_all(logs, *asked, csv=tmp_path / "here", workers=1)
    monkeypatch.setattr(fleet, "LogReplay", MortalReplay)
    there = tmp_path / "there"
    rows = fleet.replay_all(logs, *asked, csv=there, cluster=cluster.scheduler_address)
    assert (tmp_path / "drive-1.mark").exists()
    assert timeless(rows) == timeless(expected)
    assert rows[-1] == {"log": str(logs[-1]), "error": "No such file or directory"}
    assert sorted(path.name for path in there.iterdir()) == [
        "cases",
        *(f"drive-{n}.csv" for n in range(4)),
    ]
    for table in there.glob("*.csv"):
        assert table.read_bytes() == (tmp_path / "here" / table.name).read_bytes()


def test_a_scheduler_that_is_not_there_is_told_in_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr("risaf_link.sweep.PATIENCE", 0.2)
    with pytest.raises(ConfigError, match="no scheduler answers") as told:
        Sweep(tmp_path, cluster="tcp://127.0.0.1:9").run([Mortal(str(tmp_path / "mark"))], "")
    assert "\n" not in str(told.value)
