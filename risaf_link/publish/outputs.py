"""The outputs of a configuration that are not MAVLink, each apart from the others."""

import asyncio
import logging
import math
from collections.abc import Callable

from risaf_link.core.estimate import Estimate
from risaf_link.errors import ConfigError
from risaf_link.mavlink.notices import Notice
from risaf_link.publish.access import MqttParameters
from risaf_link.publish.account import Account
from risaf_link.publish.output import Output
from risaf_link.publish.scrape import MetricsParameters

_log = logging.getLogger(__name__)


class Outputs:
    """Hands on what the service tells; who fails is left out, and the others go on.

    Parameters
    ----------
    outputs : list of Output

    Attributes
    ----------
    running : list of Output
        Those that have not failed.
    """

    def __init__(self, outputs: list[Output]) -> None:
        self.running = outputs

    @property
    def next_s(self) -> float:
        """From which time of an estimate on one is to be taken without delay."""
        return min((output.next_s for output in self.running), default=math.inf)

    def take(self, estimate: Estimate, received_us: int, began_ns: int, done_ns: int) -> None:
        """Take the next estimate, as `Output.take` does."""
        for output in self.running:
            try:
                output.take(estimate, received_us, began_ns, done_ns)
            except Exception:
                self._leave_out(output)

    def tell(self, notice: Notice, time_us: int, unix_us: int) -> None:
        """Take what the operator is told, as `Output.tell` does."""
        for output in self.running:
            try:
                output.tell(notice, time_us, unix_us)
            except Exception:
                self._leave_out(output)

    async def run(self) -> None:
        """Do what takes its time, until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            for output in self.running:
                tasks.create_task(self._run(output))

    async def _run(self, output: Output) -> None:
        try:
            await output.run()
        except Exception:
            self._leave_out(output)

    def _leave_out(self, output: Output) -> None:
        _log.exception("%s has failed and is left out", type(output).__name__)
        self.running = [other for other in self.running if other is not output]


def open_outputs(
    mqtt: MqttParameters, metrics: MetricsParameters, account: Callable[[], Account]
) -> Outputs:
    """Make those that are configured; they bring libraries, which take their time.

    Parameters
    ----------
    mqtt, metrics
        Their parameters.
    account : callable
        Tells the service's counters.

    Raises
    ------
    ConfigError
        If they cannot be made so.
    """
    outputs: list[Output] = []
    publisher = None
    if mqtt.url:
        from risaf_link.publish.mqtt import MqttPublisher

        publisher = MqttPublisher(mqtt)
        outputs.append(publisher)
    if metrics.listen:
        try:
            from risaf_link.publish.metrics import Metrics
        except ImportError:
            raise ConfigError(
                "metrics.listen: needs prometheus-client: install risaf-link with the extra "
                "`metrics`"
            ) from None
        page = Metrics(metrics, account, publisher.counts if publisher else None)
        outputs.insert(0, page)  # what the others take is no latency of ours
    return Outputs(outputs)
