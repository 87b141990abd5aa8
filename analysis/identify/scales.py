"""Uncertainty by the scales of torque and length, combined with the statistical one.

A wrong scale of the torque or a wrong length of the beam leaves no trace in the residual: other
parameters compensate it exactly. With z = beta L the response (Eq. 25) is::

    G = -(EI/L) (1 + zeta s^alpha) F(z),    z^4 = -(rho/EI L^4 s² + gamma L^4 s^lambda) / (1 + ...)

so that a session determines only EI/L, rho/EI L^4, gamma L^4, zeta and both orders. A torque that
is read too large by a factor enlarges EI and the tool inertia by this factor. The torque by air
drag is proportional to the drag parameter, to the square of the speed, which is proportional to the
length, and to the square of the length that it acts over. So every parameter is proportional to a
power of each scale (`SCALE_EXPONENTS`), and the relative variances add (JCGM 100:2008, GUM, 5.1.6).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.statistics import NORMAL_95
from rigd.beam import LOGARITHMIC_PARAMETERS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from analysis.identify._result import RecordFit
    from rigd.estimates import Estimate

_DENSITY_OVER_STIFFNESS: Final = "density_over_stiffness"
_BENDING_STIFFNESS: Final = "bending_stiffness_n_m2"
_TOOL_INERTIA: Final = "tool_inertia_kg_m2"
_COMPENSATING_PARAMETERS: Final = (_DENSITY_OVER_STIFFNESS, _BENDING_STIFFNESS)
"""Beam parameters that compensate a wrong scale."""

SCALE_EXPONENTS: Final[Mapping[str, Mapping[str, int]]] = MappingProxyType(
    {
        "gamma": {"length": -4},
        _DENSITY_OVER_STIFFNESS: {"length": -4},
        _BENDING_STIFFNESS: {"torque_scale": 1, "length": 1},
        _TOOL_INERTIA: {"torque_scale": 1},
        "drag": {"torque_scale": 1, "length": -4},
    }
)
"""Powers of torque scale and length that each parameter is proportional to. Parameters that are not
listed depend on neither: zeta, the orders, delays and filters, frequencies, damping ratios and loss
factors."""

_DENSITY_EXPONENTS: Final = {"torque_scale": 1, "length": -3}
"""Powers of torque scale and length that the mass per length, rho/EI times EI, is proportional
to."""


def parameters_compensate_scales(fit: RecordFit) -> bool:
    """Return whether free parameters of a fit compensate a wrong scale exactly.

    Parameters
    ----------
    fit : RecordFit
        Fit to a record. If a beam parameter or a tool inertia is fixed, the result is False.
    """
    has_fixed_tool_inertia = (
        _TOOL_INERTIA not in fit.interval and fit.parameters[_TOOL_INERTIA] != 0
    )
    return (
        all(parameter_name in fit.interval for parameter_name in _COMPENSATING_PARAMETERS)
        and not has_fixed_tool_inertia
    )


def with_scale_uncertainty(
    reported_parameters: Mapping[str, Estimate], scale_uncertainty: Mapping[str, float]
) -> dict[str, Estimate]:
    """Add the uncertainties of the scales, such as length, to those of the parameters.

    Parameters
    ----------
    reported_parameters : mapping of str to Estimate
        Parameters with statistical uncertainties, by the names of `RecordFit`.
    scale_uncertainty : mapping of str to float
        Relative standard uncertainties of "torque_scale" and "length", if stated.

    Returns
    -------
    dict of str to Estimate
        Parameters that have an interval and depend on a scale of stated uncertainty, with the
        combined standard uncertainty and 95 % interval.
    """
    return {
        parameter_name: _with_scale_uncertainty(
            reported_value, relative_std, is_logarithmic=parameter_name in LOGARITHMIC_PARAMETERS
        )
        for parameter_name, reported_value in reported_parameters.items()
        if reported_value.interval_95 is not None
        and (
            relative_std := _relative_scale_uncertainty(
                SCALE_EXPONENTS.get(parameter_name, {}), scale_uncertainty
            )
        )
    }


def _relative_scale_uncertainty(
    scale_exponents: Mapping[str, int], scale_uncertainty: Mapping[str, float]
) -> float:
    """Return the relative standard uncertainty of a parameter due to uncertain scales.

    `scale_exponents` are the powers of the scales, such as length, to which the parameter is
    proportional.
    """
    return math.hypot(
        *(
            scale_exponent * scale_uncertainty.get(scale_name, 0.0)
            for scale_name, scale_exponent in scale_exponents.items()
        )
    )


def _with_scale_uncertainty(
    reported_value: Estimate, relative_std: float, *, is_logarithmic: bool
) -> Estimate:
    """Return a reported value whose uncertainty includes that due to torque scale and length.

    `relative_std` is the relative uncertainty due to these scales. It is added in quadrature.
    """
    assert reported_value.interval_95 is not None
    estimated_value, (lower_end, upper_end) = reported_value.value, reported_value.interval_95
    std = math.hypot(reported_value.std or 0.0, estimated_value * relative_std)
    if is_logarithmic:
        ln_below, ln_above = (
            math.hypot(math.log(end / estimated_value), NORMAL_95 * relative_std)
            for end in (lower_end, upper_end)
        )
        interval_95 = (
            estimated_value * math.exp(-ln_below),
            estimated_value * math.exp(min(ln_above, 300.0)),
        )
    else:
        interval_half_width = NORMAL_95 * relative_std * estimated_value
        interval_95 = (
            estimated_value - math.hypot(estimated_value - lower_end, interval_half_width),
            estimated_value + math.hypot(upper_end - estimated_value, interval_half_width),
        )
        # The interval of a quantity that cannot be negative ends at 0.
        interval_95 = max(interval_95[0], 0.0), interval_95[1]
    return replace(reported_value, std=std, interval_95=interval_95)


@dataclass(frozen=True, slots=True)
class DensityCheck:
    """Comparison of the mass per length of the beam from the record with that of the file.

    A wrong torque scale, length or stated density makes them differ, and so does a tip mass or a
    soft clamp.

    Attributes
    ----------
    found_kg_per_m, found_std_kg_per_m : float
        Mass per length from the record (rho/EI times EI), with its combined standard uncertainty.
    stated_kg_per_m, stated_std_kg_per_m : float
        Mass per length that the file states, with its standard uncertainty.
    """

    found_kg_per_m: float
    found_std_kg_per_m: float
    stated_kg_per_m: float
    stated_std_kg_per_m: float

    @property
    def agree(self) -> bool:
        """Return whether estimated and stated mass per length agree within the 95 % limit."""
        density_difference = abs(self.found_kg_per_m - self.stated_kg_per_m)
        return density_difference <= NORMAL_95 * math.hypot(
            self.found_std_kg_per_m, self.stated_std_kg_per_m
        )


def density_check(
    fit: RecordFit, stated_kg_per_m: float, scale_uncertainty: Mapping[str, float]
) -> DensityCheck | None:
    """Compare the mass per length of the beam from a fit with the stated one.

    Parameters
    ----------
    fit : RecordFit
        Fit to the record.
    stated_kg_per_m : float
        Mass per length that the file states.
    scale_uncertainty : mapping of str to float
        Relative standard uncertainties of "torque_scale", "length" and "density".

    Returns
    -------
    DensityCheck or None
        None unless all three uncertainties are stated and the fit determines rho/EI and EI.
    """
    is_density_determined = all(name in fit.determined for name in _COMPENSATING_PARAMETERS)
    if not is_density_determined or not scale_uncertainty.keys() >= {
        *_DENSITY_EXPONENTS,
        "density",
    }:
        return None
    parameter_indices = [fit.determined.index(name) for name in _COMPENSATING_PARAMETERS]
    statistical_variance = float(fit.covariance[np.ix_(parameter_indices, parameter_indices)].sum())
    found_kg_per_m = fit.parameters[_DENSITY_OVER_STIFFNESS] * fit.parameters[_BENDING_STIFFNESS]
    relative_density_std = math.sqrt(
        statistical_variance
        + _relative_scale_uncertainty(_DENSITY_EXPONENTS, scale_uncertainty) ** 2
    )
    return DensityCheck(
        found_kg_per_m,
        found_kg_per_m * relative_density_std,
        stated_kg_per_m,
        stated_kg_per_m * scale_uncertainty["density"],
    )
