"""Keep what longer runs have found: python tests/fuzz/keep.py [TARGET ...].

Of the inputs in OUT/TARGET/corpus (see run.py), the smallest that reach lines of the program which
the corpus does not reach yet.
"""

import hashlib
import os
import sys
from pathlib import Path
from types import FrameType
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path[:0] = [str(ROOT), str(HERE.parent)]

from targets import TARGETS

PACKAGE = str(ROOT / "risaf_link")
OUT = Path(os.environ.get("FUZZ_OUT", ROOT / "out" / "fuzz"))
LARGEST = 2000  # bytes of an input that is kept


def lines(name: str, data: bytes) -> set[tuple[str, int]]:
    """Lines of the program that a target runs through."""
    found: set[tuple[str, int]] = set()

    def enter(frame: FrameType, _: str, __: Any) -> Any:
        return step if frame.f_code.co_filename.startswith(PACKAGE) else None

    def step(frame: FrameType, _: str, __: Any) -> Any:
        found.add((frame.f_code.co_filename, frame.f_lineno))
        return step

    sys.settrace(enter)
    try:
        TARGETS[name](data)
    finally:
        sys.settrace(None)
    return found


def main() -> None:
    """Keep what is new."""
    for name in sys.argv[1:] or TARGETS:
        kept = HERE / "corpus" / name
        reached = {line for path in kept.iterdir() for line in lines(name, path.read_bytes())}
        contents = (path.read_bytes() for path in (OUT / name / "corpus").iterdir())
        for content in sorted(contents, key=len):
            new = lines(name, content) - reached if len(content) <= LARGEST else None
            if new:
                reached |= new
                digest = hashlib.sha256(content).hexdigest()[:12]
                (kept / digest).write_bytes(content)
                print(f"{name}: {digest}, {len(content)} bytes, {len(new)} new lines")


if __name__ == "__main__":
    main()
