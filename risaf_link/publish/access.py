"""Which MQTT broker, and how one gets in: parameters, password, TLS."""

import os
import re
import socket
import ssl
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta, Struct
from msgspec import field as default

from risaf_link.address import HOST
from risaf_link.errors import ConfigError
from risaf_link.private import read_private

PASSWORD = "RISAF_LINK_MQTT_PASSWORD"  # noqa: S105 where it is found, in the environment
PORTS = {"mqtt": 1883, "mqtts": 8883}
URL = re.compile(rf"(mqtts?)://({HOST})(?::([0-9]{{1,5}}))?/?")

Level = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_.-]*$")]
Rate = Annotated[float, Meta(ge=0, le=1000)]
Qos = Literal[0, 1, 2]


class MqttRates(Struct, frozen=True, forbid_unknown_fields=True):
    """How often a topic that tells of estimates is published, Hz; 0: never."""

    attitude: Rate = 5.0
    heading: Rate = 2.0
    array: Rate = 1.0
    sensors: Rate = 0.2


class MqttQos(Struct, frozen=True, forbid_unknown_fields=True):
    """Quality of service, by topic."""

    attitude: Qos = 0
    heading: Qos = 0
    array: Qos = 0
    sensors: Qos = 0
    events: Literal[1, 2] = 1


class MqttParameters(Struct, frozen=True, forbid_unknown_fields=True):
    """Which broker is published to, and what."""

    url: str = ""
    prefix: Annotated[str, Meta(pattern=r"^[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*$")] = "risaf"
    vehicle: Level = ""
    user: str = ""
    password_file: str = ""
    ca: str = ""
    certificate: str = ""
    key: str = ""
    keepalive: Annotated[int, Meta(ge=5, le=3600)] = 15
    rates: MqttRates = default(default_factory=MqttRates)
    qos: MqttQos = default(default_factory=MqttQos)
    states_kept: Annotated[int, Meta(ge=1, le=10_000)] = 16
    events_kept: Annotated[int, Meta(ge=1, le=100_000)] = 1000
    discovery: Level = ""

    @property
    def name(self) -> str:
        """The vehicle's: as configured, or the host's."""
        return self.vehicle or re.sub(r"[^A-Za-z0-9_.-]", "-", socket.gethostname()) or "vehicle"

    @property
    def root(self) -> str:
        """What every topic begins with."""
        return f"{self.prefix}/{self.name}"


@dataclass(frozen=True, slots=True)
class Broker:
    """Where a broker is, and who we are there."""

    host: str
    port: int
    client_id: str
    user: str | None
    password: str | None = field(repr=False)
    tls: ssl.SSLContext | None
    keepalive: int  # s


def address(url: str) -> tuple[bool, str, int] | None:
    """Whether a URL of a broker says TLS, its host and its port; None: it is no such URL."""
    found = URL.fullmatch(url)
    if found is None:
        return None
    port = int(found[3] or PORTS[found[1]])
    return (found[1] == "mqtts", found[2].strip("[]"), port) if 0 < port < 65536 else None


def check(parameters: MqttParameters, where: str) -> None:
    """Raise ConfigError where keys do not fit one another; `where` stands before it."""
    p, found = parameters, address(parameters.url)
    if p.url and found is None:  # it may hold a password: it is not repeated
        raise ConfigError(
            f"{where}mqtt.url: found something else, expected mqtt://HOST:PORT or "
            "mqtts://HOST:PORT, with user and password in keys of their own"
        )
    for key in ("ca", "certificate", "key"):
        if getattr(p, key) and not (found and found[0]):
            raise ConfigError(f"{where}mqtt.{key}: found it with {p.url!r}, expected mqtts://")
    if bool(p.certificate) != bool(p.key):
        missing = "key" if p.certificate else "certificate"
        raise ConfigError(f"{where}mqtt.{missing}: found nothing, expected a file beside the other")


def broker_of(parameters: MqttParameters) -> Broker:
    """Where the broker is, with what the configuration's files and the environment say.

    Raises
    ------
    ConfigError
        In one line: which key, what was found, what was expected.
    """
    p, found = parameters, address(parameters.url)
    if found is None:
        raise ValueError(f"url: found {p.url!r}, expected that of a broker")
    tls, host, port = found
    credentials = (p.user or None, _password(p) if p.user else None)
    context = _context(p) if tls else None
    return Broker(host, port, f"risaf_link-{p.name}", *credentials, context, p.keepalive)


def _password(parameters: MqttParameters) -> str | None:
    if not parameters.password_file:
        return os.environ.get(PASSWORD)
    path = Path(parameters.password_file)
    where = f"mqtt.password_file: {path}: "
    content = read_private(path, where)
    if content is None:
        raise ConfigError(f"{where}found no file, expected one that holds the password")
    try:
        return content.decode().removesuffix("\n").removesuffix("\r")
    except UnicodeDecodeError:
        raise ConfigError(f"{where}found bytes that are not UTF-8, expected text") from None


def _context(parameters: MqttParameters) -> ssl.SSLContext:
    p = parameters
    try:
        context = ssl.create_default_context(cafile=p.ca or None)
    except OSError as error:  # ssl.SSLError is one
        raise ConfigError(f"mqtt.ca: {p.ca}: {_explained(error)}, expected PEM") from None
    if p.certificate:
        read_private(Path(p.key), f"mqtt.key: {p.key}: ")
        try:
            context.load_cert_chain(p.certificate, p.key, password=_no_passphrase)
        except OSError as error:
            raise ConfigError(
                f"mqtt.certificate: {p.certificate} with {p.key}: {_explained(error)}, expected "
                "PEM of both, the key without a passphrase"
            ) from None
    return context


def _no_passphrase() -> str:
    return ""  # else OpenSSL would ask at the terminal


def _explained(error: OSError) -> str:
    return getattr(error, "reason", None) or error.strerror or "not usable"
