"""A serial device; it may come late, be unplugged and come back."""

import asyncio
import logging
import termios

from risaf_link.links.endpoint import OnePeerLink, Stream
from risaf_link.links.link import BACKOFF, Backoff, Connection

# It would write every chunk of bytes into a log at level debug.
logging.getLogger("serialx").setLevel(logging.INFO)


class _SerialStream(Stream, asyncio.Protocol):
    """Our end of a line."""

    def data_received(self, data: bytes) -> None:
        self.take(data)


class SerialLink(OnePeerLink):
    """A serial device, eight data bits, no parity, one stop bit, ours alone.

    Parameters
    ----------
    name : str
        What the log calls it.
    path : str
        The device.
    baud : int
        Its speed, bits a second.
    backoff : Backoff
        How long it waits before it opens the device again.
    """

    def __init__(self, name: str, path: str, baud: int, backoff: Backoff = BACKOFF) -> None:
        super().__init__(name, f"{path} at {baud} baud", backoff)
        self._path = path
        self._baud = baud
        self.bytes_per_s = baud / 10

    async def _connect(self, connection: Connection) -> Stream:
        import serialx  # noqa: PLC0415 (70 ms that other links need not wait for)

        stream = _SerialStream(connection)
        try:
            transport, _ = await serialx.create_serial_connection(
                asyncio.get_running_loop(), lambda: stream, self._path, self._baud
            )
        except (serialx.SerialException, termios.error) as error:
            raise OSError(f"{self._path}: {error}") from error
        # No more than a second's worth may wait: what is older helps nobody.
        transport.set_write_buffer_limits(high=min(65536, self._baud // 10))
        return stream
