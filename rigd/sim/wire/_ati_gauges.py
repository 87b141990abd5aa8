"""The strain gauges of the simulated ATI sensor: what its calibration matrix has to undo."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rigd.devices.contracts import Wrench
from rigd.devices.parameters import WrenchSensorSettings
from rigd.sim import Stuck

COUNTS_PER_UNIT = (1_000_000, 1_000_000)
"""Per N and per N·m, as both sensors of this family that are documented state them."""
WIRE_ORDER = (0, 2, 4, 1, 3, 5)
"""Order in which both protocols send the gauges."""
UNIT_NEWTON, UNIT_NEWTON_METRE = 2, 3
PART_NUMBER = "SI-20-1"
SERIAL_NUMBER = "FT12345"
"""Serial number where the profile asks for none."""

# Counts of each gauge (row) under the full range of fx, fy, fz, tx, ty, tz. Three beams carry two
# gauges each: the even ones feel the forces across the axis and the torque about it, the odd ones
# the rest; a few per cent of everything else leak in, as on a real sensor. A row's magnitudes add
# up to 24 000 to 27 600: no load within the range saturates a gauge, bias included.
_COUNTS_AT_FULL_RANGE = (
    (6860, 2500, 410, -350, 270, 17200),
    (310, -260, 8310, 2150, 12540, -380),
    (-5590, 4690, -360, 240, 420, 16100),
    (-240, 350, 8570, -11990, -4300, 290),
    (-1270, -7190, 330, 390, -310, 17440),
    (380, 300, 8410, 9790, -8190, 340),
)
_BIAS = (612, -1043, 385, 871, -724, 198)
_LOWEST, _HIGHEST = -32768, 32767
_SATURATED = 32767


class AtiGauges:
    """Six gauges under a wrench.

    A gauge is ``round(M⁻¹ · (wrench · counts per unit)) + bias``, with M as it goes over the wire,
    in single precision; beyond 16 bits it saturates.

    Parameters
    ----------
    sensor
        Sensor whose range fixes the gauges' sensitivity.
    counts_per_unit
        Per N and per N·m: the scale of the matrix.

    Attributes
    ----------
    matrix : (6, 6) float32
        From gauges to fx, fy, fz, tx, ty, tz, times the counts per unit. Not symmetric, no entry
        zero; each axis divided by its range, its condition number is 3.3.
    counts_per_unit : tuple of int
        Counts per unit of force and torque, as given.
    quantisation : (6,) float64
        What the rounding of the gauges does at most to each axis, in N and N·m. With the range and
        resolution of the Mini40 SI-20-1 it is less than half the resolution on every axis, and one
        count of one gauge is less than that too.
    stuck : tuple of int and Stuck, or None
        Number of a gauge that has failed, and what it shows.
    """

    def __init__(
        self, sensor: WrenchSensorSettings, counts_per_unit: tuple[int, int] = COUNTS_PER_UNIT
    ) -> None:
        self.counts_per_unit = counts_per_unit
        counts = np.repeat(np.array(counts_per_unit, dtype=np.float64), 3)
        full_range = counts * np.array(sensor.range)
        self.matrix = np.linalg.inv(np.array(_COUNTS_AT_FULL_RANGE) / full_range).astype(np.float32)
        matrix = self.matrix.astype(np.float64)
        self.quantisation: NDArray[np.float64] = 0.5 * np.abs(matrix).sum(axis=1) / counts
        # For wrenches in rows.
        self._per_unit = np.ascontiguousarray((np.linalg.inv(matrix) * counts).T)
        self.stuck: tuple[int, Stuck] | None = None
        self._bias = np.array(_BIAS, dtype=np.float64)

    def read(self, wrenches: Sequence[Wrench], saturated: int | None = None) -> NDArray[np.int16]:
        """Return the gauges, 0 to 5, under each wrench.

        Parameters
        ----------
        wrenches
            fx, fy, fz (N), tx, ty, tz (N·m).
        saturated
            A gauge that reads ±32767, with the sign it has anyway; or None.

        Returns
        -------
        (n, 6) int16
        """
        gauges: NDArray[np.float64] = np.array(wrenches) @ self._per_unit
        np.rint(gauges, out=gauges)
        gauges += self._bias
        np.minimum(gauges, _HIGHEST, out=gauges)
        np.maximum(gauges, _LOWEST, out=gauges)
        if saturated is not None:
            gauges[:, saturated] = np.copysign(_SATURATED, gauges[:, saturated])
        if self.stuck is not None:
            number, stuck = self.stuck
            gauges[:, number] = [stuck(value) for value in gauges[:, number].tolist()]
        return gauges.astype(np.int16)
