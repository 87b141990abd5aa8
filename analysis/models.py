"""Damping structures, their parametrization, and the settings with which they are fitted.

A structure states its parameters, its damping as a function of s, and the words for it in reports.
Types I to VI have the fixed values of Table 2 of the reference paper. Type VII follows from its
conclusions: internal damping of integer order (alpha = 1) with external damping of fractional
order. Installed packages add others (`analysis.structures`).

A coefficient and its order have almost the same effect near the frequencies where they act: a fit
of ``zeta`` and ``alpha`` themselves would follow a curved flat direction (their correlation is
-0.99). The unknowns of a fit to a frequency response (`DampingUnknowns`) are therefore the
logarithm of the damping at one frequency, and the order:

* ``ln(zeta omega_2^alpha)``: internal damping relative to the stiffness at the undamped second
  mode, and ``alpha``;
* ``ln(gamma omega_1^lambda / (rho/EI omega_1²))``: external damping relative to the inertia at the
  undamped first mode, and ``lambda``.

The whole-record fits have their own parametrization (`analysis.identify.parametrization`), in which
beam and rig are free as well.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import product
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from rigd.beam import (
    COEFFICIENT_OF,
    DAMPING_PARAMETERS,
    PARAMETERS,
    Beam,
    Damping,
    Parameter,
    undamped_frequencies_rad_s,
)
from rigd.spectral import (
    PAPER_OVERLAP_FRACTION,
    PAPER_RATE_HZ,
    WINDOW,
    Segmentation,
)

if TYPE_CHECKING:
    from rigd.spectral import Estimator


# Structures

ElasticAndExternalFactors = tuple[NDArray[np.complex128], NDArray[np.complex128]]
"""Factor of the bending stiffness, and external damping in 1/m⁴, each of the shape of s."""
DampingFunction = Callable[[NDArray[np.complex128], Mapping[str, float]], ElasticAndExternalFactors]
"""Function of s in rad/s and of the parameters by name that returns both factors of the damping."""


@dataclass(frozen=True, slots=True)
class Structure:
    """Damping structure: its parameters, which of them are free, and its damping.

    The stiffness of the beam is ``EI c(s)``, and its equation of motion has ``rho/EI s² + e(s)``.

    Attributes
    ----------
    name : str
        "I" to "VII", or the name that a package gives its structure.
    description : str
        Words for the damping, as a sentence without its full stop.
    parameters : tuple of Parameter
        Parameters with symbol, meaning, unit and range. Those of a package state ``starts``; a
        ``logarithmic`` one is fitted by its logarithm.
    factors : callable
        Function of s (complex, rad/s) and of the parameters by name. It returns c and e: the
        stiffness relative to EI, and the external damping in 1/m⁴. It must be a smooth function of
        the parameters, because finite differences approximate its derivatives.
    fixed : mapping of str to float
        Values of the parameters that are not fitted. A damping that types I to VII lack has
        coefficient and order 0.
    free : tuple of str
        Names of the fitted parameters, in the order of `parameters`.

    Examples
    --------
    >>> from analysis.models import STRUCTURES
    >>> STRUCTURES["VII"].free
    ('zeta', 'gamma', 'lambda')
    >>> STRUCTURES["VII"].damping({"zeta": 7e-5, "gamma": 0.05, "lambda": 0.6})
    Damping(zeta=7e-05, alpha=1.0, gamma=0.05, lambda_=0.6)
    """

    name: str
    description: str
    parameters: tuple[Parameter, ...]
    factors: DampingFunction
    fixed: Mapping[str, float] = field(default_factory=dict)
    free: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        parameter_names = (parameter.name for parameter in self.parameters)
        object.__setattr__(
            self, "free", tuple(name for name in parameter_names if name not in self.fixed)
        )

    @property
    def has_internal_damping(self) -> bool:
        """Whether the structure has internal damping (of the material)."""
        return "zeta" in self.free

    @property
    def has_external_damping(self) -> bool:
        """Whether the structure has external damping (of the environment)."""
        return "gamma" in self.free

    def has_damping_of(self, parameter_name: str) -> bool:
        """Return whether the structure has the kind of damping to which a parameter belongs.

        The kinds are internal and external damping. The result is True for a parameter of beam or
        rig.

        Parameters
        ----------
        parameter_name : str
            Name of a parameter of damping, beam or rig.
        """
        if parameter_name in ("zeta", "alpha"):
            return self.has_internal_damping
        if parameter_name in ("gamma", "lambda"):
            return self.has_external_damping
        return True

    def damping(self, free_values: Mapping[str, float]) -> Damping:
        """Return the damping of types I to VII with given free parameters."""
        return Damping(
            *(
                self.fixed[name] if name in self.fixed else free_values[name]
                for name in DAMPING_PARAMETERS
            )
        )

    def start_values(self) -> list[dict[str, float]]:
        """Return all combinations of the parameters' start values, each with the fixed values."""
        start_values_of_free = [
            parameter.starts for parameter in self.parameters if parameter.name not in self.fixed
        ]
        return [
            {**self.fixed, **dict(zip(self.free, combination, strict=True))}
            for combination in product(*start_values_of_free)
        ]

    def finite_factors(
        self, s: NDArray[np.complex128], parameter_values: Mapping[str, float]
    ) -> ElasticAndExternalFactors:
        """Return the factors c and e at `s`; raise ValueError unless they are finite numbers.

        Parameters
        ----------
        s : ndarray of complex, shape (n,)
            Laplace variable in rad/s, not 0.
        parameter_values : mapping of str to float
            Values of all parameters.
        """
        with np.errstate(all="ignore"):
            elastic, external = (
                np.broadcast_to(np.asarray(factor, dtype=np.complex128), s.shape)
                for factor in self.factors(s, parameter_values)
            )
        if not (np.isfinite(elastic).all() and np.isfinite(external).all()):
            raise ValueError(f"its damping is not finite at {parameters_text(parameter_values)}.")
        return elastic, external


