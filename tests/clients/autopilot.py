"""An autopilot by pymavlink's mavutil, as a process of its own, that sends what it is asked for.

    autopilot.py URL COUNT

Is asked for so many messages; which, at which intervals, goes to standard output as JSON.
"""

import json
import os
import sys
import time

os.environ["MAVLINK20"] = "1"
from pymavlink import mavutil

DEADLINE_S = 60.0
SYSTEM = 3


def main():
    url, count = sys.argv[1], int(sys.argv[2])
    link = mavutil.mavlink_connection(url, source_system=SYSTEM, source_component=1)
    asked, beaten, until = {}, 0.0, time.monotonic() + DEADLINE_S
    while len(asked) < count:
        now = time.monotonic()
        if now > until:
            sys.exit(f"not asked for all before the deadline: {asked}")
        if now - beaten > 1.0:
            beaten = now
            link.mav.heartbeat_send(10, 3, 0, 0, 4)
        link.select(0.05)
        order = link.recv_msg()
        if order is None or order.get_type() != "COMMAND_LONG":
            continue
        if (order.target_system, order.target_component, order.command) == (SYSTEM, 1, 511):
            asked[int(order.param1)] = order.param2
            asker = order.get_srcSystem(), order.get_srcComponent()
            link.mav.command_ack_send(511, 0, 0, 0, *asker)
    print(json.dumps(asked))


if __name__ == "__main__":
    main()
