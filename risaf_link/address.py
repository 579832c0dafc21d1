"""Where something listens, or where it is found: HOST:PORT."""

import re

_LABEL = r"[A-Za-z0-9_-]{1,63}"
HOST = rf"{_LABEL}(?:\.{_LABEL})*|\[[0-9A-Fa-f:.]+(?:%\w+)?\]"
"""A pattern: a name, an IPv4 address, or an IPv6 address in brackets."""

_ADDRESS = re.compile(rf"({HOST}):([0-9]{{1,5}})")


def address_in(text: str) -> tuple[str, int] | None:
    """Host, without brackets, and port of HOST:PORT; None: it is nothing of the kind."""
    found = _ADDRESS.fullmatch(text)
    if found is None or int(found[2]) > 65535:
        return None
    return found[1].strip("[]"), int(found[2])


def shown(host: str, port: int) -> str:
    """HOST:PORT, as URLs have it."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
