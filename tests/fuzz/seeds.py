"""Make the seeds of the corpus, small inputs of each target that lead far in, and the words.

python tests/fuzz/seeds.py
"""

import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path[:0] = [str(ROOT), str(HERE.parent)]

import msgspec
from fuzz_checks import drive
from fuzz_files import a_state
from fuzz_script import NAMES, line, messages
from streams import MIXES, made, seeded, sequence

from risaf_link.config import Config, dump
from risaf_link.core.array import ArrayCalibration, TriadCalibration
from risaf_link.kept import parameters_of
from risaf_link.mavlink.tlog import record

FIXTURES = ROOT / "sitl_fixtures"
YAML = [
    *("&a ", "*a", "<<: ", "!!int ", "!!float ", "!!bool ", "!!timestamp ", "!!binary ", "!!set "),
    *(
        "!!map ",
        "!!omap ",
        "2026-13-45",
        "0x_",
        "1:20:30",
        ".nan",
        "-.inf",
        "1e999",
        "~",
        "? ",
        "- ",
    ),
    *("[", "]", "{", "}", ": ", "\n  ", "'", '"', "|\n", ">\n", "%YAML 1.1\n", "---\n", "...\n"),
    *("udpin://", "udpout://", "tcpin://", "tcpout://", "serial:///dev/", "tlog:///", "mqtt://"),
]


def seeds() -> dict[str, list[bytes]]:
    """Of every target."""
    random = seeded(1)
    streams = [b"".join(made(each, random) for each in ("HEARTBEAT", "GYRO_ARRAY", "RAW_IMU"))]
    streams += [b"".join(sequence(mix, 1, 4)) for mix in MIXES]
    fixtures = [
        (FIXTURES / f"{name}.tlog").read_bytes()[:3000]
        for name in ("rover_sitl_fixture", "rover_sitl_signed", "rover_mavproxy")
    ]
    stamped = b"".join(record(sent.received_us, sent.raw) for sent in drive()[:30])
    bare = b"".join(sent.raw for sent in drive()[:12])
    inputs = [b"\0" + script for script in _scripts()]
    yaml = [dump(Config()).encode(), (ROOT / "config/risaf_link.yaml").read_bytes()]
    return {
        "stream": [head + each for head in (b"\0\1\5\11\100", b"\xff\7\7\7\7") for each in streams],
        "tlog": [b"\1\50\310\7" + each for each in (*fixtures, stamped, bare)],
        "replay": [bytes((k,)) + each for k, each in enumerate((stamped, *fixtures, bare))],
        "kernel": [head + each for head in _heads() for each in (*streams[:3], *_epochs())],
        "ingest": inputs,
        "component": inputs,
        "service": [bytes((k,)) + each[1:] for k, each in enumerate(inputs)],
        "signing": [b"\0\1\22\7\337" + each for each in inputs[:6]],
        "config": [*yaml, *_settings()],
        "kept": [b"FUS_GATE: 4.5\nHDG_GATE: 3\n", b'{"ticks": 5, "streams": [[1, 1, 1, 3]]}'],
        "calibration": [b"gyros: [{bias: [0, 0, 0.1]}, {scale: [1, 1, 1.1]}]\nname: x\n"],
        "state": [b"r" + a_state(), b"\0\0\1\2", b"\7\1\200\204"],
        "page": [b"\0" + each[1:] for each in inputs] + [b'\22{"seek_us": 1e99}', b"\0051:191"],
    }


def _scripts() -> list[bytes]:
    epochs = line("GYRO_ARRAY", repeat=9) + line("ACCEL_ARRAY", steps=0x11)
    told = line("IMU_ARRAY_INFO") + line("HEARTBEAT") + line("SYSTEM_TIME")
    fix = line("GPS_RAW_INT", steps=0x11)
    jump = line("GYRO_ARRAY", steps=0xBB)
    behind = line("GYRO_ARRAY", steps=0x0E) * 5
    orders = b"".join(line(name) for name in NAMES if name.startswith(("COMMAND", "PARAM")))
    return [
        told + (epochs + fix) * 5,
        told + epochs + jump + epochs + behind,
        told + epochs + fix + orders + epochs,
        *(line("HEARTBEAT") + line(name, repeat=10, steps=0x44) * 3 for name in NAMES),
    ]


def _heads() -> list[bytes]:
    """What stands before a stream for kernel.cpp: how it is cut, and what array is looked for."""
    return [
        bytes((how, 1, 5, 9, 64, 200, 4, 100, forces, 10, 3, 0)) for how, forces in ((2, 0), (3, 4))
    ]


def _epochs() -> list[bytes]:
    both = line("GYRO_ARRAY") + line("ACCEL_ARRAY", steps=0x11)
    return [
        b"".join(sent.raw for sent in messages(each)) for each in (line("GYRO_ARRAY") * 6, both * 4)
    ]


def _settings() -> list[bytes]:
    return [b"=fusion.method=mean\n\nfusion: {alpha: 0.9}\n", b"=links.0.url=udpin://[::1]:1\n\n"]


def _words() -> set[str]:
    """Keys and values of what is written in YAML."""
    found = set(YAML) | {parameter.name for parameter in parameters_of(Config)}
    trees = [
        msgspec.to_builtins(each) for each in (Config(), ArrayCalibration([TriadCalibration()]))
    ]
    while trees:
        tree = trees.pop()
        inside: Any = tree.values() if isinstance(tree, dict) else tree
        found |= {f"{key}: " for key in tree} if isinstance(tree, dict) else set()
        found |= {each for each in inside if isinstance(each, str) and each}
        trees += [each for each in inside if isinstance(each, dict | list | tuple)]
    return found


def main() -> None:
    """Write them."""
    for name, contents in seeds().items():
        place = HERE / "corpus" / name
        place.mkdir(parents=True, exist_ok=True)
        for k, content in enumerate(contents):
            (place / f"seed{k:02}").write_bytes(content)
    escaped = ("".join(f"\\x{byte:02x}" for byte in word.encode()) for word in sorted(_words()))
    (HERE / "yaml.dict").write_text("".join(f'"{word}"\n' for word in escaped))


if __name__ == "__main__":
    main()