def parameters_text(parameter_values: Mapping[str, float]) -> str:
    """Return parameters as a text, such as ``zeta = 7e-05, alpha = 1``."""
    return ", ".join(f"{name} = {value:.4g}" for name, value in parameter_values.items())


def _fractional_factors(
    s: NDArray[np.complex128], parameter_values: Mapping[str, float]
) -> ElasticAndExternalFactors:
    """Return the factors of fractional internal and external damping, as in the reference paper."""
    return (
        1 + parameter_values["zeta"] * s ** parameter_values["alpha"],
        (parameter_values["gamma"] * s ** parameter_values["lambda"]).astype(np.complex128),
    )


def _fractional_structure(name: str, description: str, fixed_values: dict[str, float]) -> Structure:
    """Return a structure of fractional damping with given fixed parameters."""
    return Structure(
        name,
        description,
        tuple(PARAMETERS[parameter] for parameter in DAMPING_PARAMETERS),
        _fractional_factors,
        fixed_values,
    )


_NO_INTERNAL_DAMPING: Final = {"zeta": 0.0, "alpha": 0.0}
"""Parameter values that mean no internal damping."""
_NO_EXTERNAL_DAMPING: Final = {"gamma": 0.0, "lambda": 0.0}
"""Parameter values that mean no external damping."""

UNDAMPED: Final = _fractional_structure(
    "undamped", "No damping", _NO_INTERNAL_DAMPING | _NO_EXTERNAL_DAMPING
)
"""Structure without damping: only the parameters of beam and rig are fitted."""

STRUCTURES: Final[Mapping[str, Structure]] = MappingProxyType(
    {
        structure.name: structure
        for structure in (
            _fractional_structure(
                "I", "Internal damping only", {"alpha": 1.0, **_NO_EXTERNAL_DAMPING}
            ),
            _fractional_structure(
                "II", "External damping only", {**_NO_INTERNAL_DAMPING, "lambda": 1.0}
            ),
            _fractional_structure(
                "III", "Internal and external damping", {"alpha": 1.0, "lambda": 1.0}
            ),
            _fractional_structure("IV", "Internal damping only", _NO_EXTERNAL_DAMPING),
            _fractional_structure("V", "External damping only", _NO_INTERNAL_DAMPING),
            _fractional_structure("VI", "Internal and external damping", {}),
            _fractional_structure("VII", "Internal and external damping", {"alpha": 1.0}),
        )
    }
)
"""Damping structures of the analyser by name, I to VII."""


