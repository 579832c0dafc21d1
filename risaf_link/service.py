"""The daemon: links on one side, the pipeline on the other, and nothing between that waits."""

import asyncio
import logging
import time
from collections import Counter
from collections.abc import Callable, Coroutine
from functools import partial
from typing import Any

from risaf_link.config import Config, identity_of, load_calibration
from risaf_link.core.estimate import EstimateBlock
from risaf_link.core.fusion import EpochBlock
from risaf_link.core.kernel import BUILT
from risaf_link.core.memory import Memory
from risaf_link.gate import Gate
from risaf_link.gibberish import Gibberish
from risaf_link.kept import NOTHING_KEPT, KeptParameters
from risaf_link.keys import open_keys
from risaf_link.links import Link, TlogLink, Worth, open_link
from risaf_link.loop import unix_us
from risaf_link.mavlink.allowance import remember
from risaf_link.mavlink.block import BlockReader
from risaf_link.mavlink.commands import Peer
from risaf_link.mavlink.component import HEARD, Component
from risaf_link.mavlink.frame import FrameParser, FrameTable
from risaf_link.mavlink.held import Held
from risaf_link.mavlink.notices import Notice, Severity
from risaf_link.mavlink.parameters import Parameters
from risaf_link.mavlink.peers import Terms
from risaf_link.mavlink.requests import Requests
from risaf_link.mavlink.signing import SETUP_SIGNING
from risaf_link.pipeline import Pipeline
from risaf_link.prompt import Prompt
from risaf_link.publish.account import Account, Traffic
from risaf_link.publish.outputs import open_outputs
from risaf_link.remembered import MemoryKeeper, memory_file
from risaf_link.supervisor import Supervisor

TICK_S = 0.1  # from one look at what is due by time to the next
OPENING = 20  # looks at whether the links are open, in the first TICK_S
MOST_PEERS = 256  # of all links together
PARAM_VALUE_BYTES = 37  # of a PARAM_VALUE frame
PARAMETERS_SHARE = 0.4  # of a link, that a list of parameters takes at most
STALLED_S = 1.0  # later than due: others have had the processor, or the machine was halted

_log = logging.getLogger(__name__)


