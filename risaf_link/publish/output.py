"""What an output is that is not MAVLink: what the service calls it with, and when."""

from typing import Protocol

from risaf_link.core.estimate import Estimate
from risaf_link.mavlink.notices import Notice


class Output(Protocol):
    """Somewhere that estimates and notices go.

    `take` and `tell` are called between one epoch and the next, when the epoch's own frames have
    been handed out. They must not wait, and must cost next to nothing where nothing is due; what
    takes its time is done by `run`.

    Attributes
    ----------
    next_s : float
        From which time of an estimate, `elapsed`, on one is to be taken without delay. Those before
        it may come some epochs later, together.
    """

    next_s: float

    def take(self, estimate: Estimate, received_us: int, began_ns: int, done_ns: int) -> None:
        """Take the next estimate.

        Parameters
        ----------
        estimate : Estimate
        received_us : int
            When what made it possible came, microseconds since 1970.
        began_ns, done_ns : int
            The same instant on `time.perf_counter_ns`, and when its frames had been handed out.
        """

    def tell(self, notice: Notice, time_us: int, unix_us: int) -> None:
        """Take what the operator is told.

        Parameters
        ----------
        notice : Notice
        time_us, unix_us : int
            When: on the vehicle's boot clock, and microseconds since 1970.
        """

    async def run(self) -> None:
        """Do what takes its time, until cancelled."""
