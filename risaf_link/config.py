"""The configuration: one YAML file and what the command line sets over it.

The parameters themselves stand beside the algorithms that they belong to; here they are put
together, and what is wrong with them is said.
"""

import re
import reprlib
from collections.abc import Iterable, Iterator
from copy import deepcopy
from pathlib import Path
from typing import Annotated, Any

import msgspec
import yaml
from msgspec import Meta, Struct, field, inspect

from risaf_link.core.array import ArrayCalibration, Calibration
from risaf_link.core.tunable import Tunable
from risaf_link.document import DocumentError, parse_document, read_document
from risaf_link.errors import ConfigError, LinkError
from risaf_link.links import RecordingParameters, TlogLink, open_link, overlap
from risaf_link.mavlink.dialect import IDS
from risaf_link.mavlink.identity import Identity
from risaf_link.mavlink.odometry import ProfileName
from risaf_link.mavlink.requests import RequestedRates
from risaf_link.mavlink.signing import SigningParameters
from risaf_link.mavlink.telemetry import DEFAULT_RATES, Rates
from risaf_link.pipeline import PipelineParameters
from risaf_link.publish.access import MqttParameters
from risaf_link.publish.access import check as check_mqtt
from risaf_link.publish.scrape import MetricsParameters
from risaf_link.publish.scrape import check as check_metrics

Id = Annotated[int, Meta(ge=1, le=255)]
RATE_NAMES = (
    *("RATE_ATT_QUAT", "RATE_GPS_HDG", "RATE_ARRAY", "RATE_HEALTH", "RATE_REASON"),
    *("RATE_ATT_COV", "RATE_EST_STATUS", "RATE_NAMED", "RATE_ODOMETRY"),
)
"""Of the parameters that set the rates of `Message`s, in their order."""


class MavlinkParameters(Struct, frozen=True, forbid_unknown_fields=True):
    """Who this service is on the MAVLink network."""

    system_id: Id | None = None  # None: that of the one autopilot that is heard; 1 before
    component_id: Id = 191
    odometry: ProfileName = "auto"  # which autopilot ODOMETRY is for; auto: as its HEARTBEAT tells
    parameters: str = ""  # file that keeps what was set over MAVLink


class StateParameters(Struct, frozen=True, forbid_unknown_fields=True):
    """What is kept of biases, health and heading, so that a restart goes on from there."""

    file: str = ""  # empty: nothing is
    period: Annotated[float, Meta(ge=0.1, le=3600)] = 5.0  # s, from one writing to the next


class LinkParameters(Struct, frozen=True, forbid_unknown_fields=True):
    """One link."""

    name: Annotated[str, Meta(min_length=1)]
    url: str
    emit: Rates | None = None  # None: the default set
    request: RequestedRates | None = None  # None: what is needed, where an autopilot is heard
    signing: SigningParameters | None = None  # None: nothing is signed or verified
    recording: RecordingParameters | None = None  # None: the defaults


class Config(PipelineParameters, frozen=True, forbid_unknown_fields=True):
    """Everything that can be configured."""

    mavlink: MavlinkParameters = field(default_factory=MavlinkParameters)
    state: StateParameters = field(default_factory=StateParameters)
    emit: Annotated[Rates, Tunable(RATE_NAMES, "Hz")] = field(default_factory=DEFAULT_RATES.copy)
    """how often it goes to a peer that has not asked for another rate, on links without an `emit`
    of their own."""
    links: tuple[LinkParameters, ...] = (
        LinkParameters("vehicle", "udpin://127.0.0.1:14560"),
        LinkParameters("ground", "udpout://127.0.0.1:14550"),
    )
    mqtt: MqttParameters = field(default_factory=MqttParameters)
    metrics: MetricsParameters = field(default_factory=MetricsParameters)

    @property
    def own(self) -> tuple[int, int]:
        """System and component id of this service."""
        return self.mavlink.system_id or 1, self.mavlink.component_id

    @property
    def hears_estimates(self) -> bool:
        """Whether an autopilot's own estimate is believed: it must not be told ours."""
        return "GLOBAL_POSITION_INT" in self.gps.messages

    @property
    def unsettable(self) -> frozenset[str]:
        """Parameters that cannot be set: what they ask for is refused in a file as well."""
        return frozenset({"RATE_ODOMETRY"} if self.hears_estimates else ())


def identity_of(config: Config) -> Identity:
    """Whom a configuration makes us."""
    mavlink = config.mavlink
    odometry = None if config.hears_estimates else mavlink.odometry
    return Identity(*config.own, mavlink.system_id is None, odometry)


