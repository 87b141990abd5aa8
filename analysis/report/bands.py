"""95 % bands of a fit's curves, and the band in which a record determines the damping."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Protocol

import numpy as np

from analysis.identify import LOGARITHMIC, ResponseGrid
from analysis.identify.uniform_beam import PARAMETERS
from analysis.models import STRUCTURES
from analysis.statistics import NORMAL_95

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from analysis.identify import ModalFit, Plant, RecordAnalysis
    from analysis.identify.uniform_beam import TolerantEstimate
    from analysis.models import Structure
    from analysis.record import Record
    from analysis.results import WholeRecord

    Band = tuple[float, float]

    Real = NDArray[np.float64]

_BLOCK: Final = 24
_OVER_NOISE: Final = 4.0
"""Mean power of a block over the noise's. By chance it exceeds 2 in one of 10 000 blocks."""


def supported_band_hz(whole: WholeRecord) -> Band | None:
    """Return the band in which the selected fit's loss factors are supported by data.

    The modes show the damping. A model whose orders the data support is also right between and
    beyond them, as far as the beam was excited; one with an order that they do not support only
    interpolates between the modes that show.

    Returns
    -------
    tuple of float or None
        First and last frequency in Hz; None if there is no such band.
    """
    if not whole.withheld:
        return excited_band_hz(whole.record, whole.analysis)
    frequencies = [mode.frequency_hz.value for mode in whole.headline.modes if mode.shown]
    if len(frequencies) < 2:
        return None
    return min(frequencies), max(frequencies)


def excited_band_hz(record: Record, analysis: RecordAnalysis) -> Band | None:
    """Return the frequencies between which the measured torque exceeds the noise.

    Parameters
    ----------
    record : Record
    analysis : RecordAnalysis
        Whose noise is taken, and whose band limits the answer.

    Returns
    -------
    tuple of float or None
        In Hz; None if it never does.
    """
    torque = record.torque_nm - record.torque_nm.mean()
    frequency_hz = np.fft.rfftfreq(torque.size, 1 / record.rate_hz)
    inside = (frequency_hz >= analysis.frequency_hz[0]) & (
        frequency_hz <= analysis.frequency_hz[-1]
    )
    # A line is not an excitation, and what is compared has none.
    nearest = np.searchsorted(analysis.frequency_hz, frequency_hz[inside])
    inside[inside] = analysis.compared[np.minimum(nearest, analysis.compared.size - 1)]
    power = np.abs(np.fft.rfft(torque)[inside]) ** 2 * 2 / (torque.size * record.rate_hz)
    over = power / np.interp(frequency_hz[inside], analysis.frequency_hz, analysis.noise_nm2_per_hz)
    whole = over.size - over.size % _BLOCK
    loud = np.flatnonzero(over[:whole].reshape(-1, _BLOCK).mean(axis=1) > _OVER_NOISE)
    if loud.size == 0:
        return None
    edges_hz = frequency_hz[inside]
    return float(edges_hz[loud[0] * _BLOCK]), float(edges_hz[(loud[-1] + 1) * _BLOCK - 1])


class Estimate(Protocol):
    """Fitted plant with the covariance of its parameters, as a `RecordFit` has them."""

    @property
    def structure(self) -> Structure:
        """Structure of the damping."""

    @property
    def plant(self) -> Plant:
        """Fitted plant."""

    @property
    def parameters(self) -> Mapping[str, float]:
        """The same by name."""

    @property
    def determined(self) -> tuple[str, ...]:
        """Parameters in the order of the covariance."""

    @property
    def covariance(self) -> Real:
        """Covariance of these; of positive ones that of the logarithms."""


@dataclass(frozen=True, slots=True)
class NearlyUniformBeam:
    """Beam estimated with a tolerance of the geometry, as an `Estimate`.

    Attributes
    ----------
    structure : Structure
    plant : Plant
    parameters : mapping of str to float
    determined : tuple of str
    covariance : ndarray, shape (7, 7)
    """

    structure: Structure
    plant: Plant
    parameters: Mapping[str, float]
    determined: tuple[str, ...]
    covariance: Real

    @classmethod
    def of(cls, found: TolerantEstimate) -> NearlyUniformBeam:
        """Return it for an estimate with both orders free."""
        return cls(STRUCTURES["VI"], found.plant, found.values, PARAMETERS, found.covariance)


def loss_estimate(whole: WholeRecord) -> Estimate | None:
    """Choose the beam whose loss factors are drawn over frequency; None if none explains them."""
    headline = whole.headline
    if headline.tolerant is not None:
        return (
            None if headline.tolerant.basis == "none" else NearlyUniformBeam.of(headline.tolerant)
        )
    refused = headline.uniform_beam is not None and headline.uniform_beam.status == "refused"
    return None if refused else whole.fit


