"""How far a sender's clock is ahead of the arrival times, and how fast that changes.

A frame that tells a time and was d on its way tells the lead less d. No d is negative: what is told
lies below the lead, which follows a line while both clocks run evenly. Estimated is the line that
lies above all that was told in the last minutes, and of those the lowest at their mean time [1]_:
an edge of their convex hull [2]_. It goes through one point of the first third and one of the last,
for an edge between two that are close to each other tells little of the slope. Of each spell of
some seconds only the frame that was least delayed is kept; what has come since may lift the line.

One way, the shortest delay is not seen. An answer to a request tells the lead from above, too: it
cannot have been given before it was asked for. The truth is between, in the middle for want of
better; the halves of one round trip do not have to be short at the same time [3]_.

References
----------
.. [1] S. B. Moon, P. Skelly, D. Towsley: Estimation and Removal of Clock Skew from Network Delay
   Measurements, IEEE INFOCOM 1999.
.. [2] L. Zhang, Z. Liu, C. H. Xia: Clock Synchronization Algorithms for Network Measurements, IEEE
   INFOCOM 2002.
.. [3] A. Duda, G. Harrus, Y. Haddad, G. Bernard: Estimating Global Time in Distributed Systems,
   ICDCS 1987.
"""

from collections import deque

import numpy as np
from numpy.typing import NDArray

from risaf_link.core.rotation import Floats

SPELL_US = 3_000_000  # of which the least delayed frame is kept
WINDOW_US = 60 * SPELL_US  # long against delays, short against changes of temperature
SKEW_SPAN_US = 10_000_000  # from which a skew can be told: a millisecond in it is 100 ppm
LARGEST_SKEW = 1e-3  # of clocks that are in order; a steeper line is one of delays
SETTLED = 5  # spells, from which on it is known how far below the line times are told
JUMP_US = 10_000  # off the line by more than that, and this, is out of the way
GROSS_US = 500_000  # likewise before
MOST_ANSWERS = 256  # one a second is asked for

Times = NDArray[np.int64]


