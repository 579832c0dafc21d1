"""Estimates as CSV: one row an epoch, full precision, rad and rad/s."""

from typing import TextIO

import numpy as np

from risaf_link.core.estimate import EstimateBlock
from risaf_link.core.heading import HeadingState
from risaf_link.core.rotation import eulers_of

COLUMNS = (
    *("time_us", "q_w", "q_x", "q_y", "q_z", "roll", "pitch", "yaw"),
    *("fused_x", "fused_y", "fused_z", "fused_var_x", "fused_var_y", "fused_var_z"),
    *("active_x", "active_y", "active_z", "bias_x", "bias_y", "bias_z"),
    *("roll_std", "pitch_std", "yaw_std", "heading_state"),
)


class RowWriter:
    """Writes one row an epoch.

    `fused_*` is the array's rate before the filter's bias is taken off; `heading_state` is the name
    of the state in GPS_HEADING_STATUS.
    """

    def __init__(self, file: TextIO) -> None:
        self._file = file
        file.write(",".join(COLUMNS) + "\n")

    def write(self, block: EstimateBlock) -> None:
        """Write the rows of the next epochs."""
        track = block.track
        values = np.column_stack(
            (
                *(track.q_nb, eulers_of(track.q_nb).T, track.fused_b, track.variance),
                *(track.bias_b, track.angle_std),
            )
        )
        rows = zip(
            block.time_us.tolist(),
            values.tolist(),
            track.active.tolist(),
            block.heading.state.tolist(),
            strict=True,
        )
        for time_us, row, active, state in rows:
            before, after = row[:13], row[13:]
            texts = map(repr, (time_us, *before, *active, *after))
            self._file.write(",".join(texts) + f",{HeadingState(state).name}\n")
