"""What must hold for any bytes, of each way by which bytes come in.

A target takes bytes and raises where something does not hold: an error that is none of the
program's own, or an answer that another way of asking gives otherwise. The tests let hypothesis
write the bytes, `run.py` lets atheris.
"""

from collections.abc import Callable

from fuzz_files import calibration, config, kept, state
from fuzz_links import component, ingest, service, signing
from fuzz_pages import page
from fuzz_streams import replay, stream, tlog

TARGETS: dict[str, Callable[[bytes], None]] = {
    target.__name__: target
    for target in (
        *(stream, tlog, replay, ingest, component, service, signing),
        *(config, kept, calibration, state, page),
    )
}
