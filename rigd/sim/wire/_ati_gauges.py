"""Strain gauges of the simulated ATI sensor, which measure a wrench."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rigd.devices.contracts import Wrench
from rigd.devices.parameters import WrenchSensorSettings
from rigd.sim import StuckReadings

COUNTS_PER_UNIT = (1_000_000, 1_000_000)
"""Counts per N and per N·m, as documented for two sensors of this family."""
GAUGE_ORDER_ON_WIRE = (0, 2, 4, 1, 3, 5)
"""Number of the gauge at each position, in the order in which both protocols send them."""
UNIT_NEWTON, UNIT_NEWTON_METRE = 2, 3
"""ATI's unit codes of force in N and of torque in N·m."""
PART_NUMBER = "SI-20-1"
"""Part number of the simulated sensor."""
SERIAL_NUMBER = "FT12345"
"""Serial number of the simulated sensor if the profile states none."""

# Three beams carry two gauges each. The even gauges measure the forces across the axis and the
# torque about it, the odd gauges the other components, with a few per cent of crosstalk as on a
# real sensor. The magnitudes of a row add up to 24 000 to 27 600, so that no load within the range
# saturates a gauge, bias included.
_COUNTS_AT_FULL_RANGE = (
    (6860, 2500, 410, -350, 270, 17200),
    (310, -260, 8310, 2150, 12540, -380),
    (-5590, 4690, -360, 240, 420, 16100),
    (-240, 350, 8570, -11990, -4300, 290),
    (-1270, -7190, 330, 390, -310, 17440),
    (380, 300, 8410, 9790, -8190, 340),
)
"""Counts of each gauge (row) under the full range of fx, fy, fz, tx, ty, tz."""
_BIAS_COUNTS = (612, -1043, 385, 871, -724, 198)
"""Counts of each gauge without load."""
_LOWEST_COUNTS, _HIGHEST_COUNTS = -32768, 32767
"""Range of a gauge in counts."""
_SATURATED_COUNTS = 32767
"""Magnitude in counts of a gauge that a fault saturates."""


class AtiGauges:
    """Six strain gauges that a wrench loads, and the matrix that computes it from their counts.

    The counts are ``round(M⁻¹ · (wrench · counts per unit)) + bias``, with the calibration matrix M
    in single precision, as it is transmitted. They saturate at 16 bits. The range of `sensor`
    determines the gauges' sensitivity.

    Attributes
    ----------
    matrix : (6, 6) float32
        Calibration matrix from gauge counts to fx, fy, fz, tx, ty, tz times the counts per unit. It
        is not symmetric and has no zero entry. With each axis divided by its range, its condition
        number is 3.3.
    counts_per_unit : tuple of int
        Counts per N and per N·m.
    quantisation : (6,) float64
        Largest error of each axis by the rounding of the gauges, in N and N·m. With the range and
        resolution of the Mini40 SI-20-1 it is less than half the resolution on every axis, and so
        is the effect of one count of one gauge.
    stuck : tuple of int and StuckReadings, or None
        Number of a gauge that has failed, and replacement for its readings; None if none has.
    """

    def __init__(
        self, sensor: WrenchSensorSettings, counts_per_unit: tuple[int, int] = COUNTS_PER_UNIT
    ) -> None:
        self.counts_per_unit = counts_per_unit
        axis_counts_per_unit = np.repeat(np.array(counts_per_unit, dtype=np.float64), 3)
        range_counts = axis_counts_per_unit * np.array(sensor.range)
        self.matrix = np.linalg.inv(np.array(_COUNTS_AT_FULL_RANGE) / range_counts).astype(
            np.float32
        )
        calibration_matrix = self.matrix.astype(np.float64)
        self.quantisation: NDArray[np.float64] = (
            0.5 * np.abs(calibration_matrix).sum(axis=1) / axis_counts_per_unit
        )
        # For wrenches in rows.
        self._counts_per_wrench = np.ascontiguousarray(
            (np.linalg.inv(calibration_matrix) * axis_counts_per_unit).T
        )
        self.stuck: tuple[int, StuckReadings] | None = None
        self._bias = np.array(_BIAS_COUNTS, dtype=np.float64)

    def read_counts(
        self, wrenches: Sequence[Wrench], saturated_gauge: int | None = None
    ) -> NDArray[np.int16]:
        """Return the counts of gauges 0 to 5 under each wrench, shape (n, 6).

        A wrench is fx, fy, fz in N and tx, ty, tz in N·m. A saturated gauge reads ±32767, with the
        sign of its reading.
        """
        gauge_counts: NDArray[np.float64] = np.array(wrenches) @ self._counts_per_wrench
        np.rint(gauge_counts, out=gauge_counts)
        gauge_counts += self._bias
        np.minimum(gauge_counts, _HIGHEST_COUNTS, out=gauge_counts)
        np.maximum(gauge_counts, _LOWEST_COUNTS, out=gauge_counts)
        if saturated_gauge is not None:
            gauge_counts[:, saturated_gauge] = np.copysign(
                _SATURATED_COUNTS, gauge_counts[:, saturated_gauge]
            )
        if self.stuck is not None:
            stuck_gauge, stuck_readings = self.stuck
            gauge_counts[:, stuck_gauge] = [
                stuck_readings(gauge_count) for gauge_count in gauge_counts[:, stuck_gauge].tolist()
            ]
        return gauge_counts.astype(np.int16)
