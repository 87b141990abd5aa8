"""The model's frequency response: the exact beam plus the inertia of what clamps it."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rigd.beam import Beam, Damping, TransferGrid


class FrequencyResponseModel:
    """Measured torque per motor angle, ``G(j omega) + J_tool (j omega)²``, on one frequency grid.

    The torque sensor sits under the clamp, so what it measures holds the clamp's inertia too; it
    is added to the model, and never taken from the data.

    Parameters
    ----------
    frequency_hz : ndarray, shape (n,)
    beam : Beam
    tool_inertia_kg_m2 : float
        Inertia between the sensor and the beam about the motor's axis.
    """

    __slots__ = ("_grid", "_tool", "beam")

    def __init__(
        self, frequency_hz: NDArray[np.float64], beam: Beam, tool_inertia_kg_m2: float = 0.0
    ) -> None:
        s = 2j * np.pi * frequency_hz
        self.beam = beam
        self._grid = TransferGrid(s)
        self._tool = tool_inertia_kg_m2 * s * s

    def evaluate(self, damping: Damping) -> NDArray[np.complex128]:
        """Response in N·m/rad, shape (n,)."""
        return self._grid.evaluate(self.beam, damping) + self._tool

    def evaluate_with_gradient(
        self, damping: Damping, wrt: Sequence[str]
    ) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Response, shape (n,), and its derivatives by the parameters `wrt`, shape (k, n)."""
        response, gradient = self._grid.evaluate_with_gradient(self.beam, damping, wrt)
        return response + self._tool, gradient
