"""An autopilot by pymavlink's mavutil, as a process of its own.

    autopilot.py URL COUNT

It is asked for so many messages and for its time, and asks for the time; what came of it goes to
standard output as JSON.
"""

import json
import os
import sys
import time

os.environ["MAVLINK20"] = "1"
from pymavlink import mavutil

DEADLINE_S = 60.0
SYSTEM = 3
STARTED_NS, BOOTED_NS = time.monotonic_ns(), 5000 * 10**9  # it has been up for 5000 s


def main():
    url, count = sys.argv[1], int(sys.argv[2])
    link = mavutil.mavlink_connection(url, source_system=SYSTEM, source_component=1)
    asked, offsets_s, told, beaten = {}, [], 0, 0.0
    until = time.monotonic() + DEADLINE_S
    while len(asked) < count or len(offsets_s) < 3 or told < 2:
        now = time.monotonic()
        if now > until:
            sys.exit(f"not asked for all before the deadline: {asked}, {told}, {offsets_s}")
        if now - beaten > 1.0:
            beaten = now
            link.mav.heartbeat_send(10, 3, 0, 0, 4)
            link.mav.timesync_send(0, boot_ns())
        link.select(0.05)
        order = link.recv_msg()
        if order is None:
            continue
        if order.get_type() == "TIMESYNC" and order.tc1 == 0:
            told += 1
            link.mav.timesync_send(boot_ns(), order.ts1)
        elif order.get_type() == "TIMESYNC":
            offsets_s.append(((order.ts1 + boot_ns()) / 2 - order.tc1) / 1e9)
        elif order.get_type() == "COMMAND_LONG":
            to = order.target_system, order.target_component, order.command
            if to == (SYSTEM, 1, 511):
                asked[int(order.param1)] = order.param2
                asker = order.get_srcSystem(), order.get_srcComponent()
                link.mav.command_ack_send(511, 0, 0, 0, *asker)
    print(json.dumps({"asked": asked, "offsets_s": offsets_s}))


def boot_ns():
    return time.monotonic_ns() - STARTED_NS + BOOTED_NS


if __name__ == "__main__":
    main()
