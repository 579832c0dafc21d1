"""Parameters that were set over MAVLink and are to last, in a file beside the configuration.

They go over the configuration's file, which is never written, and under what `--set` says.
"""

import logging
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from msgspec import structs

from risaf_link.config import Config, StateParameters, load
from risaf_link.document import DocumentError, read_document
from risaf_link.mavlink.parameters import Parameters, parameters_of
from risaf_link.whole import replace_file

HEAD = "# Parameters that were set over MAVLink; they go over the configuration.\n"

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class KeptParameters:
    """What was kept, by name, and where."""

    path: Path | None = None
    values: dict[str, float] = field(default_factory=dict)
    overruled: dict[str, float] = field(default_factory=dict)
    """Those that the command line sets: they are kept, but not in force."""

    def write(self, values: dict[str, float]) -> str:
        """Replace what is kept, all or nothing, also if power fails; why it failed, or nothing."""
        if self.path is None:
            return "no configuration file"
        try:
            replace_file(self.path, (HEAD + yaml.safe_dump(values, sort_keys=False)).encode())
        except OSError as error:
            return f"{self.path.name}: {error.strerror or error}"
        return ""


NOTHING_KEPT = KeptParameters()


def kept_parameters(
    config: Config, config_path: Path | None, settings: Iterable[str] = ()
) -> KeptParameters:
    """Read what was kept for a configuration.

    What cannot be used is said in the log and left out: parameters are kept by a machine, and no
    reason not to start.

    Parameters
    ----------
    config : Config
        Whose `mavlink.parameters` names the file.
    config_path : Path or None
        The configuration's file. Beside NAME.yaml lies NAME.parameters.yaml, if nothing is named.
    settings : iterable of str
        `KEY=VALUE` of the command line: parameters that it sets are left out.
    """
    path = _place(config, config_path)
    found = _read(path) if path else {}
    chosen = chosen_by(settings)
    known = {parameter.name: parameter for parameter in parameters_of(Config)}
    values: dict[str, float] = {}
    overruled: dict[str, float] = {}
    for name, value in found.items():
        parameter = known.get(name)
        usable = isinstance(value, int | float) and not isinstance(value, bool)
        if parameter is None or not usable or not parameter.admits(value):
            expected = parameter.expected if parameter else "a known parameter"
            _log.warning("%s: %s: found %r, expected %s; left out", path, name, value, expected)
        else:
            (overruled if name in chosen else values)[parameter.name] = float(value)
    return KeptParameters(path, values, overruled)


def load_in_force(config_path: Path | None, settings: Iterable[str] = ()) -> Config:
    """Read a configuration, with the parameters that were kept for it.

    Parameters and errors are those of `load`.
    """
    config = load(config_path, settings)
    kept = kept_parameters(config, config_path, settings).values
    return Parameters(config, kept, fixed=config.unsettable).tuned


def load_for_replay(config_path: Path | None, settings: Iterable[str] = ()) -> Config:
    """Read a configuration as `load_in_force` does, for a log.

    The state that a vehicle keeps is of now, not of the log's time: only one that `settings` name
    is used.
    """
    config = load_in_force(config_path, settings)
    if any(setting.startswith("state.file=") for setting in settings):
        return config
    return structs.replace(config, state=StateParameters())


def chosen_by(settings: Iterable[str]) -> tuple[str, ...]:
    """Names of the parameters that `KEY=VALUE` of the command line sets."""
    keys = [setting.partition("=")[0] for setting in settings]
    return tuple(
        parameter.name
        for parameter in parameters_of(Config)
        if any(f"{parameter.key}.".startswith(f"{key}.") for key in keys)
    )


def _place(config: Config, config_path: Path | None) -> Path | None:
    if config.mavlink.parameters:
        return Path(config.mavlink.parameters)
    return config_path.with_suffix(".parameters.yaml") if config_path else None


def _read(path: Path) -> dict[Any, Any]:
    try:
        found = read_document(path)
    except FileNotFoundError:
        return {}
    except (OSError, DocumentError) as error:
        _log.warning("%s: %s; left out", path, " ".join(str(error).split()))
        return {}
    if not isinstance(found, dict | None):
        _log.warning("%s: found %.40r, expected names with values; left out", path, found)
        return {}
    return found or {}
