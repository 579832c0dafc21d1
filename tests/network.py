"""A component on a network of ground stations that pymavlink speaks for."""

from collections import defaultdict
from importlib.util import find_spec, module_from_spec
from typing import Any

import msgspec
from wire import frame

from risaf_link.config import Config
from risaf_link.core.estimate import Estimate
from risaf_link.mavlink import risaf
from risaf_link.mavlink.component import Component
from risaf_link.mavlink.frame import Frame
from risaf_link.mavlink.identity import Identity
from risaf_link.mavlink.parameters import Parameters

OWN = (1, 191)
GCS, OTHER_GCS = (255, 190), (254, 190)
NEAR, FAR = ("ground", "10.0.0.2:14550"), ("ground", "10.0.0.3:14550")


def _decoder_of_all() -> Any:
    """Make a copy of pymavlink's dialect of all public messages, with ours beside them."""
    spec = find_spec("pymavlink.dialects.v20.all")
    dialect = module_from_spec(spec)
    spec.loader.exec_module(dialect)
    dialect.mavlink_map.update(risaf.mavlink_map)
    return dialect


public = _decoder_of_all()


class Recorder:
    """An estimator that notes what is done to it."""

    def __init__(self) -> None:
        self.done: list[Any] = []

    def configure(self, parameters: Any) -> None:
        self.done.append(parameters)

    def restart(self) -> None:
        self.done.append("restart")

    def set_bias(self, rate_b: Any, variance: Any) -> None:
        self.done.append((rate_b, variance))

    def adopt(self, own: tuple[int, int]) -> None:
        self.done.append(own)

    def now_us(self, unix_us: int) -> int:
        return unix_us - 7_000_000


class Network:
    """A component, two ground stations on one link, and time."""

    def __init__(self, config: Config | None = None, adopts: bool = False, **options: Any) -> None:
        config = config or Config()
        kept = options.pop("kept", None)
        self.parameters = Parameters(config, kept, fixed=config.unsettable)
        self.estimator = options.pop("estimator", None) or Recorder()
        odometry = None if config.hears_estimates else "auto"
        self.component = Component(
            self.parameters, self.estimator, Identity(*OWN, adopts, odometry), **options
        )
        self.peers = [NEAR, FAR]
        self.now_us = 77_000_000
        self._decoders: defaultdict[Any, Any] = defaultdict(lambda: public.MAVLink(None))

    def send(self, name: str, sender=GCS, peer=NEAR, **fields: Any) -> list[Any]:
        """Let a ground station send a message, addressed to us unless told otherwise."""
        to = {"target_system": OWN[0], "target_component": OWN[1]}
        asked = "target_system" in public.mavlink_map[_id(name)].fieldnames
        return self.take(frame(name, sender, **((to if asked else {}) | fields)), peer)

    def take(self, sent: Frame, peer=NEAR) -> list[Any]:
        """Let a frame arrive; what the one who sent it hears of it."""
        self.component.receive(sent, peer, self.now_us)
        return self.heard(peer).get(peer, [])

    def command(self, command: int, *values: float, peer=NEAR, sender=GCS, **to: int) -> list[Any]:
        """Send a COMMAND_LONG."""
        params = {f"param{i}": value for i, value in enumerate(values, 1)}
        return self.send("COMMAND_LONG", sender, peer, command=command, **params, **to)

    def set(self, name: str, value: float, **fields: Any) -> list[Any]:
        """Set a parameter."""
        told = {"param_id": name.encode(), "param_value": value, "param_type": 9}
        return self.send("PARAM_SET", **(told | fields))

    def wait(self, seconds: float) -> dict[Any, list[Any]]:
        """Let time pass in steps of 0.1 s; what each peer hears."""
        everything: defaultdict[Any, list[Any]] = defaultdict(list)
        for _ in range(round(seconds * 10)):
            self.now_us += 100_000
            self.component.advance(self.now_us)
            for peer, messages in self.heard().items():
                everything[peer] += messages
        return everything

    def estimate(self, estimate: Estimate) -> dict[Any, list[Any]]:
        """Let an estimate be made; what each peer hears."""
        self.component.observe(estimate)
        return self._decoded(self.component.emit(estimate, self.peers))

    def heard(self, *speakers: Any) -> dict[Any, list[Any]]:
        """What each peer hears now, and each of those who have just spoken."""
        return self._decoded(self.component.collect([*self.peers, *speakers]))

    def _decoded(self, frames: list[tuple[Any, bytes]]) -> dict[Any, list[Any]]:
        messages: defaultdict[Any, list[Any]] = defaultdict(list)
        for peer, raw in frames:
            messages[peer] += self._decoders[peer].parse_buffer(raw)
        return messages


def of(messages: list[Any], name: str) -> list[Any]:
    """Those of one name."""
    return [message for message in messages if message.get_type() == name]


def acks(messages: list[Any]) -> list[tuple[int, int]]:
    """Commands that were acknowledged, with their results."""
    return [(m.command, m.result) for m in of(messages, "COMMAND_ACK")]


def texts(messages: list[Any]) -> list[str]:
    """What STATUSTEXT says, put together."""
    whole: list[str] = []
    for message in of(messages, "STATUSTEXT"):
        if message.chunk_seq:
            whole[-1] += message.text
        else:
            whole.append(message.text)
    return whole


def changed(config: Config, **sections: dict[str, Any]) -> Config:
    """A configuration with other values."""
    tree = msgspec.json.decode(msgspec.json.encode(config))
    for section, values in sections.items():
        tree[section].update(values)
    return msgspec.convert(tree, Config)


def _id(name: str) -> int:
    return next(i for i, kind in public.mavlink_map.items() if kind.msgname == name)
