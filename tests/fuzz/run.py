"""Let atheris write bytes for one target: python tests/fuzz/run.py TARGET SECONDS [libFuzzer's].

New inputs that reach new code go to OUT/TARGET/corpus, those that show a fault, one of each, to
OUT/TARGET/faults; OUT is the variable FUZZ_OUT or `out/fuzz`. At the end the number of executions
is printed. See README.md.
"""

import logging
import os
import sys
import traceback
import warnings
from pathlib import Path

import atheris

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path[:0] = [str(ROOT), str(HERE.parent)]

with atheris.instrument_imports(include=["risaf_link"]):
    import targets
from fuzz_script import mended

logging.getLogger("risaf_link").setLevel(logging.CRITICAL)

WRITTEN = {"config", "kept", "calibration"}  # in YAML
FRAMED = {"stream", "tlog", "replay"}  # targets of raw frames: their checksums want mending
LONGEST = {"replay": 12_000, "tlog": 8_000, "stream": 4_000}  # bytes


def main() -> None:
    """Run one target."""
    name, seconds, *options = sys.argv[1:]
    place = Path(os.environ.get("FUZZ_OUT", ROOT / "out" / "fuzz")) / name
    for part in ("corpus", "faults"):
        (place / part).mkdir(parents=True, exist_ok=True)
    argv = [
        *(sys.argv[0], f"-max_total_time={seconds}", "-print_final_stats=1", "-timeout=60"),
        *(f"-max_len={LONGEST.get(name, 2000)}", "-rss_limit_mb=3000"),
        *(f"-artifact_prefix={place}/", "-reload=0", "-len_control=0", *options),
        *(str(place / "corpus"), str(HERE / "corpus" / name)),
    ]
    argv += [f"-dict={HERE / 'yaml.dict'}"] if name in WRITTEN else []
    more = {"custom_mutator": _mutated} if name in FRAMED else {}
    atheris.Setup(argv, _Watched(name, place / "faults"), **more)
    warnings.simplefilter("error")
    atheris.Fuzz()


class _Watched:
    """A target that goes on after a fault; the first input of each fault is kept."""

    def __init__(self, name: str, faults: Path) -> None:
        self._target, self._faults = targets.TARGETS[name], faults
        self._seen: set[str] = set()

    def __call__(self, data: bytes) -> None:
        try:
            self._target(data)
        except Exception as error:
            where = traceback.extract_tb(error.__traceback__)[-1]
            fault = f"{type(error).__name__}-{Path(where.filename).stem}-{where.lineno}"
            if fault in self._seen:
                return
            self._seen.add(fault)
            (self._faults / fault).write_bytes(data)
            print(f"FAULT {fault}: {error}", file=sys.stderr, flush=True)
            traceback.print_exc()


def _mutated(data: bytes, most: int, seed: int) -> bytes:
    """Change the bytes; in half of the cases, put the checksums right."""
    changed = atheris.Mutate(data, most)
    return mended(changed)[:most] if seed % 2 else changed


if __name__ == "__main__":
    main()
