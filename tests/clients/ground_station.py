"""A ground station by pymavlink's mavutil, as a process of its own.

    ground_station.py URL RATE_HZ [KEY]

With a key, 64 hexadecimal digits, it signs what it sends and takes nothing that is not signed.
Waits for the component and asks it for everything; what came of it goes to standard output as JSON.
Whatever is not answered is asked again, as on a link that loses frames.
"""

import itertools
import json
import os
import sys
import time

os.environ["MAVLINK20"] = "1"
from pymavlink import mavutil

mavlink = mavutil.mavlink
DEADLINE_S = 60.0
AGAIN_S = 0.5
COMPONENT = 191
QUATERNION, UNKNOWN_MESSAGE, UNKNOWN_COMMAND = 31, 24, 400


class Station:
    """Asks until it is answered, or the time is over."""

    def __init__(self, url, key=""):
        self.link = mavutil.mavlink_connection(url, source_system=255, source_component=190)
        self.link.target_component = COMPONENT
        if key:
            self.link.setup_signing(bytes.fromhex(key), sign_outgoing=True)
        self._deadline = time.monotonic() + DEADLINE_S
        self._beaten = 0.0
        self.texts = []

    def next(self, *types, seconds=AGAIN_S):
        """The next message of some types from the component; None: none came in time."""
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            if time.monotonic() > self._deadline:
                sys.exit("no answer before the deadline")
            if time.monotonic() - self._beaten > 0.5:
                self._beaten = time.monotonic()
                self.link.mav.heartbeat_send(6, 8, 0, 0, 4)
            self.link.select(0.05)
            message = self.link.recv_msg()
            if message is None or message.get_type() == "BAD_DATA":
                continue
            if message.get_srcComponent() != COMPONENT:
                continue
            if message.get_type() == "STATUSTEXT":
                self.texts.append(message.text)
            if message.get_type() in types:
                return message
        return None

    def wait(self):
        heartbeat = None
        while not heartbeat or heartbeat.system_status != mavlink.MAV_STATE_ACTIVE:
            heartbeat = self.next("HEARTBEAT")
        self.link.target_system = heartbeat.get_srcSystem()
        return heartbeat

    def all_parameters(self):
        """As ground stations do: the list, then what is missing, one by one."""
        found, count = {}, None
        while count is None or len(found) < count:
            if count is None:
                self.link.param_fetch_all()
                self.link.param_fetch_start = 0
            else:
                for index in set(range(count)) - {m.param_index for m in found.values()}:
                    self.link.mav.param_request_read_send(*self._us(), b"", index)
            while message := self.next("PARAM_VALUE"):
                found[message.param_id], count = message, message.param_count
                if len(found) == count:
                    break
        return {name: message.param_value for name, message in found.items()}

    def set(self, name, value):
        while True:
            self.link.param_set_send(name, value)
            answer = self.next("PARAM_VALUE")
            if answer and answer.param_id == name:
                return answer.param_value

    def command(self, command, *values):
        """The results that are acknowledged, up to the last one."""
        results = []
        values = [*values, *[0.0] * (7 - len(values))]
        while True:
            self.link.mav.command_long_send(*self._us(), command, len(results), *values)
            while ack := self.next("COMMAND_ACK"):
                if ack.command == command:
                    results.append(ack.result)
                    if ack.result != mavlink.MAV_RESULT_IN_PROGRESS:
                        return sorted(set(results), key=results.index)

    def request(self, message_id, name, second=0.0):
        while True:
            self.link.mav.command_long_send(*self._us(), 512, 0, message_id, second, 0, 0, 0, 0, 0)
            if message := self.next(name):
                return message

    def periods_ms(self, count):
        """Between so many attitudes, by their own time."""
        times = []
        while len(times) <= count:
            if message := self.next("ATTITUDE_QUATERNION", seconds=5.0):
                times.append(message.time_boot_ms)
        times.sort()
        return [after - before for before, after in itertools.pairwise(times)]

    def _us(self):
        return self.link.target_system, self.link.target_component


def main():
    url, rate = sys.argv[1], float(sys.argv[2])
    station = Station(url, *sys.argv[3:])
    heartbeat = station.wait()
    print(
        json.dumps(
            {
                "heartbeat": heartbeat.to_dict(),
                "signed": heartbeat.get_signed(),
                "interval": station.command(511, QUATERNION, 1e6 / rate),
                "told_interval": station.request(244, "MESSAGE_INTERVAL", QUATERNION).interval_us,
                "parameters": station.all_parameters(),
                "set": station.set("HDG_GATE", 4.5),
                "refused": station.set("HDG_GATE", -1.0),
                "no_message": station.command(511, UNKNOWN_MESSAGE, 1e6),
                "no_command": station.command(UNKNOWN_COMMAND),
                "stored": station.command(245, 1),
                "periods_ms": station.periods_ms(15),
            }
        )
    )


if __name__ == "__main__":
    main()