def load(path: Path | None, settings: Iterable[str] = ()) -> Config:
    """Read a configuration.

    Parameters
    ----------
    path : Path or None
        A YAML file; None: the defaults.
    settings : iterable of str
        `KEY=VALUE`, such as `fusion.method=mean` or `links.0.url=...`; set over the file.

    Raises
    ------
    ConfigError
        In one line: which key, what was found, what was expected.
    """
    where = f"{path}: " if path else ""
    content = (_read_yaml(path) or {}) if path else {}
    if not isinstance(content, dict):
        raise ConfigError(f"{where}found {_short(content)}, expected keys with values")
    tree = {**_tree(Config()), **content}
    for setting in settings:
        _set(tree, setting)
    try:
        config = msgspec.convert(tree, Config)
    except msgspec.ValidationError as error:
        raise ConfigError(where + _explain(error, tree)) from None
    _check_links(where, config.links)
    _check_feeding(where, config)
    check_mqtt(config.mqtt, where)
    check_metrics(config.metrics, where)
    return config


def load_calibration(config: Config) -> ArrayCalibration | None:
    """Read the file that `array.calibration` names; None if it names none.

    Raises
    ------
    ConfigError
        In one line: which key, what was found, what was expected.
    """
    if not config.array.calibration:
        return None
    path = Path(config.array.calibration)
    content = _read_yaml(path)
    try:
        calibration = msgspec.convert(content, ArrayCalibration)
        Calibration(calibration)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{path}: {_explain(error, content, ArrayCalibration)}") from None
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from None
    if config.array.sensors not in {0, len(calibration.gyros)}:
        raise ConfigError(
            f"array.sensors: found {config.array.sensors}, expected {len(calibration.gyros)}, "
            f"as many as {path} calibrates"
        )
    return calibration


def dump(config: Config) -> str:
    """A configuration as YAML, whole."""
    return yaml.safe_dump(_tree(config), sort_keys=False, default_flow_style=None)


def _tree(config: Config) -> dict[str, Any]:
    """A configuration as YAML has it: dicts, lists and plain values."""
    tree: dict[str, Any] = msgspec.json.decode(msgspec.json.encode(config))
    return tree


def _check_links(where: str, links: tuple[LinkParameters, ...]) -> None:
    names = [link.name for link in links]
    recordings: list[Path] = []
    for i, link in enumerate(links):
        if link.name in names[:i]:
            raise ConfigError(f"{where}links.{i}.name: found {link.name!r} twice, expected once")
        try:
            made = open_link(link.url, link.name, lambda: 0)
        except LinkError as error:
            raise ConfigError(f"{where}links.{i}.url: {error}") from None
        if link.signing:
            _check_signing(f"{where}links.{i}.signing", link)
        if isinstance(made, TlogLink):
            same = next((path for path in recordings if overlap(path, made.path)), None)
            if same:
                raise ConfigError(
                    f"{where}links.{i}.url: found {link.url!r} beside the recording {same}, "
                    "expected names that no segment of another has"
                )
            recordings.append(made.path)
        if link.recording and not link.url.startswith("tlog:"):
            raise ConfigError(
                f"{where}links.{i}.recording: found it of a link with peers, expected it of a "
                "recording"
            )


def _check_feeding(where: str, config: Config) -> None:
    """Refuse to tell an autopilot the heading that it tells us."""
    emitted = {*config.emit, *(name for link in config.links for name in link.emit or {})}
    if "ODOMETRY" in emitted and config.hears_estimates:
        raise ConfigError(
            f"{where}gps.messages: found GLOBAL_POSITION_INT, the autopilot's own estimate, "
            "expected none where ODOMETRY is emitted: it would hear itself"
        )


def _check_signing(where: str, link: LinkParameters) -> None:
    if link.url.startswith("tlog:"):
        raise ConfigError(f"{where}: found it of a recording, expected it of a link with peers")
    if link.signing and re.fullmatch(r"[0-9A-Fa-f]{64}", link.signing.key):  # not to be repeated
        raise ConfigError(
            f"{where}.key: found 64 hexadecimal digits, expected the name of a file with them"
        )
    named = link.signing.accept_unsigned if link.signing else ()
    for k, name in enumerate(() if isinstance(named, bool) else named):
        if name not in IDS:
            raise ConfigError(
                f"{where}.accept_unsigned.{k}: found {name!r}, expected a MAVLink message's name"
            )


def _read_yaml(path: Path) -> Any:
    try:
        return read_document(path)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from None
    except DocumentError as error:
        raise ConfigError(f"{path}: {error}") from None


def _set(tree: dict[str, Any], setting: str) -> None:
    """Put one KEY=VALUE into the tree."""
    path, equals, text = setting.partition("=")
    if not equals or not path:
        raise ConfigError(f"--set {setting}: expected KEY=VALUE")
    try:
        value = parse_document(text)
    except DocumentError:
        raise ConfigError(f"--set {path}: found {text!r}, expected a YAML value") from None
    *parents, key = path.split(".")
    place: Any = tree
    for parent in parents:
        place = _child(place, parent)
    if isinstance(place, list) and key.isdecimal() and int(key) < len(place):
        place[int(key)] = value
    elif isinstance(place, dict):
        place[key] = value
    else:
        raise ConfigError(f"--set {path}: no such key")


