"""Bytes in and out, over serial devices, UDP, TCP, recordings; each described by a URL."""

import re
from collections.abc import Callable
from pathlib import Path

from risaf_link.address import HOST
from risaf_link.errors import LinkError
from risaf_link.links.link import Link, LinkCounts, Receive, Worth
from risaf_link.links.memory import MemoryLink
from risaf_link.links.serial import SerialLink
from risaf_link.links.tcp import TcpInLink, TcpOutLink
from risaf_link.links.tlog import RecordingParameters, TlogLink, overlap
from risaf_link.links.udp import UdpInLink, UdpOutLink

__all__ = [
    "Link",
    "LinkCounts",
    "MemoryLink",
    "Receive",
    "RecordingParameters",
    "SerialLink",
    "TcpInLink",
    "TcpOutLink",
    "TlogLink",
    "UdpInLink",
    "UdpOutLink",
    "Worth",
    "open_link",
    "overlap",
]

_HOST_PORT = rf"({HOST}):([0-9]{{1,9}})"
_FORMS = {
    "serial": ("serial:///dev/NAME:BAUD", r"(/.+):([0-9]{1,9})"),
    "udpin": ("udpin://ADDRESS:PORT", _HOST_PORT),
    "udpout": ("udpout://HOST:PORT", _HOST_PORT),
    "tcpin": ("tcpin://ADDRESS:PORT", _HOST_PORT),
    "tcpout": ("tcpout://HOST:PORT", _HOST_PORT),
    "tlog": ("tlog:///PATH", r"/.*[^/]"),
    "memory": ("memory://NAME", r".+"),
}
_NETWORK: dict[str, Callable[[str, str, int], Link]] = {
    "udpin": UdpInLink,
    "udpout": UdpOutLink,
    "tcpin": TcpInLink,
    "tcpout": TcpOutLink,
}


def open_link(
    url: str,
    name: str,
    clock_us: Callable[[], int],
    recording: RecordingParameters | None = None,
) -> Link:
    """Make the link that a URL describes; its `run` opens it.

    Parameters
    ----------
    url : str
        ``serial:///dev/NAME:BAUD``, ``udpin://ADDRESS:PORT``, ``udpout://HOST:PORT``,
        ``tcpin://ADDRESS:PORT``, ``tcpout://HOST:PORT``, ``tlog:///PATH`` or ``memory://NAME``.
    name : str
        What the log calls it.
    clock_us : Callable
        Microseconds since 1970, for recordings.
    recording : RecordingParameters, optional
        The limits of one, if they are not the defaults.

    Raises
    ------
    LinkError
        The URL is none of these.
    """
    kind, _, rest = url.partition("://")
    if kind not in _FORMS:
        forms = ", ".join(form for form, _ in _FORMS.values())
        raise LinkError(f"{name}: {url!r} found, one of {forms} expected")
    form, pattern = _FORMS[kind]
    found = re.fullmatch(pattern, rest)
    if found is None:
        raise LinkError(f"{name}: {url!r} found, {form} expected")
    if kind == "tlog":
        return TlogLink(name, Path(rest), clock_us, limits=recording or RecordingParameters())
    if kind == "memory":
        return MemoryLink(name, rest)
    place, number = found[1], int(found[2])
    if kind == "serial":
        _check(name, url, "baud rate", number, range(1, 20_000_001))
        return SerialLink(name, place, number)
    # The system chooses a port where we listen on 0.
    _check(name, url, "port", number, range(kind.endswith("out"), 65536))
    return _NETWORK[kind](name, place.strip("[]"), number)


def _check(name: str, url: str, what: str, number: int, allowed: range) -> None:
    if number not in allowed:
        expected = f"{what} from {allowed[0]} to {allowed[-1]}"
        raise LinkError(f"{name}: {what} {number} found in {url!r}, a {expected} expected")
