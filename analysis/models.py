"""Damping structures, their parametrization, and the settings with which they are fitted.

A structure says which damping parameters are fitted and which stay fixed. Types I to VI have the
fixed values of Table 2 of the reference paper. Type VII follows from its conclusions: internal
damping of integer order (alpha = 1) with external damping of fractional order.

A coefficient and its order are almost interchangeable near the frequencies where they act: a fit of
``zeta`` and ``alpha`` themselves descends along a curved flat direction (their correlation is
-0.99). So the unknowns of a fit to a frequency response (`DampingUnknowns`) are the logarithm of
the damping's size at one frequency, and the order:

* ``ln(zeta omega_2^alpha)``: internal damping relative to the stiffness at the undamped second
  mode, and ``alpha``;
* ``ln(gamma omega_1^lambda / (rho/EI omega_1²))``: external damping relative to the inertia at the
  undamped first mode, and ``lambda``.

The whole-record fits have their own parametrization (`analysis.identify.parametrization`), in which
beam and rig are free as well.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
from numpy.typing import NDArray

from rigd.beam import Beam, Damping, TransferGrid, undamped_frequencies_rad_s
from rigd.spectral import (
    PAPER_OVERLAP_FRACTION,
    PAPER_RATE_HZ,
    Segmentation,
)

if TYPE_CHECKING:
    from rigd.spectral import Estimator


# Structures

Parameter = Literal["zeta", "alpha", "gamma", "lambda"]
PARAMETERS: Final[tuple[Parameter, ...]] = ("zeta", "alpha", "gamma", "lambda")
COEFFICIENT_OF: Final[Mapping[str, Parameter]] = MappingProxyType(
    {"alpha": "zeta", "lambda": "gamma"}
)
"""The coefficient that belongs to an order of the damping, and means nothing without it."""

QUANTITIES: Final[Mapping[str, tuple[str, str, str, float]]] = MappingProxyType(
    {
        "zeta": ("ζ", "internal damping", "1e-5 s^α", 1e5),
        "alpha": ("α", "its order", "1", 1.0),
        "gamma": ("γ", "external damping", "1e-2 s^λ/m⁴", 1e2),
        "lambda": ("λ", "its order", "1", 1.0),
        "density_over_stiffness": ("ρ/EI", "density over stiffness", "1e-3 s²/m⁴", 1e3),
        "bending_stiffness_n_m2": ("EI", "bending stiffness", "N·m²", 1.0),
        "delay_s": ("τ", "torque-channel delay", "µs", 1e6),
        "tool_inertia_kg_m2": ("J", "tool inertia", "1e-6 kg·m²", 1e6),
        "tip_mass_kg": ("m", "mass at the tip", "g", 1e3),
        "filter_time_constant_s": ("T", "first-order filter of the torque", "ms", 1e3),
        "second_order_filter_time_constant_s": (
            "T", "second-order filter of the torque", "ms", 1e3,
        ),
        "drag": ("C_D d", "drag of the air", "mm", 1e3),
    }
)  # fmt: skip
"""Parameters of damping, beam and rig: symbol, meaning, unit shown, and how many of that make one
SI unit."""


@dataclass(frozen=True, slots=True)
class Structure:
    """Choice of free and fixed damping parameters.

    Attributes
    ----------
    name : str
        "I" to "VII".
    free : tuple of str
        Parameters to be fitted, in the order of `PARAMETERS`.
    fixed : mapping of str to float
        The others with their values. An order of 0 belongs to a coefficient of 0: absent damping.

    Examples
    --------
    >>> from analysis.models import STRUCTURES
    >>> STRUCTURES["VII"].free
    ('zeta', 'gamma', 'lambda')
    >>> STRUCTURES["VII"].damping({"zeta": 7e-5, "gamma": 0.05, "lambda": 0.6})
    Damping(zeta=7e-05, alpha=1.0, gamma=0.05, lambda_=0.6)
    """

    name: str
    free: tuple[Parameter, ...]
    fixed: Mapping[Parameter, float]

    @property
    def internal(self) -> bool:
        """Return whether the structure has internal damping (of the material)."""
        return "zeta" in self.free

    @property
    def external(self) -> bool:
        """Return whether the structure has external damping (of the environment)."""
        return "gamma" in self.free

    def has(self, name: str) -> bool:
        """Return whether a parameter has a meaning in the structure (always for beam and rig).

        Parameters
        ----------
        name : str
            A name of `PARAMETERS`, or a parameter of beam or rig.
        """
        if name in ("zeta", "alpha"):
            return self.internal
        if name in ("gamma", "lambda"):
            return self.external
        return True

    def damping(self, values: Mapping[Parameter, float]) -> Damping:
        """Complete the free parameters' `values` with the fixed ones."""
        every = {**self.fixed, **{name: values[name] for name in self.free}}
        return Damping(
            zeta=every["zeta"],
            alpha=every["alpha"],
            gamma=every["gamma"],
            lambda_=every["lambda"],
        )