# Weights of the cost

WeightingFunction = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Function from angular frequencies in rad/s to weights."""
Weighting = str | WeightingFunction
"""Name of a weighting, or its function."""

_LARGEST_WEIGHTING_EXPONENT = 10
"""Largest exponent K of a weighting omega^K; with a larger one, few points have all the weight."""


class WeightingError(ValueError):
    """Error if a weighting does not exist, or if its values are negative or not finite."""


def weights(omega_rad_s: NDArray[np.float64], weighting: Weighting) -> NDArray[np.float64]:
    """Return the weights ``W_p = p(omega_p) / sum_i p(omega_i)`` of a frequency grid.

    Parameters
    ----------
    omega_rad_s : ndarray, shape (n,)
        Angular frequencies: positive, evenly spaced.
    weighting : str or callable
        ``"const"``: p = 1, the mean square error. ``"omega"``: p = 1/omega, the mean over a
        logarithmic frequency axis. ``"omega^K"`` with a number K: p = omega**K, so that
        ``"omega"`` is the same as ``"omega^-1"``. A callable is the function p: it takes omega in
        rad/s, shape (n,), and returns values of that shape that are not negative.

    Returns
    -------
    ndarray, shape (n,)
        Weights: not negative, with a sum of 1.

    Raises
    ------
    WeightingError
        If the weighting does not exist, or its values are negative, not finite or all zero.

    Examples
    --------
    >>> import numpy as np
    >>> from analysis.models import weights
    >>> print(weights(2 * np.pi * np.array([1.0, 2.0, 4.0]), "omega").round(3))
    [0.571 0.286 0.143]
    """
    shown_name = weighting_name(weighting)
    if callable(weighting):
        unscaled_weights = np.asarray(weighting(omega_rad_s), dtype=np.float64)
        if unscaled_weights.shape != omega_rad_s.shape:
            raise WeightingError(
                f"The weighting {shown_name} gave values of shape {unscaled_weights.shape} for "
                f"{omega_rad_s.shape} frequencies; it must give one value for each."
            )
    else:
        unscaled_weights = omega_rad_s ** _weighting_exponent(weighting)
    weight_sum = float(unscaled_weights.sum())
    if not (math.isfinite(weight_sum) and weight_sum > 0 and float(unscaled_weights.min()) >= 0):
        raise WeightingError(
            f"The weighting {shown_name} must be finite, not negative and not all zero over "
            f"{float(omega_rad_s.min()):g} to {float(omega_rad_s.max()):g} rad/s."
        )
    return unscaled_weights / weight_sum


def weighting_name(weighting: Weighting) -> str:
    """Return the name of a weighting for results: its text, or the name of its function.

    Raises
    ------
    WeightingError
        If `weighting` is a text that does not name a weighting.

    Examples
    --------
    >>> from analysis.models import weighting_name
    >>> weighting_name("omega^-0.5")
    'omega^-0.5'
    """
    if callable(weighting):
        return str(getattr(weighting, "__name__", type(weighting).__name__))
    _weighting_exponent(weighting)
    return weighting


def _weighting_exponent(weighting: str) -> float:
    """Return the exponent K of a named weighting omega^K; raise if the name is not valid."""
    if weighting == "const":
        return 0.0
    if weighting == "omega":
        return -1.0
    base_name, separator, power_text = weighting.partition("^")
    try:
        exponent = float(power_text)
    except ValueError:
        exponent = math.nan
    if base_name != "omega" or not separator or not abs(exponent) <= _LARGEST_WEIGHTING_EXPONENT:
        raise WeightingError(
            f"There is no weighting {weighting!r}; choose const, omega (which is 1/omega) or "
            f"omega^K with a number K from -{_LARGEST_WEIGHTING_EXPONENT} to "
            f"{_LARGEST_WEIGHTING_EXPONENT}, such as "
            "omega^-0.5."
        )
    return exponent


# Settings of the fits

RECORD_BAND_HZ: Final = (0.0, 50.0)
"""Default frequency band of the whole-record fits, if the sampling rate is high enough."""

MAX_FREQUENCY_TO_RATE_RATIO: Final = 0.4
"""Highest frequency of a fit relative to the sampling rate; filters roll off above it."""

PAPER_BAND_HZ: Final = (0.5875, 50.0)
"""Frequency band of the Welch fits in the reference paper."""
PAPER_TYPES: Final = ("I", "II", "III", "IV", "V", "VI")
"""Structures fitted in the reference paper."""
PAPER_WEIGHTINGS: Final = ("const", "omega")
"""Weightings used in the reference paper."""

ESTIMATOR_NAMES: Final[Mapping[Estimator, str]] = {
    "h1": "Welch's H1",
    "h2": "Welch's H2",
    "hv": "Welch's Hv",
    "iv": "Welch's Hiv",
    "fft": "whole-record FFT",
}
"""Names of the estimators in reports and figures."""


def estimator_text(
    estimator: Estimator, segmentation: Segmentation, segment_count: int | str
) -> str:
    """Describe the estimator and the segments of a frequency response.

    Parameters
    ----------
    estimator : str
        Estimator as in `WelchSettings`.
    segmentation : Segmentation
        Segment length, overlap and FFT length in samples.
    segment_count : int or str
        Number of segments.

    Examples
    --------
    >>> from analysis.models import WelchSettings, estimator_text
    >>> estimator_text("h1", WelchSettings().segmentation(1000.0), 8)
    "Welch's H1, 8 Hamming segments of 17266, overlap 2590, nfft 160000"
    """
    if estimator == "fft":
        return ESTIMATOR_NAMES[estimator]
    return (
        f"{ESTIMATOR_NAMES[estimator]}, {segment_count} {WINDOW.name} segments of "
        f"{segmentation.segment_length}, overlap {segmentation.overlap}, nfft {segmentation.nfft}"
    )


@dataclass(frozen=True, slots=True)
class WelchSettings:
    """Settings of the frequency response estimate and of the fits to it.

    Attributes
    ----------
    estimator : {"h1", "h2", "hv", "iv", "fft"}
        Estimator: "iv" is Hiv, with the reference as instrument; "fft" is the ratio of the Fourier
        transforms of the whole record.
    segment_length, overlap, nfft : int, optional
        Lengths of segment, overlap and FFT in samples. None selects the durations of the reference
        paper; if only the segment is given, the overlap is 15 % of it, and the FFT is at least as
        long as the segment.
    band_hz : tuple of float
        First and last fitted frequency, both included.
    types : tuple of str
        Names of the damping structures to fit, from `analysis.models.STRUCTURES`.
    weightings : tuple of str
        Names of the weightings with which each structure is fitted (`analysis.models.weights`).
    """

    estimator: Estimator = "h1"
    segment_length: int | None = None
    overlap: int | None = None
    nfft: int | None = None
    band_hz: tuple[float, float] = PAPER_BAND_HZ
    types: tuple[str, ...] = PAPER_TYPES
    weightings: tuple[str, ...] = PAPER_WEIGHTINGS

    @property
    def are_from_paper(self) -> bool:
        """Whether estimator and segments are those of the reference paper."""
        custom_length = self.segment_length or self.overlap or self.nfft
        return self.estimator == "h1" and not custom_length

    def segmentation(self, rate_hz: float) -> Segmentation:
        """Return the lengths of segment, overlap and FFT in samples at a sampling rate.

        Lengths that are not set have the durations of the reference paper.

        Examples
        --------
        >>> from analysis.models import WelchSettings
        >>> WelchSettings().segmentation(rate_hz=500)
        Segmentation(segment_length=8633, overlap=1295, nfft=80000)
        """
        rate_ratio, paper_lengths = rate_hz / PAPER_RATE_HZ, Segmentation()
        segment_length, overlap_samples, fft_length = self.segment_length, self.overlap, self.nfft
        if overlap_samples is None:
            overlap_samples = round(
                paper_lengths.overlap * rate_ratio
                if segment_length is None
                else PAPER_OVERLAP_FRACTION * segment_length
            )
        if segment_length is None:
            segment_length = round(paper_lengths.segment_length * rate_ratio)
        if fft_length is None:
            fft_length = max(round(paper_lengths.nfft * rate_ratio), segment_length)
        return Segmentation(segment_length, overlap_samples, fft_length)


# Unknowns of a fit to a frequency response

ORDER_RANGE: Final = (0.001, 1.999)
"""Range of the orders alpha and lambda, as in the reference paper."""

RELATIVE_DAMPING_RANGE: Final = (1e-9, 1e3)
"""Range of damping relative to stiffness or inertia, from too small to be visible to too large
for a vibration. It is much wider than the range of the reference paper, which its own results
exceed (type IV with 1/omega weights has zeta = 2.4e-3, but the range ends at 3.05e-4)."""


@dataclass(frozen=True, slots=True)
class DampingUnknowns:
    """Conversion between damping parameters and the unknowns of a fit to a frequency response.

    The unknowns are in the order of ``structure.free`` (see `analysis.models`).
    """

    structure: Structure
    """Damping structure, which defines the free parameters."""
    ln_internal_reference_rad_s: float
    """Logarithm of the undamped second mode's frequency, at which internal damping is stated."""
    ln_external_reference_rad_s: float
    """Logarithm of the undamped first mode's frequency, at which external damping is stated."""
    ln_external_unit: float
    """Logarithm of ``rho/EI omega²`` at the first mode, the unit of external damping."""

    @classmethod
    def for_beam(cls, structure: Structure, beam: Beam) -> DampingUnknowns:
        """Return the unknowns with the undamped modes of a beam as reference frequencies.

        Parameters
        ----------
        structure : Structure
            Damping structure, which defines the free parameters.
        beam : Beam
            Beam whose first two undamped modes are the reference frequencies.
        """
        first_rad_s, second_rad_s = (float(w) for w in undamped_frequencies_rad_s(beam, 2))
        return cls(
            structure=structure,
            ln_internal_reference_rad_s=math.log(second_rad_s),
            ln_external_reference_rad_s=math.log(first_rad_s),
            ln_external_unit=math.log(beam.density_over_stiffness * first_rad_s**2),
        )

    @property
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lower and upper bounds of the unknowns, each of shape (k,)."""
        unknown_ranges = [
            ORDER_RANGE
            if parameter_name in ("alpha", "lambda")
            else tuple(map(math.log, RELATIVE_DAMPING_RANGE))
            for parameter_name in self.structure.free
        ]
        return np.array([low for low, _ in unknown_ranges]), np.array(
            [upper_bound for _, upper_bound in unknown_ranges]
        )

    def parameters(self, x: NDArray[np.float64]) -> dict[str, float]:
        """Return the four damping parameters for unknowns `x`, shape (k,)."""
        free_unknowns: dict[str, float] = dict(zip(self.structure.free, map(float, x), strict=True))
        parameters = {**self.structure.fixed, **free_unknowns}
        if self.structure.has_internal_damping:
            parameters["zeta"] = math.exp(
                free_unknowns["zeta"] - parameters["alpha"] * self.ln_internal_reference_rad_s
            )
        if self.structure.has_external_damping:
            parameters["gamma"] = math.exp(
                free_unknowns["gamma"]
                + self.ln_external_unit
                - parameters["lambda"] * self.ln_external_reference_rad_s
            )
        return parameters

    def damping(self, x: NDArray[np.float64]) -> Damping:
        """Return the damping for unknowns `x`, shape (k,)."""
        return self.structure.damping(self.parameters(x))

    def derivative_of_parameters(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the derivatives of the free parameters with respect to the unknowns, (k, k).

        Rows are parameters, columns unknowns. An order also changes its coefficient, because the
        damping at the reference frequency is constant.
        """
        parameters = self.parameters(x)
        unknown_indices = {name: i for i, name in enumerate(self.structure.free)}
        derivative_matrix = np.eye(len(unknown_indices))
        ln_reference_rad_s_by_order = {
            "alpha": self.ln_internal_reference_rad_s,
            "lambda": self.ln_external_reference_rad_s,
        }
        for order, coefficient in COEFFICIENT_OF.items():
            if coefficient in unknown_indices:
                derivative_matrix[unknown_indices[coefficient], unknown_indices[coefficient]] = (
                    parameters[coefficient]
                )
                if order in unknown_indices:
                    coefficient_slope = (
                        -parameters[coefficient] * ln_reference_rad_s_by_order[order]
                    )
                    derivative_matrix[unknown_indices[coefficient], unknown_indices[order]] = (
                        coefficient_slope
                    )
        return derivative_matrix