_GRID_POINTS: Final = 900


def dense_grid(first_hz: float, last_hz: float, peaks_hz: Sequence[float]) -> Real:
    """Frequencies that are dense over a band and denser at the peaks, which are narrow.

    Parameters
    ----------
    first_hz, last_hz : float
        Ends of the band, positive.
    peaks_hz : sequence of float
        Frequencies of the peaks; those outside of the band are left out.

    Returns
    -------
    ndarray, shape (n,)
    """
    everywhere = np.geomspace(first_hz, last_hz, _GRID_POINTS)
    offsets = np.geomspace(1e-4, 0.1, 40)
    near = [peak * (1 + np.r_[-offsets, 0.0, offsets]) for peak in peaks_hz]
    grid = np.unique(np.concatenate([everywhere, *near]))
    return np.asarray(grid[(grid >= first_hz) & (grid <= last_hz)])


_QUARTER_TURN: Final = np.pi / 2
_GRADIENT_NAMES: Final = {
    "density_over_stiffness": "ln_density_over_stiffness",
    "bending_stiffness_n_m2": "ln_stiffness",
}
"""Parameters by whose logarithm the response is differentiated already."""


@dataclass(frozen=True, slots=True)
class ResponseBand:
    """Frequency response of a fitted plant, with its uncertainty.

    Attributes
    ----------
    frequency_hz : ndarray, shape (n,)
    response : ndarray of complex, shape (n,)
        Torque per angle in N·m/rad, without a delay between the channels.
    log_magnitude_std : ndarray, shape (n,)
        Standard deviation of ln |response|: the relative one of the magnitude.
    phase_std_rad : ndarray, shape (n,)
    """

    frequency_hz: Real
    response: NDArray[np.complex128]
    log_magnitude_std: Real
    phase_std_rad: Real

    def magnitude_limits(self) -> tuple[Real, Real]:
        """Lower and upper limit of the magnitude's 95 % band in N·m/rad, shape (n,) each."""
        return _limits(np.abs(self.response), self.log_magnitude_std)


def response_band(fit: Estimate, frequency_hz: Real) -> ResponseBand:
    """Propagate a fit's covariance to its frequency response.

    Parameters
    ----------
    fit : Estimate
    frequency_hz : ndarray, shape (n,)
        Positive.

    Notes
    -----
    With g the derivatives of ln H by the determined parameters and C their covariance, the
    variance of ln |H| is ``Re g C Re g'`` and that of the phase ``Im g C Im g'``. Parameters that
    are fixed, or that the data do not determine, count as known.
    """
    plant: Plant = replace(fit.plant, delay_s=0.0)
    # The delay turns the measured phase, not that of beam and clamp.
    rows = [i for i, name in enumerate(fit.determined) if name != "delay_s"]
    names = [fit.determined[i] for i in rows]
    response, *derivatives = ResponseGrid(2j * np.pi * frequency_hz).evaluate(
        plant, [_GRADIENT_NAMES.get(name, name) for name in names]
    )
    gradient = np.empty((len(names), frequency_hz.size), dtype=np.complex128)
    for row, name, derivative in zip(gradient, names, derivatives, strict=True):
        as_logarithm = name in LOGARITHMIC and name not in _GRADIENT_NAMES
        row[:] = derivative * (fit.parameters[name] if as_logarithm else 1.0) / response
    covariance = fit.covariance[np.ix_(rows, rows)]
    return ResponseBand(
        frequency_hz=frequency_hz,
        response=response,
        log_magnitude_std=_std(gradient.real, covariance),
        phase_std_rad=_std(gradient.imag, covariance),
    )


def modal_response_band(fit: ModalFit, frequency_hz: Real, delay_s: float = 0.0) -> ResponseBand:
    """Propagate the covariance of a modal model to its frequency response.

    Parameters
    ----------
    fit : ModalFit
    frequency_hz : ndarray, shape (n,)
        Positive.
    delay_s : float
        Delay of the torque against the angle that is taken out: the one that the file states.
    """
    s = 2j * np.pi * frequency_hz
    response = fit.model.response(s)
    rows = []
    for pole, residue in zip(fit.model.poles_rad_s, fit.model.residues, strict=True):
        ratio = -pole.real / abs(pole)
        # By ln frequency and ln damping ratio; those of the residue are residue and j residue
        by_pole = (pole, -ratio * pole.imag / (1 - ratio * ratio) ** 1.5)
        first, second = 1 / (s - pole), 1 / (s - pole.conjugate())
        rows += [
            residue * slope * first**2 + (residue * slope).conjugate() * second**2
            for slope in by_pole
        ]
        rows += [slope * first + slope.conjugate() * second for slope in (residue, 1j * residue)]
    rows += [s**power for power in range(len(fit.model.background))]
    gradient = np.array(rows) / response
    return ResponseBand(
        frequency_hz=frequency_hz,
        response=response * np.exp(s * delay_s),
        log_magnitude_std=_std(gradient.real, fit.joint_covariance),
        phase_std_rad=_std(gradient.imag, fit.joint_covariance),
    )


