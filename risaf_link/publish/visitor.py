"""Whether a browser came for our page, or was sent by another's.

A site can let its own name mean an address that only its visitors reach, 127.0.0.1 or one of their
network, and then read what is served there as if it were its own. It cannot do that with an
address, nor with a name that a network gives out by itself: a page is asked for by one of these, or
refused.
"""

import ipaddress
import re
import socket

LOOPBACK = frozenset({"localhost", "127.0.0.1", "::1"})

_HOST = re.compile(r"(\[[^\]]*\]|[^:\[\]]*)(?::[0-9]{1,5})?")


def is_loopback(host: str) -> bool:
    """Whether it is an address that only this machine reaches."""
    return host.strip("[]") in LOOPBACK


def may_ask(asked: str, host: str) -> bool:
    """Whether what stands in a request's Host header names us.

    Parameters
    ----------
    asked : str
        HOST or HOST:PORT; empty: there was none, so it was no browser.
    host : str
        Where we listen. If others reach us there, we may be known by a name: the one that we listen
        at, this machine's, one of the link, NAME.local, or one without a dot.
    """
    found = _HOST.fullmatch(asked.lower())
    if found is None:
        return False
    name = found[1].strip("[]")
    if not name or name in LOOPBACK or _is_address(name):
        return True
    if is_loopback(host):
        return False
    known = {host.lower(), socket.gethostname().lower()}
    return name in known or name.endswith(".local") or "." not in name


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
