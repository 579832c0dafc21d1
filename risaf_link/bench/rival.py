"""Services to compare with: the one that one would write first, and one that does nothing.

    python -m risaf_link.bench.rival PORT METHOD SENSORS SCALE

sends HEARTBEAT to 127.0.0.1:PORT and answers every epoch from there with ATTITUDE_QUATERNION, by
pymavlink and NumPy. METHOD `echo` copies an epoch's time stamp and knows nothing of the rest: that
is what sockets, processes and Python cost by themselves.
"""

import socket
import sys
from collections.abc import Callable

import numpy as np
from pymavlink.dialects.v20 import all as public

from risaf_link.bench.epoch import NumpyForm
from risaf_link.core.rotation import Floats
from risaf_link.mavlink import risaf
from risaf_link.mavlink.dialect import IDS
from risaf_link.mavlink.frame import encode
from risaf_link.mavlink.ingest import ARRAY_HEAD

Answer = Callable[[bytes], bytes | None]

NO_FORCES = np.zeros((0, 3))
HEAD = 10  # bytes before the payload
CAPACITY = 40  # sensors a message


class Plain:
    """Every message an object, every epoch through NumPy.

    Parameters
    ----------
    method : str
        Of fusion.
    sensors : int
    scale : float
        rad/s per count.
    """

    def __init__(self, method: str, sensors: int, scale: float) -> None:
        self._codec, self._sender = risaf.MAVLink(None), public.MAVLink(None, 1, 191)
        self._form = NumpyForm(method)
        self._sensors, self._scale = sensors, scale
        self._parts: list[Floats] = []
        self._last_us = 0

    def __call__(self, data: bytes) -> bytes | None:
        """Take a datagram; an answer where it ends an epoch."""
        answer = None
        for message in self._codec.parse_buffer(data) or ():
            if message.get_type() == "GYRO_ARRAY":
                counts = np.reshape(message.rates[: 3 * message.sensor_count], (-1, 3))
                self._parts.append(counts * self._scale)
                if message.first_sensor + message.sensor_count == self._sensors:
                    answer = self._step(message.time_usec)
        return answer

    def _step(self, time_us: int) -> bytes:
        dt = (time_us - self._last_us) / 1e6 if self._last_us else 0.0
        state = self._form.step(dt, np.concatenate(self._parts), NO_FORCES)
        self._parts, self._last_us = [], time_us
        message = public.MAVLink_attitude_quaternion_message(
            time_us // 1000, *state.q_nb.tolist(), *state.rate_b.tolist()
        )
        return bytes(message.pack(self._sender))


class Echo:
    """Only the time stamp."""

    def __init__(self, sensors: int) -> None:
        self._sensors = sensors

    def __call__(self, data: bytes) -> bytes | None:
        """Take a datagram; an answer where it ends an epoch."""
        if int.from_bytes(data[7:HEAD], "little") != IDS["GYRO_ARRAY"]:
            return None
        time_us, _, first = ARRAY_HEAD.unpack_from(data, HEAD)
        if first + CAPACITY < self._sensors:
            return None
        stamp = (time_us // 1000).to_bytes(4, "little")
        return encode(IDS["ATTITUDE_QUATERNION"], stamp + bytes(27) + b"\1", 0, 1, 191)


def serve(port: int, answer: Answer) -> None:
    """Answer for ever."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        udp.connect(("127.0.0.1", port))
        udp.send(encode(IDS["HEARTBEAT"], bytes(9), 0, 1, 191))
        while True:
            raw = answer(udp.recv(65536))
            if raw:
                udp.send(raw)


def main(port: str, method: str, sensors: str, scale: str) -> None:
    """Serve as the command line says."""
    n = int(sensors)
    serve(int(port), Echo(n) if method == "echo" else Plain(method, n, float(scale)))


if __name__ == "__main__":
    main(*sys.argv[1:])