class Lead:
    """A sender's clock, as the times in its frames and their arrivals tell it.

    Attributes
    ----------
    skew : float
        Seconds that the clock gains on the arrival times in a second.
    """

    def __init__(self) -> None:
        self.skew = 0.0
        self._at_us = self._base_us = 0  # a point of the line
        self._usual_us = GROSS_US  # off the line by more is out of the way
        self._best: deque[tuple[int, int]] = deque()  # of each spell: arrival, lead
        self._since_us: int | None = None  # when the present spell began
        self._present: tuple[int, int] | None = None  # its best
        self._above_us = 0  # how far that lies above the line
        self._answers: deque[tuple[int, int]] = deque(maxlen=MOST_ANSWERS)  # asked, lead from above
        self._back_us = 0  # what the shortest way takes, as far as answers tell

    @property
    def is_known(self) -> bool:
        """Whether a time has been told."""
        return self._since_us is not None

    def at(self, received_us: int) -> int:
        """How far the clock is ahead at an arrival time, microseconds."""
        return self._line(received_us) + max(0, self._above_us) + self._back_us

    def at_each(self, received_us: Times) -> Times:
        """How far it is ahead at arrival times, (k,), as `at` says it."""
        return self._lines(received_us) + max(0, self._above_us) + self._back_us

    def off(self, time_us: int, received_us: int) -> int:
        """How far a time is off the line, if that is out of the way; above 0: early; 0: it is not.

        Early is what no delay explains; late may be a frame that was held up.
        """
        if self._since_us is None:
            return 0
        off_us = time_us - received_us - self._line(received_us) - max(0, self._above_us)
        return off_us if abs(off_us) > self._usual_us else 0

    def note(self, time_us: int, received_us: int) -> None:
        """Take a time and its arrival."""
        if self._since_us is None:
            self._at_us, self._base_us = received_us, time_us - received_us
            self._since_us = received_us
        elif not 0 <= received_us - self._since_us < SPELL_US:
            self._end_spell(received_us)
        lead_us = time_us - received_us
        above_us = lead_us - self._line(received_us)
        if self._present is None or above_us > self._above_us:
            self._present, self._above_us = (received_us, lead_us), above_us

    def note_answer(self, time_us: int, sent_us: int, received_us: int) -> None:
        """Take a time that was told between a request and the arrival of its answer."""
        self.note(time_us, received_us)
        self._answers.append((sent_us, time_us - sent_us))
        while received_us - self._answers[0][0] > WINDOW_US:
            self._answers.popleft()
        gap_us = min(lead_us - self._line(asked_us) for asked_us, lead_us in self._answers)
        self._back_us = max(0, gap_us - max(0, self._above_us)) // 2

    def note_each(self, time_us: Times, received_us: Times) -> Times:
        """Take times, (k,), up to the first that is out of the way or begins a spell.

        Returns
        -------
        array
            The lead at each that was taken, as `at` says it then.
        """
        if self._since_us is None or self._present is None:
            return received_us[:0]
        lines_us = self._lines(received_us)
        leads_us = time_us - received_us
        above_us = leads_us - lines_us
        lift_us = max(0, self._above_us)
        passed_us = received_us - self._since_us
        within = (passed_us >= 0) & (passed_us < SPELL_US)
        highest_us = np.maximum.accumulate(np.maximum(above_us, lift_us))
        lowest_us = min(lift_us, int(above_us.min()))
        if highest_us[-1] - lowest_us > self._usual_us:  # else none is out of the way
            before_us = np.concatenate(([lift_us], highest_us[:-1]))
            within &= np.abs(above_us - before_us) <= self._usual_us
        count = len(within) if within.all() else int(within.argmin())
        if count and (most_us := int(above_us[:count].max())) > self._above_us:
            i = int(above_us[:count].argmax())
            self._present, self._above_us = (int(received_us[i]), int(leads_us[i])), most_us
        return (lines_us + highest_us + self._back_us)[:count]

    def shift(self, by_us: int) -> None:
        """Follow arrival times that were set back by so much."""
        for known in (self._best, self._answers):
            moved = [(time_us - by_us, lead_us + by_us) for time_us, lead_us in known]
            known.clear()
            known.extend(moved)
        if self._since_us is not None and self._present is not None:
            self._since_us -= by_us
            self._present = self._present[0] - by_us, self._present[1] + by_us
        self._at_us -= by_us
        self._base_us += by_us

    def _line(self, received_us: int) -> int:
        return self._base_us + round(self.skew * (received_us - self._at_us))

    def _lines(self, received_us: Times) -> Times:
        drift: Times = np.rint(self.skew * (received_us - self._at_us)).astype(np.int64)
        return self._base_us + drift

    def _end_spell(self, received_us: int) -> None:
        """Keep the best of a spell, and draw the line anew."""
        if self._present is not None:
            self._best.append(self._present)
        while len(self._best) > 1 and not 0 <= received_us - self._best[0][0] <= WINDOW_US:
            self._best.popleft()
        self._since_us, self._present, self._above_us = received_us, None, 0
        best = np.array(self._best)
        self._at_us, self._base_us = int(best[-1, 0]), int(best[-1, 1])
        times, leads = (best - best[-1]).T.astype(float)
        self.skew = _skew(times, leads)
        above = leads - self.skew * times
        self._base_us += round(above.max())
        if len(best) >= SETTLED:
            self._usual_us = JUMP_US + round(np.ptp(above))


def _skew(times: Floats, leads: Floats) -> float:
    """Slope of the lowest line above points, (k,) each; 0 where none can be told.

    Through one point of the first third and one of the last, the line that is highest between.
    """
    span = float(times[-1] - times[0])
    if span < SKEW_SPAN_US:
        return 0.0
    mean = times.mean()
    before, after = times < times[0] + span / 3, times > times[-1] - span / 3
    time, lead = times[before][:, None], leads[before][:, None]
    slopes = (leads[after] - lead) / (times[after] - time)
    slope = float(slopes.flat[(lead + slopes * (mean - time)).argmax()])
    return slope if abs(slope) <= LARGEST_SKEW else 0.0
