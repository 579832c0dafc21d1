"""How much is measured."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Extent:
    """Sizes and repeats; the figures mean the same whatever they are, but for what start costs."""

    repeats: int = 7  # of what takes less than a second
    runs: int = 3  # of what takes longer, such as processes
    epoch_s: float = 20.0  # of readings at 100 Hz that a fusion is given
    slow_share: float = 0.1  # of them, that the NumPy form is given
    replay_s: float = 300.0  # of the log that is replayed
    rival_s: float = 10.0  # of it, that the reference is given
    mixed_frames: int = 1_000_000
    rival_frames: int = 30_000  # of them, that recv_match is given
    live_s: float = 20.0  # at 100 Hz
    fast_s: float = 20.0  # at 1 kHz
    fast_rate: float = 1000.0  # Hz


FULL = Extent()
QUICK = Extent(
    repeats=3,
    runs=1,
    epoch_s=5.0,
    slow_share=0.1,
    replay_s=60.0,
    rival_s=3.0,
    mixed_frames=200_000,
    rival_frames=10_000,
    live_s=5.0,
    fast_s=5.0,
)
