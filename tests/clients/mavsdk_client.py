"""MAVSDK as a client, as a process of its own.

    mavsdk_client.py PORT SYSTEM

Finds the component, reads and sets its parameters, sends commands and reads its telemetry; what
came of it goes to standard output as JSON.
"""

import json
import os
import queue
import sys
import time
from contextlib import suppress

from mavsdk.component_type import ComponentType
from mavsdk.mavsdk import Configuration, Mavsdk
from mavsdk.plugins.mavlink_direct import MavlinkDirect, MavlinkMessage
from mavsdk.plugins.param import Param, ParamError, ProtocolVersion

DEADLINE_S = 60.0
COMPONENT = 191


def wait(condition):
    until = time.monotonic() + DEADLINE_S
    while not (found := condition()):
        if time.monotonic() > until:
            sys.exit("no answer before the deadline")
        time.sleep(0.05)
    return found


def again(call):
    """What a call gives, tried again where the link has lost it."""

    def tried():
        try:
            return [call()]
        except ParamError as error:
            if error.result.name != "TIMEOUT":
                return [error.result.name]
            return []

    return wait(tried)[0]


def command(direct, system, command_id, *values):
    fields = {
        **{f"param{i}": value for i, value in enumerate([*values, *[0] * 7][:7], 1)},
        "target_system": system,
        "target_component": COMPONENT,
        "command": command_id,
        "confirmation": 0,
    }
    told = MavlinkMessage("COMMAND_LONG", 0, 0, system, COMPONENT, json.dumps(fields))
    return json.loads(direct.send_command(told).fields_json)["result"]


def main():
    port, wanted = sys.argv[1], int(sys.argv[2])
    mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    mavsdk.add_any_connection(f"udpout://127.0.0.1:{port}")
    system = wait(
        lambda: next((s for s in mavsdk.get_systems() if s.get_system_id() == wanted), None)
    )
    wait(lambda: COMPONENT in system.component_ids())
    param = Param(system)
    with suppress(ParamError):  # it does what it is told, and says UNKNOWN
        param.select_component(COMPONENT, ProtocolVersion.V1)
    direct = MavlinkDirect(system)
    attitudes = queue.Queue()
    direct.subscribe_message("ATTITUDE_QUATERNION", lambda message, _: attitudes.put(message))
    found = {
        "components": list(system.component_ids()),
        "has_autopilot": system.has_autopilot(),
        "read": again(lambda: param.get_param_float("FUS_GATE")),
        "unknown": again(lambda: param.get_param_float("NONE")),
        "set": again(lambda: param.set_param_float("FUS_GATE", 5.5)),
        "read_again": again(lambda: param.get_param_float("FUS_GATE")),
        "refused": again(lambda: param.set_param_float("FUS_GATE", 0.0)),
        "all": again(lambda: sorted(p.name for p in param.get_all_params().float_params)),
        "accepted": command(direct, wanted, 511, 31, 100000),
        "denied": command(direct, wanted, 510, -1),  # not 511 again: its answer may come twice
        "unsupported": command(direct, wanted, 400, 1),
        "attitude": json.loads(attitudes.get(timeout=DEADLINE_S).fields_json),
    }
    print(json.dumps(found, default=str), flush=True)
    os._exit(0)  # its threads would be waited for


if __name__ == "__main__":
    main()
