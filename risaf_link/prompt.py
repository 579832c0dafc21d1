"""Epochs that are answered before account is taken of them.

Most epochs call for one thing: that their readings go through fusion and filter, and
ATTITUDE_QUATERNION is sent. That is done as they come. All else takes note of them: counts of links
and assembler, the guard over headings, notices, metrics. For many epochs together it costs a tenth
of what it costs one by one, so it waits for whatever comes or is due next, and for two beats at
most.

Then the same bytes go the way that all bytes go, through parser, assembler and `Pipeline.advance`,
as a block of epochs; only that fusion, filter and clock have what they come to already. So nothing
comes out otherwise than it would, nor later.

Asked for are the kernel, an epoch in datagrams of its own, and a link that is not signed.
"""

import math

import numpy as np

from risaf_link.core.track import attitude_and_rate
from risaf_link.mavlink.block import BlockReader
from risaf_link.mavlink.commands import Peer
from risaf_link.mavlink.component import Component
from risaf_link.mavlink.telemetry import Emitter
from risaf_link.mavlink.tlog import Stamps
from risaf_link.pipeline import Pipeline
from risaf_link.publish.outputs import Outputs

MOST = 32  # epochs that are answered before account of them is taken


class Prompt:
    """Answers epochs that call for no more than their attitude.

    Parameters
    ----------
    pipeline : Pipeline
    blocks : BlockReader
        Of the pipeline.
    component : Component
        Who listens, and to what.
    outputs : Outputs
        Likewise.

    Attributes
    ----------
    is_more_due : bool
        Whether the last epoch calls for more than was answered.
    """

    def __init__(
        self, pipeline: Pipeline, blocks: BlockReader, component: Component, outputs: Outputs
    ) -> None:
        self._pipeline, self._blocks = pipeline, blocks
        self._component, self._outputs = component, outputs
        self.is_more_due = False
        self._answered: list[tuple[list[bytes], int]] = []  # frames, and when they came
        self._left = 0  # epochs that may be answered yet
        self._peers: list[Peer] = []
        self._emitters: list[Emitter] = []
        self._last = 0, 0  # time of the last epoch, us, and its number
        self._elapsed = 0.0  # likewise, s, whatever the clocks did
        self._until_us = self._until_s = 0.0  # these times, from which on more is due

    def __bool__(self) -> bool:
        """Whether account of any is still to be taken."""
        return bool(self._answered)

    def answer(
        self, frames: list[bytes], received_us: int, peers: list[Peer]
    ) -> list[tuple[Peer, bytes]] | None:
        """Answer an epoch.

        Parameters
        ----------
        frames : list of bytes
            Each may be a frame of readings.
        received_us : int
            When they came, microseconds since 1970.
        peers : list of Peer
            Who can be reached now.

        Returns
        -------
        list of Peer and bytes, or None
            The frames that are due to each. None: these are not the frames of the next epoch, or it
            is better taken as a whole, and nothing has been done.
        """
        if not self._answered:
            self._prepare(peers)
        if not self._left or peers != self._peers:
            return None
        time_us, sequence = self._last
        epoch = self._blocks.next(b"".join(frames), time_us, sequence)
        if epoch is None:
            return None
        time_us, dt, readings = epoch
        elapsed = self._elapsed + dt
        self.is_more_due = time_us >= self._until_us or elapsed >= self._until_s
        if self.is_more_due and not self._answered:  # to take it all at once costs less
            return None
        ahead = self._pipeline.go_ahead(time_us, received_us, dt, readings)
        if ahead is None:
            return None
        self._component.note_ahead()
        self._answered.append((frames, received_us))
        self._left -= 1
        self._last, self._elapsed = (time_us, (sequence + 1) % 65536), elapsed
        boot_us, row = ahead
        told = boot_us, *attitude_and_rate(row)
        return [
            (peer, raw)
            for peer, emitter in zip(peers, self._emitters, strict=True)
            for raw in emitter.emit_attitude(time_us, *told)
        ]

    def take(self) -> tuple[bytes, Stamps]:
        """Give the frames of all that were answered, and when each came, to take account of."""
        answered, self._answered = self._answered, []
        times_us = [us for frames, us in answered for _ in frames]
        return b"".join(raw for frames, _ in answered for raw in frames), np.array(times_us, "u8")

    def _prepare(self, peers: list[Peer]) -> None:
        """See what the next epochs may call for."""
        last = self._blocks.last
        self._left = 0
        if last is None or not self._pipeline.may_go_ahead:
            return
        self._left = min(self._pipeline.assembler.until_review, MOST)
        self._last, self._elapsed = last, self._pipeline.elapsed
        self._peers, self._emitters = peers, self._component.emitters(peers)
        self._until_us = min((each.until_us for each in self._emitters), default=math.inf)
        self._until_s = self._outputs.next_s
