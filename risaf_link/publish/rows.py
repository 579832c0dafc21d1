"""Estimates as CSV: one row an epoch, full precision, rad and rad/s."""

from typing import TextIO

from risaf_link.core.estimate import Estimate

COLUMNS = (
    *("time_us", "q_w", "q_x", "q_y", "q_z", "roll", "pitch", "yaw"),
    *("fused_x", "fused_y", "fused_z", "fused_var_x", "fused_var_y", "fused_var_z"),
    *("active_x", "active_y", "active_z", "bias_x", "bias_y", "bias_z"),
    *("roll_std", "pitch_std", "yaw_std", "heading_state"),
)


class RowWriter:
    """Writes one row an estimate.

    `fused_*` is the array's rate before the filter's bias is taken off; `heading_state` is the name
    of the state in GPS_HEADING_STATUS.
    """

    def __init__(self, file: TextIO) -> None:
        self._file = file
        file.write(",".join(COLUMNS) + "\n")

    def write(self, estimate: Estimate) -> None:
        """Write the row of one epoch."""
        fused, attitude = estimate.fused, estimate.attitude
        values = (
            estimate.time_us,
            *attitude.q_nb.tolist(),
            *attitude.euler,
            *fused.rate_b.tolist(),
            *fused.variance.tolist(),
            *fused.active.tolist(),
            *attitude.bias_b.tolist(),
            attitude.roll_std,
            attitude.pitch_std,
            attitude.yaw_std,
        )
        self._file.write(",".join(map(repr, values)) + f",{estimate.heading.state.name}\n")
