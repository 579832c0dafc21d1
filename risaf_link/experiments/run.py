"""The experiments by name."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from risaf_link.errors import ConfigError
from risaf_link.experiments import figures
from risaf_link.experiments.catalogue import read_own
from risaf_link.experiments.cost import cost
from risaf_link.experiments.drives import DRIVES, drive, outages
from risaf_link.experiments.report import Section, Setting, page
from risaf_link.experiments.sensors import sensors
from risaf_link.experiments.sweeps import faults, montecarlo, sensitivity
from risaf_link.sweep import Sweep

EXPERIMENTS: dict[str, Callable[[Setting], Section]] = {
    "sensors": sensors,
    **{name: partial(drive, name=name) for name in DRIVES},
    "montecarlo": montecarlo,
    "outages": outages,
    "faults": faults,
    "sensitivity": sensitivity,
    "cost": cost,
}
SEEDS = 20


def experiment(
    name: str,
    out: Path,
    *,
    seeds: int | None = None,
    quick: bool = False,
    workers: int | None = None,
    cluster: str | None = None,
    methods: tuple[Path, ...] = (),
) -> list[Section]:
    """Run an experiment, or `all`.

    Parameters
    ----------
    name : str
    out : Path
        Directory of figures and numbers; what is finished is kept in its `cases`.
    seeds : int or None
        At most so many; None: as many as the experiment has.
    quick : bool
        Few seeds, few sensors, short drives.
    workers : int or None
        Processes; None: one a core.
    cluster : str or None
        Address of a Dask scheduler, instead.
    methods : tuple of Path
        Files of methods of the user's own.

    Raises
    ------
    ConfigError
        If there is no such experiment, or something that it needs is missing.
    """
    if name != "all" and name not in EXPERIMENTS:
        known = ", ".join([*EXPERIMENTS, "all"])
        raise ConfigError(f"experiment: {name!r}, expected one of {known}")
    figures.check()
    own = tuple(read_own(path) for path in methods)
    sweep = Sweep(out / "cases", workers, cluster)
    setting = Setting(out, sweep, quick, SEEDS if seeds is None else seeds, own)
    sections = [EXPERIMENTS[each](setting) for each in (EXPERIMENTS if name == "all" else [name])]
    if name == "all":
        page(setting, sections)
    return sections