def _structure(name: str, fixed: dict[Parameter, float]) -> Structure:
    free = tuple(p for p in PARAMETERS if p not in fixed)
    return Structure(name, free, MappingProxyType(fixed))


STRUCTURES: Final[Mapping[str, Structure]] = MappingProxyType(
    {
        structure.name: structure
        for structure in (
            _structure("I", {"alpha": 1.0, "gamma": 0.0, "lambda": 0.0}),
            _structure("II", {"zeta": 0.0, "alpha": 0.0, "lambda": 1.0}),
            _structure("III", {"alpha": 1.0, "lambda": 1.0}),
            _structure("IV", {"gamma": 0.0, "lambda": 0.0}),
            _structure("V", {"zeta": 0.0, "alpha": 0.0}),
            _structure("VI", {}),
            _structure("VII", {"alpha": 1.0}),
        )
    }
)


# Response of a structure


class FrequencyResponseModel:
    """Model of torque per motor angle, ``G(j omega) + J_tool (j omega)²``, on a frequency grid.

    The torque sensor is under the clamp, so its signal includes the tool inertia. This inertia is
    added to the model, and never subtracted from the data.

    Parameters
    ----------
    frequency_hz : ndarray, shape (n,)
    beam : Beam
    tool_inertia_kg_m2 : float
        Inertia between the sensor and the beam about the motor's axis.

    Examples
    --------
    >>> import numpy as np
    >>> from analysis.models import FrequencyResponseModel
    >>> from rigd.beam import Beam, Damping
    >>> beam = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.0903)
    >>> model = FrequencyResponseModel(np.array([1.0, 10.0]), beam, tool_inertia_kg_m2=1e-5)
    >>> print(np.abs(model.evaluate(Damping(zeta=1e-4))).round(4))
    [0.0688 0.0911]
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
        """Return the response in N·m/rad, shape (n,)."""
        return self._grid.evaluate(self.beam, damping) + self._tool

    def evaluate_with_gradient(
        self, damping: Damping, wrt: Sequence[str]
    ) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Return the response, shape (n,), and its derivatives by the parameters `wrt`, (k, n).

        Parameters
        ----------
        damping : Damping
            Where the response is evaluated.
        wrt : sequence of str
            Names of `rigd.beam.PARAMETERS`.
        """
        response, gradient = self._grid.evaluate_with_gradient(self.beam, damping, wrt)
        return response + self._tool, gradient


# Weights of the cost

WeightingFunction = Callable[[NDArray[np.float64]], NDArray[np.float64]]
Weighting = str | WeightingFunction

_LARGEST_POWER = 10
"""Beyond it, a handful of points at one end of the band would have all the weight."""


class WeightingError(ValueError):
    """The weighting does not exist, or is not positive and finite where it is used."""


def weights(omega_rad_s: NDArray[np.float64], weighting: Weighting) -> NDArray[np.float64]:
    """Return weights ``W_p = p(omega_p) / sum_i p(omega_i)`` on an evenly spaced grid (A5).

    Parameters
    ----------
    omega_rad_s : ndarray, shape (n,)
        Positive.
    weighting : str or callable
        ``"const"``: p = 1, the mean square error. ``"omega"``: p = 1/omega, the mean over a
        logarithmic frequency axis. ``"omega^K"`` with a number K: p = omega**K, so that
        ``"omega"`` is ``"omega^-1"`` by another name. A callable is p itself: omega in rad/s,
        shape (n,), to values of that shape that are not negative.

    Returns
    -------
    ndarray, shape (n,)
        Not negative, of sum 1.

    Raises
    ------
    WeightingError
        If there is no such weighting, or its values are negative, not finite or all zero.

    Examples
    --------
    >>> import numpy as np
    >>> from analysis.models import weights
    >>> print(weights(2 * np.pi * np.array([1.0, 2.0, 4.0]), "omega").round(3))
    [0.571 0.286 0.143]
    """
    name = weighting_name(weighting)
    if callable(weighting):
        p = np.asarray(weighting(omega_rad_s), dtype=np.float64)
        if p.shape != omega_rad_s.shape:
            raise WeightingError(
                f"The weighting {name} gave values of shape {p.shape} for {omega_rad_s.shape} "
                "frequencies; it must give one value for each."
            )
    else:
        p = omega_rad_s ** _exponent(weighting)
    total = float(p.sum())
    if not (math.isfinite(total) and total > 0 and float(p.min()) >= 0):
        raise WeightingError(
            f"The weighting {name} must be finite, not negative and not all zero over "
            f"{float(omega_rad_s.min()):g} to {float(omega_rad_s.max()):g} rad/s."
        )
    return p / total