class Service:
    """Runs the pipeline on live links.

    What a link receives goes through the pipeline at once, in the link's own callback; the frames
    that come of it are handed to all links before it returns.

    Parameters
    ----------
    config : Config
    kept : KeptParameters
        What was set over MAVLink before, and where it is kept.
    clock_us : callable
        Microseconds since 1970.
    supervisor : Supervisor or None
        Who is told how the service is.

    Raises
    ------
    ConfigError
        If the calibration or a signing key cannot be used.
    """

    def __init__(
        self,
        config: Config,
        kept: KeptParameters = NOTHING_KEPT,
        clock_us: Callable[[], int] = unix_us,
        supervisor: Supervisor | None = None,
    ) -> None:
        self._supervisor = supervisor or Supervisor({}, 0)
        parameters = Parameters(config, kept.values, kept.overruled, config.unsettable)
        file = memory_file(config)
        memory = file.read()
        if memory:
            file.keep_used()
        calibration = load_calibration(config)
        self.pipeline = Pipeline(parameters.tuned, config.own, calibration, memory)
        self._keeper = MemoryKeeper(file, config.state.period, self._memory)
        self.links = [
            open_link(link.url, link.name, clock_us, link.recording) for link in config.links
        ]
        self._clock_us = clock_us
        self._kept = kept
        self._storing: set[asyncio.Task[None]] = set()
        self._keys = open_keys(config)
        self._gate = Gate(self._keys, lambda: self.pipeline.ingest.own)
        self._component = Component(
            parameters,
            self.pipeline,
            identity_of(config),
            links={
                link.name: Terms(link.emit, _pace(made), self._keys.links.get(link.name))
                for link, made in zip(config.links, self.links, strict=True)
            },
            keep=self._keep if kept.path else None,
            requests=Requests(
                {link.name: link.request for link in config.links},
                config.array.encodings,
                config.gps.messages,
                {link.name: link.bytes_per_s for link in self.links},
            ),
            listen=self._tell,
        )
        self._by_name = {link.name: link for link in self.links}
        self._recordings = [link for link in self.links if isinstance(link, TlogLink)]
        self._parsers: dict[tuple[str, str], FrameParser] = {}
        self._blocks = BlockReader(self.pipeline.ingest, self.pipeline.assembler, apart=HEARD)
        self._outputs = open_outputs(config.mqtt, config.metrics, self.account)
        self._prompt = Prompt(self.pipeline, self._blocks, self._component, self._outputs)
        self._held = Held()
        self._gibberish = Gibberish()
        self._holding: Peer = ("", "")  # whose datagrams wait
        self._has_accounted = False  # since the last beat
        self._frames = 0
        self._received_us = 0
        self._began_ns = 0  # when that was, on the clock of latencies
        self._spans_ns: list[tuple[int, int]] = []  # from when to when epochs were answered
        self._frames_in: Counter[str] = Counter()  # by link
        self._frames_out: Counter[str] = Counter()
        self._dropped: Counter[str] = Counter()  # from peers that are forgotten
        self._mismatch = self._recalled = ""

    @property
    def dropped(self) -> Counter[str]:
        """Frames that were lost in parsing, by reason."""
        return sum((parser.dropped for parser in self._parsers.values()), Counter(self._dropped))

    @property
    def rejected(self) -> Counter[str]:
        """Frames that were not taken for their signatures, by link and reason."""
        return self._keys.rejected

    async def run(self) -> None:
        """Run until cancelled.

        Raises
        ------
        ConfigError
            If the state of a signing key cannot be stored.
        """
        self._keys.advance(self._clock_us())
        self._keys.open()
        kernel = "kernel" if BUILT else "no kernel: NumPy alone"
        loop = type(asyncio.get_running_loop()).__module__.partition(".")[0]
        names = ", ".join(link.name for link in self.links) or "no links"
        _log.info("started: %s (%s, %s)", names, kernel, loop)
        try:
            async with asyncio.TaskGroup() as tasks:
                # A recorder is there before anything can be received.
                for link in sorted(self.links, key=lambda link: link not in self._recordings):
                    tasks.create_task(link.run(partial(self._receive, link)))
                tasks.create_task(self._outputs.run())
                try:
                    await self._beat()
                finally:  # the links are still open
                    self._supervisor.end()
                    self._take_held()
                    self._send(self.pipeline.flush(self._received_us))
                    self._keeper.end()
        finally:
            self._supervisor.end()
            self._keys.close()
            counts = self.pipeline.assembler.counts
            _log.info("ended: %d frames, %d epochs", self._frames, counts["epochs"])

    def _receive(self, link: Link, data: bytes, peer: str) -> Worth:
        """Take what came over a link, and send what comes of it; tell what it was worth."""
        sender = link.name, peer
        if sender != self._holding:
            self._take_held()
            self._holding = sender
        if self._held.holds(data):
            return Worth.UNKNOWN
        self._note_arrival()
        if self._held.is_whole and self._answer([*self._held.parts, data], sender):
            self._held.take()
            return Worth.SAMPLES
        self._take_account()
        worth = self._take(self._held.take(data), sender)
        self._held.note_end(self._blocks.is_steady)
        return worth

    def _answer(self, frames: list[bytes], sender: Peer) -> bool:
        """Answer an epoch before account is taken of it, if that can be."""
        if sender[0] in self._keys.links:  # each frame is looked at by itself
            return False
        if not self._prompt and not self._parser(*sender).is_between_frames:
            return False
        answers = self._prompt.answer(frames, self._received_us, self._peers())
        if answers is None:
            return False
        self._record(frames, self._received_us)
        self._hand_out(answers)
        self._spans_ns.append((self._began_ns, time.perf_counter_ns()))
        if self._prompt.is_more_due:
            self._take_account()
        return True

    def _take_account(self) -> None:
        """Take account of the epochs that were answered, if any were."""
        self._has_accounted = True
        if not self._prompt:
            return
        frames, times_us = self._prompt.take()
        table = self._parser(*self._holding).receive_table(frames)
        self._gibberish.note(self._holding[0], len(table))
        self._note(table, self._holding)
        for item in self._blocks.read(table, times_us):
            if not isinstance(item, EpochBlock):
                raise TypeError("block: found a frame, expected the epochs that were answered")
            self._catch_up(self.pipeline.advance(item))

    def _take_held(self) -> None:
        """Take what waits, if anything does."""
        self._take_account()
        if self._held:
            self._note_arrival()
            self._take(self._held.take(), self._holding)

    def _note_arrival(self) -> None:
        """Take note that what is taken next has come now."""
        self._began_ns = time.perf_counter_ns()
        self._received_us = self._clock_us() & ~3  # as a recording keeps it

    def _take(self, data: bytes, sender: Peer) -> Worth:
        before_us, received_us = self.pipeline.ingest.heard_us, self._received_us
        self._keys.advance(received_us)
        cut = self._parser(*sender).receive_table(data)
        self._gibberish.note(sender[0], len(cut))
        table = self._gate.admitted(cut, sender, received_us)
        if not len(table):  # garbage costs no more than that
            return Worth.NOTHING
        if self._recordings:
            self._record(table.raw(but=SETUP_SIGNING), received_us)
        self._note(table, sender)
        are_answers_due = False
        for item in self._blocks.read(table, received_us, longest=1):
            if isinstance(item, EpochBlock):
                self._send(self.pipeline.advance(item))
            else:
                frame, _ = item
                are_answers_due = True
                self._component.receive(frame, sender, received_us)
                self._send(self.pipeline.gather(frame, received_us))
                self._send(self.pipeline.release())
        if are_answers_due:
            self._hand_out(self._component.collect([*self._peers(), sender]))
        if self.pipeline.ingest.heard_us != before_us:
            return Worth.SAMPLES
        return self._gate.worth(table, sender[0])

    def _note(self, table: FrameTable, sender: Peer) -> None:
        """Take note of frames that were taken."""
        self._frames += len(table)
        self._frames_in[sender[0]] += len(table)
        self._component.note_traffic(table, sender)

    def _record(self, frames: list[bytes], received_us: int) -> None:
        for recording in self._recordings:
            recording.record(received_us, *frames)

    def _send(self, blocks: list[EstimateBlock]) -> None:
        """Take what came of epochs, and send what is due."""
        for block in blocks:
            peers = self._peers()
            for i, received_us in enumerate(block.received_us.tolist()):
                estimate = block.at(i)
                self._component.observe(estimate)
                self._hand_out(self._component.emit(estimate, peers))
                self._outputs.take(estimate, received_us, self._began_ns, time.perf_counter_ns())

    def _catch_up(self, blocks: list[EstimateBlock]) -> None:
        """Take what came of the epochs that were answered, and send what the last calls for."""
        spans_ns, self._spans_ns = self._spans_ns, []
        for block in blocks:
            for i, (received_us, span_ns) in enumerate(
                zip(block.received_us.tolist(), spans_ns, strict=True)
            ):
                estimate = block.at(i)
                self._component.observe(estimate)
                if i == len(block) - 1 and self._prompt.is_more_due:
                    self._hand_out(self._component.emit(estimate, self._peers()))
                self._outputs.take(estimate, received_us, *span_ns)

    def _peers(self) -> list[Peer]:
        return [(link.name, peer) for link in self.links for peer in link.peers]

    def _hand_out(self, frames: list[tuple[Peer, bytes]]) -> None:
        for (link, peer), raw in frames:
            self._by_name[link].send_to(raw, peer)
            self._frames_out[link] += 1

    def _memory(self) -> Memory | None:
        self._take_account()
        return self.pipeline.memory()

    def _keep(self, parameters: dict[str, float]) -> None:
        """Store parameters without waiting: a memory card can take longer than an epoch."""

        async def store() -> None:
            failure = await asyncio.to_thread(self._kept.write, parameters)
            self._component.kept(parameters, failure)
            self._hand_out(self._component.collect(self._peers()))

        self._begin(store())

    def _begin(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(work)
        self._storing.add(task)
        task.add_done_callback(self._storing.discard)

    def _look_after_state(self, now_s: float) -> None:
        """Store what is known, when it is due and has changed, without waiting for it."""
        memory = self._keeper.due(now_s)
        if memory:
            self._begin(self._keeper.store(memory))

    def _look_after_keys(self, now_s: float) -> None:
        """Set their clocks, store what is due, and tell of rejected frames."""
        self._keys.advance(self._clock_us())
        if self._keys.is_due(now_s):
            self._begin(self._keys.store())
        self._keys.tell_rejected(now_s)

    def _parser(self, link: str, peer: str) -> FrameParser:
        parser = self._parsers.get((link, peer)) or FrameParser()
        forgotten = remember(self._parsers, (link, peer), parser, MOST_PEERS)
        if forgotten:
            self._dropped += forgotten.dropped
        return parser

    def account(self) -> Account:
        """What has come and gone, as of now."""
        self._take_account()
        return Account(
            dropped=self.dropped,
            rejected=self.rejected,
            assembly=self.pipeline.assembler.counts,
            unused=self.pipeline.ingest.counts + self._gate.refused,
            links=[
                Traffic(
                    link.name,
                    *(link.counts.bytes_in, link.counts.bytes_out),
                    *(self._frames_in[link.name], self._frames_out[link.name]),
                    *(link.counts.dropped_out, link.counts.connections, len(link.peers)),
                    link.counts.dropped_in,
                )
                for link in self.links
            ],
        )

    def _tell(self, notice: Notice) -> None:
        """Let outputs know what the operator is told."""
        unix_us = self._clock_us()
        self._outputs.tell(notice, self.pipeline.now_us(unix_us), unix_us)

    def _tell_mismatch(self) -> None:
        if self.pipeline.mismatch != self._mismatch:
            self._mismatch = self._component.trouble = self.pipeline.mismatch
            if self._mismatch:
                _log.error("no estimates: array.calibration: %s", self._mismatch)

    def _tell_recalled(self) -> None:
        """Tell what came of the memory, once."""
        if self.pipeline.recalled == self._recalled:
            return
        self._recalled = self.pipeline.recalled
        ignored = "ignored" in self._recalled
        _log.log(logging.WARNING if ignored else logging.INFO, "%s", self._recalled)
        severity = Severity.WARNING if ignored else Severity.INFO
        self._component.tell(Notice(severity, self._recalled))

    def _tell_gibberish(self, now_s: float) -> None:
        """Tell which links bring bytes and no MAVLink."""
        bytes_in = {link.name: link.counts.bytes_in for link in self.links}
        for notice in self._gibberish.look(bytes_in, now_s):
            level = logging.WARNING if notice.severity < Severity.INFO else logging.INFO
            _log.log(level, "%s", notice.text)
            self._component.tell(notice)

    async def _beat(self) -> None:
        """Do what is due by time; HEARTBEAT follows the estimator's progress.

        The first one must not go out before the links that open at once are open.
        """
        loop = asyncio.get_running_loop()
        for _ in range(OPENING):
            if all(link.counts.connections for link in self.links):
                break
            await asyncio.sleep(TICK_S / OPENING)
        while True:
            now_s = loop.time()
            self._do_what_is_due(now_s)
            await asyncio.sleep(TICK_S)
            late_s = loop.time() - now_s - TICK_S
            if late_s > STALLED_S:
                _log.warning("stood still for %d s", round(late_s))

    def _do_what_is_due(self, now_s: float) -> None:
        if self._held or not self._has_accounted:
            self._take_held()
        self._has_accounted = False  # what is answered from now on waits for two beats at most
        self._look_after_keys(now_s)
        self._look_after_state(now_s)
        self._tell_gibberish(now_s)
        self._tell_mismatch()
        self._tell_recalled()
        now_us = round(now_s * 1e6)
        gathered = self.pipeline.assembler.counts["epochs"]
        is_alive = self._component.note_gathered(gathered, now_us)
        for recording in self._recordings:
            self._component.complaints[f"recording {recording.name}"] = recording.trouble
        self._component.advance(now_us, self._clock_us())
        self._hand_out(self._component.collect(self._peers()))
        self._supervisor.tell(now_s, lambda: self._component.status, is_alive)


def _pace(link: Link) -> float:
    """How many PARAM_VALUE a second a link carries beside all else."""
    return PARAMETERS_SHARE * link.bytes_per_s / PARAM_VALUE_BYTES