def _child(place: Any, key: str) -> Any:
    if isinstance(place, dict):
        return place.setdefault(key, {})
    if isinstance(place, list) and key.isdecimal() and int(key) < len(place):
        return place[int(key)]
    return None


def _explain(error: msgspec.ValidationError, tree: Any, schema: type[Struct] = Config) -> str:
    """What msgspec found wrong: which key, what was found, what was expected."""
    for odd in _with_backtick(tree):
        known = _names(_kinds_at(schema, odd[:-1]), of_key=True)
        if known:
            return _unknown(".".join(odd), known)
    message = str(error)
    place = re.search(r" - at (`key` in )?`\$([^`]*)`\Z", message)
    of_key, path = place.groups() if place else ("", "")
    message = message[: place.start()] if place else message
    steps = re.findall(r"\w+|\.\.\.", path)
    if "..." in steps:
        steps[steps.index("...")] = _culprit(error, tree, steps, schema)
    kinds = _kinds_at(schema, steps)
    field_name = re.search(r"field `(.*)`", message, re.DOTALL)
    if field_name:
        key = ".".join([*steps, field_name[1]])
        if message.startswith("Object missing"):
            return f"{key}: found nothing, expected a value"
        return _unknown(key, _names(kinds, of_key=True))
    key = ".".join(steps)
    if of_key:
        known = _names(kinds, of_key=True)
        found = next(iter(set(_value_at(tree, steps)) - set(known)))
        return _unknown(f"{key}.{found}", known)
    found = _value_at(tree, steps)
    if message.startswith("Invalid enum"):
        expected = f"one of {', '.join(_names(kinds, of_key=False))}"
    else:
        expected = re.sub(r"^Expected |`|, got .*$", "", message).replace("null", "nothing")
    return f"{key}: found {_short(found)}, expected {expected}"


def _unknown(key: str, known: list[str]) -> str:
    return f"{key}: unknown key; known: {', '.join(known)}"


def _with_backtick(tree: Any, place: tuple[str, ...] = ()) -> Iterator[list[str]]:
    """Places of keys that could be taken for the end of a quotation of msgspec's."""
    if isinstance(tree, dict | list):
        for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
            inside = (*place, str(key))
            if "`" in inside[-1]:
                yield list(inside)
            yield from _with_backtick(value, inside)


def _kinds_at(schema: type[Struct], steps: list[str]) -> list[inspect.Type]:
    """What may stand at a place of the configuration."""
    kinds = [inspect.type_info(schema)]
    for step in steps:
        kinds = _alternatives([_inside(kind, step) for kind in kinds])
    return kinds


def _alternatives(kinds: list[inspect.Type | None]) -> list[inspect.Type]:
    found: list[inspect.Type] = []
    for kind in kinds:
        if isinstance(kind, inspect.UnionType):
            found += kind.types
        elif kind is not None:
            found.append(kind)
    return found


def _inside(kind: inspect.Type, step: str) -> inspect.Type | None:
    if isinstance(kind, inspect.StructType):
        return next((field.type for field in kind.fields if field.name == step), None)
    if isinstance(kind, inspect.VarTupleType | inspect.ListType):
        return kind.item_type
    return kind.value_type if isinstance(kind, inspect.DictType) else None


def _names(kinds: list[inspect.Type], of_key: bool) -> list[str]:
    """Keys, or literal values, that may stand at a place."""
    names: list[str] = []
    for kind in kinds:
        if of_key and isinstance(kind, inspect.StructType):
            names += [field.name for field in kind.fields]
        elif of_key and isinstance(kind, inspect.DictType):
            names += _names([kind.key_type], of_key=False)
        elif not of_key and isinstance(kind, inspect.LiteralType):
            names += [str(value) for value in kind.values]
    return names


def _culprit(
    error: msgspec.ValidationError, tree: Any, steps: list[str], schema: type[Struct]
) -> str:
    """Which key of a mapping msgspec means by `...`: the one that alone makes the same error."""
    before = steps[: steps.index("...")]
    for key, value in _value_at(tree, before).items():
        trial = deepcopy(tree)
        place = _value_at(trial, before)
        place.clear()
        place[key] = value
        try:
            msgspec.convert(trial, schema)
        except msgspec.ValidationError as other:
            if str(other) == str(error):
                return str(key)
    return "..."


def _value_at(tree: Any, steps: list[str]) -> Any:
    """What was found at a place."""
    for step in steps:
        tree = tree[int(step)] if isinstance(tree, list) else tree[step]
    return tree


_BRIEFLY = reprlib.Repr()  # as `repr`, but of 60 characters it makes no gigabyte first
_BRIEFLY.maxlevel = 3
_BRIEFLY.maxlist = _BRIEFLY.maxdict = _BRIEFLY.maxtuple = 20
_BRIEFLY.maxstring = _BRIEFLY.maxlong = _BRIEFLY.maxother = 200


def _short(value: Any) -> str:
    text = "nothing" if value is None else _BRIEFLY.repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
