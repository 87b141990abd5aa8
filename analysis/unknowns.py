"""The unknowns in which damping is fitted, and the way to and from its parameters.

A coefficient and its order are all but interchangeable near the frequencies where they act:
fitting ``zeta`` and ``alpha`` themselves means descending a curved valley (their correlation is
-0.99). The unknowns here are the logarithm of the damping's size at one frequency, and the order:

* ``ln(zeta omega_2^alpha)``: internal damping relative to the stiffness at the undamped second
  mode, and ``alpha``;
* ``ln(gamma omega_1^lambda / (rho/EI omega_1²))``: external damping relative to the inertia at the
  undamped first mode, and ``lambda``.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from analysis.structures import Parameter, Structure
from rigd.beam import Beam, Damping, undamped_frequencies_rad_s

# Orders as the paper sweeps them, inside (0, 2). Sizes run from what no response could show to
# far beyond what lets a beam vibrate, much wider than the paper's sweep, which its own results
# leave (type IV with 1/omega weights has zeta = 2.4e-3, the sweep ends at 3.05e-4).
ORDER_RANGE: Final = (0.001, 1.999)
SIZE_RANGE: Final = (1e-9, 1e3)


@dataclass(frozen=True, slots=True)
class Unknowns:
    """Vector of unknowns of one structure on one beam, in the order of ``structure.free``."""

    structure: Structure
    ln_internal_rad_s: float
    ln_external_rad_s: float
    ln_external_unit: float

    @classmethod
    def of(cls, structure: Structure, beam: Beam) -> "Unknowns":
        """Take the beam's own modes as the frequencies at which damping is measured."""
        first, second = (float(w) for w in undamped_frequencies_rad_s(beam, 2))
        return cls(
            structure=structure,
            ln_internal_rad_s=math.log(second),
            ln_external_rad_s=math.log(first),
            ln_external_unit=math.log(beam.density_over_stiffness * first**2),
        )

    @property
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lower and upper bounds, shape (k,)."""
        ranges = [
            ORDER_RANGE if name in ("alpha", "lambda") else tuple(map(math.log, SIZE_RANGE))
            for name in self.structure.free
        ]
        return np.array([low for low, _ in ranges]), np.array([high for _, high in ranges])

    def parameters(self, x: NDArray[np.float64]) -> dict[Parameter, float]:
        """All four damping parameters at `x`."""
        free: dict[Parameter, float] = dict(zip(self.structure.free, map(float, x), strict=True))
        every = {**self.structure.fixed, **free}
        if self.structure.internal:
            every["zeta"] = math.exp(free["zeta"] - every["alpha"] * self.ln_internal_rad_s)
        if self.structure.external:
            every["gamma"] = math.exp(
                free["gamma"] + self.ln_external_unit - every["lambda"] * self.ln_external_rad_s
            )
        return every

    def damping(self, x: NDArray[np.float64]) -> Damping:
        """Damping at `x`."""
        return self.structure.damping(self.parameters(x))

    def derivative_of_parameters(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Differentiate the free parameters by the unknowns, shape (k, k): [parameter, unknown].

        An order moves its coefficient too, since the size stays.
        """
        parameters = self.parameters(x)
        row = {name: i for i, name in enumerate(self.structure.free)}
        derivative = np.eye(len(row))
        if "zeta" in row:
            derivative[row["zeta"], row["zeta"]] = parameters["zeta"]
            if "alpha" in row:
                derivative[row["zeta"], row["alpha"]] = -parameters["zeta"] * self.ln_internal_rad_s
        if "gamma" in row:
            derivative[row["gamma"], row["gamma"]] = parameters["gamma"]
            if "lambda" in row:
                derivative[row["gamma"], row["lambda"]] = (
                    -parameters["gamma"] * self.ln_external_rad_s
                )
        return derivative
