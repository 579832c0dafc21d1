"""A process that ends with the one that started it, however that ends."""

import ctypes
import os
import signal

PR_SET_PDEATHSIG = 1  # of linux/prctl.h

_libc = ctypes.CDLL(None, use_errno=True)


def end_with(parent: int) -> None:
    """Have this process asked to end when its parent has ended; it holds for what it executes.

    Parameters
    ----------
    parent : int
        Its process id. If that has ended by now, so does this.
    """
    if _libc.prctl(PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0):
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    if os.getppid() != parent:
        os._exit(1)