def weighting_name(weighting: Weighting) -> str:
    """Return the name of a weighting in results: its own name, or that of its function.

    Raises
    ------
    WeightingError
        If there is no weighting of that name.

    Examples
    --------
    >>> from analysis.models import weighting_name
    >>> weighting_name("omega^-0.5")
    'omega^-0.5'
    """
    if callable(weighting):
        return str(getattr(weighting, "__name__", type(weighting).__name__))
    _exponent(weighting)
    return weighting


def _exponent(weighting: str) -> float:
    if weighting == "const":
        return 0.0
    if weighting == "omega":
        return -1.0
    base, separator, power = weighting.partition("^")
    try:
        exponent = float(power)
    except ValueError:
        exponent = math.nan
    if base != "omega" or not separator or not abs(exponent) <= _LARGEST_POWER:
        raise WeightingError(
            f"There is no weighting {weighting!r}; choose const, omega (which is 1/omega) or "
            f"omega^K with a number K from -{_LARGEST_POWER} to {_LARGEST_POWER}, such as "
            "omega^-0.5."
        )
    return exponent


# Settings of the fits

RECORD_BAND_HZ: Final = (0.0, 50.0)
"""Band of the whole-record fits, where the record's rate holds it."""

LARGEST_FRACTION_OF_RATE: Final = 0.4
"""Highest frequency that is fitted, over the sampling rate: filters need room up to half of it."""

PAPER_BAND_HZ: Final = (0.5875, 50.0)
PAPER_TYPES: Final = ("I", "II", "III", "IV", "V", "VI")
PAPER_WEIGHTINGS: Final = ("const", "omega")

ESTIMATOR_WORDS: Final[Mapping[Estimator, str]] = {
    "h1": "Welch's H1",
    "h2": "Welch's H2",
    "hv": "Welch's Hv",
    "iv": "Welch's Hiv",
    "fft": "whole-record FFT",
}
"""What reports and figures call an estimator."""


def estimate_text(estimator: Estimator, segmentation: Segmentation, segments: int | str) -> str:
    """Describe how a frequency response was estimated.

    Parameters
    ----------
    estimator : str
        As of `WelchSettings`.
    segmentation : Segmentation
        Lengths in samples.
    segments : int or str
        Number of segments.

    Examples
    --------
    >>> from analysis.models import WelchSettings, estimate_text
    >>> estimate_text("h1", WelchSettings().segmentation(1000.0), 8)
    "Welch's H1, 8 Hamming segments of 17266, overlap 2590, nfft 160000"
    """
    if estimator == "fft":
        return ESTIMATOR_WORDS[estimator]
    return (
        f"{ESTIMATOR_WORDS[estimator]}, {segments} Hamming segments of "
        f"{segmentation.segment_length}, overlap {segmentation.overlap}, nfft {segmentation.nfft}"
    )


