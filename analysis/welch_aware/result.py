"""What a Welch-aware fit finds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from analysis.identify import DampingSize, ModeEstimate, Plant
    from analysis.models import Structure


@dataclass(frozen=True, slots=True)
class WelchAwareFit:
    """One structure fitted through Welch's estimator.

    Attributes
    ----------
    structure : Structure
    weighting : str
        Name of the weighting.
    plant : Plant
        What was found, ready for `rigd.beam`.
    parameters : dict of str to float
        zeta, alpha, gamma, lambda, density_over_stiffness (s²/m⁴), bending_stiffness_n_m2, delay_s
        and tool_inertia_kg_m2, the fixed ones included; stiffness_offset_2, … if modes were free.
    std : dict of str to (float or None)
        Standard deviations of the same: 0 for the fixed ones, None for those that rest on a bound
        or that the data do not determine. They hold if the structure is right and what remains is
        noise of the torque: see `analysis.welch_aware.uncertainty`.
    interval : dict of str to ((float, float) or None)
        95 % confidence intervals of the free ones, None as above. Of the positive parameters they
        are symmetric in the logarithm.
    determined : tuple of str
        Free parameters in the order of `covariance`.
    covariance : ndarray, shape (k, k)
        Of the determined parameters, zeta, gamma, density over stiffness and stiffness counted as
        logarithms.
    at_bounds : tuple of str
        Free parameters that rest on the edge of their range.
    internal, external : DampingSize or None
        Decorrelated sizes of the damping; None where absent or not determined.
    modes : tuple of ModeEstimate
        Those within the band.
    cost : float
        Eq. (26) at the minimum over all frequencies given, in (N·m/rad)².
    response : ndarray of complex, shape (n,)
        The fitted model put through the estimator at these frequencies, in N·m/rad: to be compared
        with the measured response. What the model itself is there, ``plant`` tells.
    """

    structure: Structure
    weighting: str
    plant: Plant
    parameters: Mapping[str, float]
    std: Mapping[str, float | None]
    interval: Mapping[str, tuple[float, float] | None]
    determined: tuple[str, ...]
    covariance: NDArray[np.float64]
    at_bounds: tuple[str, ...]
    internal: DampingSize | None
    external: DampingSize | None
    modes: tuple[ModeEstimate, ...]
    cost: float
    response: NDArray[np.complex128]

    @property
    def correlation(self) -> NDArray[np.float64]:
        """Correlations of the determined parameters, shape (k, k)."""
        std = np.sqrt(np.diag(self.covariance))
        correlation: NDArray[np.float64] = self.covariance / np.outer(std, std)
        return correlation