@dataclass(frozen=True, slots=True)
class LossFactor:
    """A loss factor against frequency.

    Attributes
    ----------
    value : ndarray, shape (n,)
        NaN where it has no meaning: where damping of a low order outweighs the inertia.
    log_std : ndarray, shape (n,)
        Standard deviation of its logarithm.
    """

    value: Real
    log_std: Real

    def limits(self) -> tuple[Real, Real]:
        """Lower and upper limit of the 95 % band, shape (n,) each."""
        return _limits(self.value, self.log_std)


@dataclass(frozen=True, slots=True)
class LossFactors:
    """Loss factors of a fitted plant: energy lost in a radian over the energy stored.

    Attributes
    ----------
    frequency_hz : ndarray, shape (n,)
    internal, external : LossFactor or None
        Loss by the material and by the surroundings; None if the structure lacks it.
    total : LossFactor
        Their sum: at a mode twice its damping ratio, but for squares of the loss factor.
    """

    frequency_hz: Real
    internal: LossFactor | None
    external: LossFactor | None
    total: LossFactor


def loss_factors(fit: Estimate, frequency_hz: Real) -> LossFactors:
    """Loss factors of a fit with their uncertainty.

    Parameters
    ----------
    fit : Estimate
    frequency_hz : ndarray, shape (n,)
        Positive.

    Notes
    -----
    A mode with the stiffness k⁴ obeys ``(1 + zeta s^alpha) k⁴ + rho/EI s² + gamma s^lambda = 0``.
    On s = j omega, with ``z = zeta omega^alpha`` and ``g = gamma omega^lambda / (rho/EI omega²)``,
    the imaginary part of elastic and of inertial term over the real one is::

        z sin(alpha pi/2) / (1 + z cos(alpha pi/2))
        g sin(lambda pi/2) / (1 - g cos(lambda pi/2))

    and at a resonance, where the real parts cancel, their sum is the loss factor of the mode.
    """
    omega = 2 * np.pi * frequency_hz
    values = fit.parameters
    total = np.zeros(omega.size)
    slopes = np.zeros((len(fit.determined), omega.size))
    internal = external = None
    if fit.structure.internal:
        value, by = _loss(omega, values["zeta"], values["alpha"], 1.0)
        gradient = _rows(fit, {"zeta": by[0], "alpha": by[1]}, omega.size)
        internal = LossFactor(value, _std(gradient, fit.covariance))
        total, slopes = total + value, slopes + value * gradient
    if fit.structure.external:
        inertia = values["density_over_stiffness"] * omega**2
        value, by = _loss(omega, values["gamma"] / inertia, values["lambda"], -1.0)
        gradient = _rows(
            fit, {"gamma": by[0], "lambda": by[1], "density_over_stiffness": -by[0]}, omega.size
        )
        external = LossFactor(value, _std(gradient, fit.covariance))
        total, slopes = total + value, slopes + value * gradient
    with np.errstate(invalid="ignore", divide="ignore"):
        of_total = LossFactor(total, _std(slopes / total, fit.covariance))
    return LossFactors(frequency_hz, internal, external, of_total)


def _loss(
    omega: Real, coefficient: Real | float, order: float, sign: float
) -> tuple[Real, tuple[Real, Real]]:
    """Loss factor, and the slopes of its logarithm by the coefficient's and by the order."""
    log_omega, angle = np.log(omega), _QUARTER_TURN * order
    size = coefficient * omega**order
    elastic, lost = size * np.cos(angle), size * np.sin(angle)
    rest = 1 + sign * elastic
    rest = np.where(rest > 0, rest, np.nan)
    by_order = (
        log_omega
        + _QUARTER_TURN / np.tan(angle)
        - sign * (elastic * log_omega - _QUARTER_TURN * lost) / rest
    )
    return lost / rest, (1 / rest, by_order)


def _rows(fit: Estimate, slopes: dict[str, Real], points: int) -> Real:
    """Slopes in the order of the fit's covariance, shape (k, n)."""
    return np.array([slopes.get(name, np.zeros(points)) for name in fit.determined]).reshape(
        len(fit.determined), points
    )


def _std(gradient: Real, covariance: Real) -> Real:
    """Compute standard deviations from slopes of shape (k, n)."""
    variance = np.einsum("in,ij,jn->n", gradient, covariance, gradient, optimize=True)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _limits(value: Real, log_std: Real) -> tuple[Real, Real]:
    # An undetermined one may overflow: its band is then everything.
    factor = np.exp(np.minimum(NORMAL_95 * log_std, 300.0))
    return value / factor, value * factor