@dataclass(frozen=True, slots=True)
class WelchSettings:
    """Settings of the frequency response estimate and of the fits to it.

    Attributes
    ----------
    estimator : {"h1", "h2", "hv", "iv", "fft"}
        "iv" is Hiv, with the reference as instrument; "fft" is the ratio of two
        transforms of the whole record.
    segment_length, overlap, nfft : int, optional
        In samples. None selects the durations of the reference paper at the record's rate; with a
        given segment, 15 % of it as overlap and a transform no shorter than it.
    band_hz : tuple of float
        First and last frequency fitted, both included.
    types : tuple of str
        Names of `analysis.models.STRUCTURES`.
    weightings : tuple of str
        Names that `analysis.models.weights` knows.
    """

    estimator: Estimator = "h1"
    segment_length: int | None = None
    overlap: int | None = None
    nfft: int | None = None
    band_hz: tuple[float, float] = PAPER_BAND_HZ
    types: tuple[str, ...] = PAPER_TYPES
    weightings: tuple[str, ...] = PAPER_WEIGHTINGS

    @property
    def are_usual(self) -> bool:
        """Return whether estimator and segments are those of the reference paper."""
        chosen = self.segment_length or self.overlap or self.nfft
        return self.estimator == "h1" and not chosen

    def segmentation(self, rate_hz: float) -> Segmentation:
        """Return the segmentation in samples at a rate.

        The durations of the reference paper are the defaults.

        Examples
        --------
        >>> from analysis.models import WelchSettings
        >>> WelchSettings().segmentation(rate_hz=500)
        Segmentation(segment_length=8633, overlap=1295, nfft=80000)
        """
        scale, paper = rate_hz / PAPER_RATE_HZ, Segmentation()
        length, overlap, nfft = self.segment_length, self.overlap, self.nfft
        if overlap is None:
            overlap = round(
                paper.overlap * scale if length is None else PAPER_OVERLAP_FRACTION * length
            )
        if length is None:
            length = round(paper.segment_length * scale)
        if nfft is None:
            nfft = max(round(paper.nfft * scale), length)
        return Segmentation(length, overlap, nfft)


# Unknowns of a fit to a frequency response

# Orders as the paper sweeps them, inside (0, 2). Sizes run from what no response could show to
# far beyond what lets a beam vibrate, much wider than the paper's sweep, which its own results
# leave (type IV with 1/omega weights has zeta = 2.4e-3, the sweep ends at 3.05e-4).
ORDER_RANGE: Final = (0.001, 1.999)
SIZE_RANGE: Final = (1e-9, 1e3)


@dataclass(frozen=True, slots=True)
class DampingUnknowns:
    """Vector of unknowns of one structure on one beam, in the order of ``structure.free``."""

    structure: Structure
    """Says which parameters are free."""
    ln_internal_rad_s: float
    """ln of the undamped second mode, where internal damping is sized."""
    ln_external_rad_s: float
    """ln of the undamped first mode, where external damping is sized."""
    ln_external_unit: float
    """ln of the inertia there, ``rho/EI omega²``."""

    @classmethod
    def of(cls, structure: Structure, beam: Beam) -> DampingUnknowns:
        """Return the unknowns with the beam's own modes as reference frequencies of the damping.

        Parameters
        ----------
        structure : Structure
            Says which parameters are free.
        beam : Beam
            Beam whose first two undamped modes are taken.
        """
        first, second = (float(w) for w in undamped_frequencies_rad_s(beam, 2))
        return cls(
            structure=structure,
            ln_internal_rad_s=math.log(second),
            ln_external_rad_s=math.log(first),
            ln_external_unit=math.log(beam.density_over_stiffness * first**2),
        )

    @property
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return lower and upper bounds, shape (k,)."""
        ranges = [
            ORDER_RANGE if name in ("alpha", "lambda") else tuple(map(math.log, SIZE_RANGE))
            for name in self.structure.free
        ]
        return np.array([low for low, _ in ranges]), np.array([high for _, high in ranges])

    def parameters(self, x: NDArray[np.float64]) -> dict[Parameter, float]:
        """Return all four damping parameters at `x`."""
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
        """Return the damping at `x`."""
        return self.structure.damping(self.parameters(x))

    def derivative_of_parameters(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Differentiate the free parameters by the unknowns, shape (k, k): [parameter, unknown].

        An order changes its coefficient too, since the size is constant.
        """
        parameters = self.parameters(x)
        row = {name: i for i, name in enumerate(self.structure.free)}
        derivative = np.eye(len(row))
        ln_rad_s = {"alpha": self.ln_internal_rad_s, "lambda": self.ln_external_rad_s}
        for order, coefficient in COEFFICIENT_OF.items():
            if coefficient in row:
                derivative[row[coefficient], row[coefficient]] = parameters[coefficient]
                if order in row:
                    slope = -parameters[coefficient] * ln_rad_s[order]
                    derivative[row[coefficient], row[order]] = slope
        return derivative
