"""What a supervisor such as systemd is told: that the service is ready, alive, and how it is.

One datagram a notice, to the socket that the environment names: sd_notify(3) and
sd_watchdog_enabled(3). Nobody is waited for: a supervisor that does not read loses notices.
"""

import os
import socket
from collections.abc import Callable, Mapping

TELL_S = 1.0  # from one status to the next
SHARE = 4  # notices in the time after which the supervisor gives up


class Supervisor:
    """Tells the supervisor, where there is one.

    Parameters
    ----------
    environment : mapping
        NOTIFY_SOCKET, a path or, after @, an abstract name; WATCHDOG_USEC, and WATCHDOG_PID whom it
        is meant for.
    pid : int
        Of this process.
    """

    def __init__(self, environment: Mapping[str, str], pid: int) -> None:
        name = environment.get("NOTIFY_SOCKET", "")
        self._address = f"\0{name[1:]}" if name.startswith("@") else name
        self._socket: socket.socket | None = None
        self._next_s = self._next_status_s = 0.0
        self._status = ""
        self._is_ready = False
        self._patience_s = _patience(environment, pid)
        if name.startswith(("/", "@")):
            kind = socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK
            self._socket = socket.socket(socket.AF_UNIX, kind)

    def tell(self, now_s: float, status: Callable[[], str], is_alive: bool) -> None:
        """Tell what is due at a time in seconds that does not jump; the first time, to be ready.

        Parameters
        ----------
        now_s : float
        status : callable
            Says how the service is, in one line.
        is_alive : bool
            Whether the estimator makes progress, or has nothing to make it with. If not for
            WATCHDOG_USEC, the supervisor starts the service anew.
        """
        if self._socket is None:
            return
        lines = []
        if not self._is_ready:
            self._is_ready = True
            lines.append("READY=1")
        if self._patience_s and is_alive and now_s >= self._next_s:
            self._next_s = now_s + self._patience_s / SHARE
            lines.append("WATCHDOG=1")
        if now_s >= self._next_status_s:
            self._next_status_s = now_s + TELL_S
            before, self._status = self._status, status()
            lines += [f"STATUS={self._status}"] if self._status != before else []
        self._send(lines)

    def end(self) -> None:
        """Tell that the service ends, and leave."""
        self._send(["STOPPING=1"])
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, lines: list[str]) -> None:
        if self._socket is None or not lines:
            return
        try:
            self._socket.sendto("\n".join(lines).encode(), self._address)
        except OSError:  # nobody is there, or nobody reads: nothing of ours depends on it
            return


def _patience(environment: Mapping[str, str], pid: int) -> float:
    """Seconds after which the supervisor gives up; 0: it does not watch this process."""
    told, whom = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", "")
    if not told.isdecimal() or (whom and whom != str(pid)):
        return 0.0
    return int(told) / 1e6


def of_this_process() -> Supervisor:
    """That of this process."""
    return Supervisor(os.environ, os.getpid())
