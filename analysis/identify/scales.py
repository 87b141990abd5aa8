"""Uncertainty by the scales of torque and length, combined with the statistical one.

A wrong scale of the torque or a wrong length of the beam leaves no trace in the residual: other
parameters compensate it exactly. With z = beta L the response (Eq. 25) is::

    G = -(EI/L) (1 + zeta s^alpha) F(z),    z^4 = -(rho/EI L^4 s² + gamma L^4 s^lambda) / (1 + ...)

so that a session determines EI/L, rho/EI L^4, gamma L^4, zeta and both orders only. A torque that
is read too large by a factor enlarges EI by it, and the tool inertia with it; the drag of the air
goes with the torque and with the square of the speed, which goes with the length, times the square
of the length that it acts over. So every parameter goes with a power of each scale
(`SCALE_EXPONENTS`), and the relative variances add (JCGM 100:2008, GUM, 5.1.6).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._plant import LOGARITHMIC
from analysis.statistics import NORMAL_95

if TYPE_CHECKING:
    from collections.abc import Mapping

    from analysis.identify._result import RecordFit
    from analysis.identify.headline import ReportedValue

_RATIO: Final = "density_over_stiffness"
_STIFFNESS: Final = "bending_stiffness_n_m2"
_TOOL: Final = "tool_inertia_kg_m2"
_ABSORBING: Final = (_RATIO, _STIFFNESS)

SCALE_EXPONENTS: Final[Mapping[str, Mapping[str, int]]] = MappingProxyType(
    {
        "gamma": {"length": -4},
        _RATIO: {"length": -4},
        _STIFFNESS: {"torque_scale": 1, "length": 1},
        _TOOL: {"torque_scale": 1},
        "drag": {"torque_scale": 1, "length": -4},
    }
)
"""Powers of the scales that a parameter goes with; what is not named depends on none: zeta, the
orders, delays and filters, frequencies, damping ratios and loss factors."""

_OF_DENSITY: Final = {"torque_scale": 1, "length": -3}
"""The same of the mass per length, rho/EI times EI."""


def scales_absorbed(fit: RecordFit) -> bool:
    """Return whether the parameters absorb a wrong scale: false if some of them are held.

    Parameters
    ----------
    fit : RecordFit
    """
    held_tool = _TOOL not in fit.interval and fit.parameters[_TOOL] != 0
    return all(name in fit.interval for name in _ABSORBING) and not held_tool


def with_scales(
    parameters: Mapping[str, ReportedValue], uncertainty: Mapping[str, float]
) -> dict[str, ReportedValue]:
    """Combine statistical uncertainties with those of the scales.

    Parameters
    ----------
    parameters : mapping of str to ReportedValue
        By the names of `RecordFit`, with statistical uncertainties.
    uncertainty : mapping of str to float
        Relative standard uncertainties by scale: "torque_scale", "length".

    Returns
    -------
    dict of str to ReportedValue
        Parameters with an interval that depend on a scale of given uncertainty, with the combined
        standard uncertainty and 95 % interval.
    """
    return {
        name: _combined(each, relative, logarithmic=name in LOGARITHMIC)
        for name, each in parameters.items()
        if each.interval_95 is not None
        and (relative := _relative(SCALE_EXPONENTS.get(name, {}), uncertainty))
    }


def _relative(exponents: Mapping[str, int], uncertainty: Mapping[str, float]) -> float:
    return math.hypot(*(power * uncertainty.get(scale, 0.0) for scale, power in exponents.items()))


def _combined(quantity: ReportedValue, relative: float, *, logarithmic: bool) -> ReportedValue:
    """Widen an interval on either side by the uncertainty of the scales, in quadrature."""
    assert quantity.interval_95 is not None
    value, (low, high) = quantity.value, quantity.interval_95
    std = math.hypot(quantity.std or 0.0, value * relative)
    if logarithmic:
        below, above = (
            math.hypot(math.log(end / value), NORMAL_95 * relative) for end in (low, high)
        )
        ends = value * math.exp(-below), value * math.exp(min(above, 300.0))
    else:
        half = NORMAL_95 * relative * value
        ends = value - math.hypot(value - low, half), value + math.hypot(high - value, half)
        # What cannot be negative ends at 0.
        ends = max(ends[0], 0.0), ends[1]
    return replace(quantity, std=std, interval_95=ends)


@dataclass(frozen=True, slots=True)
class DensityCheck:
    """Mass per length of the beam from the record, compared with that of the file.

    They agree only if torque scale and length are right.

    Attributes
    ----------
    found_kg_per_m, found_std_kg_per_m : float
        rho/EI times EI, with the combined standard uncertainty.
    stated_kg_per_m, stated_std_kg_per_m : float
        Value of the file with its standard uncertainty.
    """

    found_kg_per_m: float
    found_std_kg_per_m: float
    stated_kg_per_m: float
    stated_std_kg_per_m: float

    @property
    def agree(self) -> bool:
        """Return whether they differ by no more than the 95 % limit of chance."""
        apart = abs(self.found_kg_per_m - self.stated_kg_per_m)
        return apart <= NORMAL_95 * math.hypot(self.found_std_kg_per_m, self.stated_std_kg_per_m)


def density_check(
    fit: RecordFit, stated_kg_per_m: float, uncertainty: Mapping[str, float]
) -> DensityCheck | None:
    """Compare the mass per length of a record with the stated one.

    Parameters
    ----------
    fit : RecordFit
    stated_kg_per_m : float
        Value of the file.
    uncertainty : mapping of str to float
        Relative standard uncertainties of "torque_scale", "length" and "density".

    Returns
    -------
    DensityCheck or None
        None unless all three are stated and the fit determines rho/EI and EI.
    """
    determined = all(name in fit.determined for name in _ABSORBING)
    if not determined or not uncertainty.keys() >= {*_OF_DENSITY, "density"}:
        return None
    indices = [fit.determined.index(name) for name in _ABSORBING]
    own = float(fit.covariance[np.ix_(indices, indices)].sum())
    found = fit.parameters[_RATIO] * fit.parameters[_STIFFNESS]
    relative = math.sqrt(own + _relative(_OF_DENSITY, uncertainty) ** 2)
    return DensityCheck(
        found, found * relative, stated_kg_per_m, stated_kg_per_m * uncertainty["density"]
    )
