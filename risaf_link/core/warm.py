"""A start that goes on from what was known before a restart, as far as it still holds.

Nothing is believed at once. For the first half second the estimator runs as one that knows nothing,
and says so; what comes in is kept. Then what is remembered is held against it, and what stands goes
through once more with what was kept: no estimate ever rests on a memory that has failed.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from risaf_link.core.attitude import AttitudeParameters, Innovation
from risaf_link.core.estimator import Estimator
from risaf_link.core.fusion import EpochBlock, FusionParameters
from risaf_link.core.heading import HeadingParameters, Motion
from risaf_link.core.interruption import Interruption
from risaf_link.core.memory import ArrayIdentity, FilterMemory, Memory
from risaf_link.core.rotation import Floats
from risaf_link.core.track import RESETS, Track

TRIAL = 0.5  # s, in which what is remembered is held against what comes
FEWEST = 5  # epochs that it takes
MOST = 4000  # epochs that are kept: half a second at 8 kHz, if their clock moves at all
PATIENCE = 5.0  # s for which an array may be incomplete at first
UNITS = (("s", 1.0), ("min", 60.0), ("h", 3600.0), ("days", 86400.0))

Event = EpochBlock | tuple[Motion, float]
Parameters = tuple[FusionParameters, AttitudeParameters, HeadingParameters]


@dataclass(frozen=True, slots=True)
class Verdict:
    """What came of a memory."""

    text: str  # in one line, for the operator
    estimator: Estimator | None = None  # that goes on from it, as of now; None: it was of no use


class Trial:
    """The first half second after a start.

    Parameters
    ----------
    memory : Memory
    """

    def __init__(self, memory: Memory) -> None:
        self.memory = memory
        self._waited = 0.0  # s
        self._begin()

    def _begin(self) -> None:
        self._events: list[Event] = []
        self._began: float | None = None  # s, time of the estimator before the first epoch
        self._seconds = 0.0
        self._epochs = 0

    @property
    def is_over(self) -> bool:
        """Whether it is time to `judge`."""
        return self._is_complete or self._waited >= PATIENCE or self._epochs >= MOST

    @property
    def _is_complete(self) -> bool:
        return self._seconds >= TRIAL and self._epochs >= FEWEST

    def share(self, dt: Floats) -> int:
        """How many of these epochs, (k,) s each since the one before, belong to the trial."""
        count = np.arange(1, len(dt) + 1)
        complete = (np.cumsum(dt) + self._seconds >= TRIAL) & (count + self._epochs >= FEWEST)
        return int(complete.argmax()) + 1 if complete.any() else len(dt)

    def note_epochs(self, epochs: EpochBlock, began: float) -> None:
        """Take note of epochs, calibrated, before which an estimator's time was `began`, s."""
        self._waited += float(epochs.dt.sum())
        if epochs.rates_b.shape[1] != len(self.memory.gyros):
            self._begin()
            return
        if self._began is None:
            self._began = began
        self._events.append(epochs)
        self._seconds += float(epochs.dt.sum())
        self._epochs += len(epochs)

    def note_fix(self, motion: Motion, latitude: float) -> None:
        """Take note of what a fix said; latitude in rad."""
        if self._began is not None and len(self._events) < 2 * MOST:
            self._events.append((motion, latitude))

    def judge(self, parameters: Parameters, resets: int) -> Verdict:
        """Hold the memory against the trial.

        Parameters
        ----------
        parameters : tuple
            Of the estimator.
        resets : int
            How often yaw has been set during the trial.
        """
        fusion, attitude, heading = parameters
        if fusion.method != "robust" or attitude.filter != "eskf":
            return Verdict("state ignored: it is of another fusion or filter")
        if self._began is None or not self._is_complete:
            return Verdict(f"state ignored: no {TRIAL:g} s of {len(self.memory.gyros)} sensors")
        epochs = [event for event in self._events if isinstance(event, EpochBlock)]
        motions = [event[0] for event in self._events if not isinstance(event, EpochBlock)]
        interruption = Interruption(self.memory, epochs, motions)
        refusal = interruption.refusal()
        if refusal:
            return Verdict(f"state ignored: {refusal}")
        known = interruption.attitude(fusion, attitude, heading)
        aligned = known is not None and known.aligned
        warm = Estimator(*parameters)
        warm.elapsed = self._began
        warm.recall(
            self.memory.gyros.older(interruption.changed(fusion), interruption.dt),
            self.memory.accelerometers if aligned else None,
            known,
            resets + 1 if aligned else 0,
            interruption.steps(attitude) if aligned else (),
        )
        for _, alike in groupby(self._events, _kind):
            _pass(warm, list(alike))
        return Verdict(_told(known, interruption.age), warm)


class WarmStart:
    """An estimator that goes on from a memory when that has stood its trial.

    Parameters
    ----------
    estimator : Estimator
        One that knows nothing.
    memory : Memory or None
    identify : callable
        Says which array sends, from the number of its gyros.

    Attributes
    ----------
    estimator : Estimator
        Whose estimates hold now.
    outcome : str
        What came of the memory, in one line; empty: there is none, or it is not known yet.
    """

    def __init__(
        self,
        estimator: Estimator,
        memory: Memory | None,
        identify: Callable[[int], ArrayIdentity],
    ) -> None:
        self.estimator = estimator
        self.outcome = ""
        self._trial = Trial(memory) if memory else None
        self._identify = identify

    @property
    def is_on_trial(self) -> bool:
        """Whether it is not known yet what becomes of the memory."""
        return self._trial is not None

    def give_up(self, why: str) -> None:
        """End the trial, if there is one."""
        if self._trial:
            self._trial, self.outcome = None, f"state ignored: {why}"

    def advance(self, epochs: EpochBlock) -> list[tuple[EpochBlock, Track, Floats]]:
        """Carry the estimate on, as `Estimator.advance` does; the trial ends between two parts."""
        trial = self._trial
        if trial is None:
            return [(epochs, *self.estimator.advance(epochs.dt, epochs.rates_b, epochs.forces_b))]
        share = trial.share(epochs.dt)
        part, rest = epochs, None
        if share < len(epochs):
            part, rest = epochs.part(slice(share)), epochs.part(slice(share, None))
        trial.note_epochs(part, self.estimator.elapsed)
        track, elapsed = self.estimator.advance(part.dt, part.rates_b, part.forces_b)
        if trial.is_over:
            self._judge(trial, int(track.values[-1, RESETS]))
        done = [(part, track, elapsed)]
        return done if rest is None else done + self.advance(rest)

    def correct(self, motion: Motion, latitude: float) -> Innovation | None:
        """Use what a fix says, as `Estimator.correct` does."""
        if self._trial:
            self._trial.note_fix(motion, latitude)
        return self.estimator.correct(motion, latitude)

    def _judge(self, trial: Trial, resets: int) -> None:
        known = trial.memory.array
        difference = known.difference(self._identify(known.sensors))
        if difference:
            self.give_up(difference)
            return
        verdict = trial.judge(self.estimator.parameters, resets)
        self._trial, self.outcome = None, verdict.text
        self.estimator = verdict.estimator or self.estimator


def _kind(event: Event) -> tuple[int, ...]:
    """What events have in common that an estimator can take at once."""
    return (
        (*event.rates_b.shape[1:], *event.forces_b.shape[1:])
        if isinstance(event, EpochBlock)
        else ()
    )


def _pass(estimator: Estimator, events: list[Event]) -> None:
    """Let events of one kind come to an estimator."""
    blocks = [event for event in events if isinstance(event, EpochBlock)]
    if blocks:
        columns = zip(*((each.dt, each.rates_b, each.forces_b) for each in blocks), strict=True)
        estimator.advance(*map(np.concatenate, columns))
        return
    for event in events:
        if not isinstance(event, EpochBlock):
            estimator.correct(*event)


def _told(known: FilterMemory | None, age: float) -> str:
    what = "sensors' biases" if known is None else "biases" if not known.aligned else "heading"
    unit, seconds = next(each for each in UNITS if age < 100 * each[1] or each is UNITS[-1])
    return f"warm start: {what} of {age / seconds:.0f} {unit} ago"
