"""Identified model as state-space matrices for other programs, with its error and uncertainty."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from analysis.linear_model._dynamics import LinearModelError
from analysis.linear_model._identified import PASSED_STATUS
from analysis.linear_model._order import realise_response
from analysis.linear_model._pole_fit import PoleFit, angle_response, imaginary_axis

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from analysis.linear_model._dynamics import Dynamics, UncertainDynamics
    from analysis.linear_model._identified import IdentifiedModel
    from analysis.linear_model._pole_fit import InputKind, PoleStructure
    from analysis.linear_model._state_space import StateSpace

DEFAULT_SAMPLES: Final = 50
"""Default number of samples of the posterior distribution of the parameters."""

_RANDOM_SEED: Final = 0
"""Seed of the random samples, so that an export is reproducible."""

_MAX_DRAWS_PER_SAMPLE: Final = 10
"""Largest number of random draws for each accepted sample."""

_TABLE_POINTS: Final = 400
"""Number of frequencies of the exported response, besides those of poles and zeros."""

_STEP_STD: Final = 1e-3
"""Step of the numerical derivatives, in standard deviations of the parameters."""


@dataclass(frozen=True, slots=True)
class ModelOptions:
    """Options of the export of a linear model.

    Attributes
    ----------
    beam : bool
        Whether to export the beam's model even if a uniform beam does not predict the modes.
    given : str
        Input: "acceleration", or "angle" for angle, velocity and acceleration.
    order : int or None
        Number of states. None for as few as the accuracy needs.
    rate_hz : float or None
        Sampling rate of the model, whose input is held between samples. None for continuous time.
    samples : int
        Number of samples of the posterior distribution.
    """

    beam: bool = False
    given: InputKind = "acceleration"
    order: int | None = None
    rate_hz: float | None = None
    samples: int = DEFAULT_SAMPLES


@dataclass(frozen=True, slots=True, eq=False)
class PosteriorSamples:
    """Random samples of the parameters, and the state space of each sample.

    Attributes
    ----------
    parameters : ndarray, shape (samples, k)
        Sampled parameters.
    systems : tuple of StateSpace
        State space of each sample. All have the same states.
    """

    parameters: NDArray[np.float64]
    systems: tuple[StateSpace, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Accuracy:
    """Error of a realisation, and standard deviation of the response, over a band.

    Both are relative to the exact response in continuous time.

    Attributes
    ----------
    band_hz : tuple of float
        Band for which the model is made.
    frequency_hz : ndarray, shape (m,)
        Logarithmically spaced frequencies, and those of the poles and zeros of the response.
    response : ndarray of complex, shape (m,)
        Exact response with filters and delay, coupling torque over motor angle in N·m/rad.
    error : ndarray, shape (m,)
        Relative error of the realisation.
    std : ndarray, shape (m,)
        Relative standard deviation of the response. NaN if no covariance is stated.
    error_max : float
        Largest relative error at frequencies several times denser than `frequency_hz`.
    """

    band_hz: tuple[float, float]
    frequency_hz: NDArray[np.float64]
    response: NDArray[np.complex128]
    error: NDArray[np.float64]
    std: NDArray[np.float64]
    error_max: float

    @property
    def error_median(self) -> float:
        """Median relative error of the realisation over the frequencies."""
        return float(np.median(self.error))

    @property
    def std_max(self) -> float:
        """Largest relative standard deviation of the response, NaN if it is not known."""
        return float(self.std.max())

    @property
    def std_median(self) -> float:
        """Median of the relative standard deviation of the response, NaN if it is not known."""
        return float(np.median(self.std))


@dataclass(frozen=True, slots=True, eq=False)
class LinearModel:
    """Exported linear model, with its source, error and uncertainty.

    Attributes
    ----------
    identified : IdentifiedModel
        Models of the analysis.
    kind : str
        Realised model: "beam" or "modal".
    uncertain : UncertainDynamics
        Dynamics of this model as a function of its parameters.
    options : ModelOptions
        Options of the export.
    system : StateSpace
        State-space matrices.
    structure : PoleStructure
        Poles and integrators of `system`.
    accuracy : Accuracy
        Error of the realisation, and uncertainty of the response.
    posterior : PosteriorSamples
        Random samples of the parameters with their state spaces.
    """

    identified: IdentifiedModel
    kind: Literal["beam", "modal"]
    uncertain: UncertainDynamics
    options: ModelOptions
    system: StateSpace
    structure: PoleStructure
    accuracy: Accuracy
    posterior: PosteriorSamples

    @property
    def notes(self) -> tuple[str, ...]:
        """Return remarks for users of the model: doubts, and effects that it leaves out."""
        if self.kind == "modal":
            return self.identified.modal_notes
        status, _ = self.identified.gate
        doubt = (
            ""
            if status == PASSED_STATUS
            else f"whether a uniform beam predicts the modes: {status}"
        )
        return (*filter(None, [doubt]), *self.identified.beam_notes)

    def variables(self) -> dict[str, Any]:
        """Return the variables of an exported file, by name.

        Values are strings, numbers, lists of strings or arrays.
        """
        system, accuracy, posterior = self.system, self.accuracy, self.posterior
        modal = self.identified.modal
        modal_names_and_covariance = self.identified.modal_covariance()
        modal_names, modal_covariance = modal_names_and_covariance or ((), np.zeros((0, 0)))
        status, p_value = self.identified.gate
        n, (p, m) = system.order, system.d.shape
        stacked_matrices = {
            name: np.array([getattr(each, name.lower()) for each in posterior.systems]).reshape(
                -1, *shape
            )
            for name, shape in (("A", (n, n)), ("B", (n, m)), ("C", (p, n)), ("D", (p, m)))
        }
        return {
            "format": "rigd linear model",
            "format_version": 1,
            "source": self.identified.source,
            "model": self.kind,
            "uniform_beam_status": status,
            "uniform_beam_p_value": np.nan if p_value is None else p_value,
            "notes": list(self.notes),
            "order": n,
            "A": system.a,
            "B": system.b,
            "C": system.c,
            "D": system.d,
            "Ts": system.period_s,
            "delay_s": system.delay_s,
            "inputs": list(system.inputs.names),
            "input_units": list(system.inputs.units),
            "outputs": list(system.outputs.names),
            "output_units": list(system.outputs.units),
            "states": list(system.states.names),
            "state_units": list(system.states.units),
            "band_hz": np.array(accuracy.band_hz),
            "frequency_hz": accuracy.frequency_hz,
            "response_nm_per_rad": accuracy.response,
            "error": accuracy.error,
            "error_max": accuracy.error_max,
            "error_median": accuracy.error_median,
            "uncertainty": accuracy.std,
            "uncertainty_max": accuracy.std_max,
            "uncertainty_median": accuracy.std_median,
            "parameter_names": list(self.uncertain.names),
            "parameter_values": self.uncertain.values,
            "parameter_covariance": self.uncertain.covariance,
            "parameter_samples": posterior.parameters,
            **{f"{name}_samples": values for name, values in stacked_matrices.items()},
            "delay_samples_s": np.array([each.delay_s for each in posterior.systems]),
            "poles_rad_s": np.array([] if modal is None else modal.poles_rad_s, complex),
            "residues_nm_per_s": np.array([] if modal is None else modal.residues, complex),
            "background": np.array([] if modal is None else modal.background),
            "modal_names": list(modal_names),
            "modal_covariance": modal_covariance,
        }


def linear_model(
    identified: IdentifiedModel,
    options: ModelOptions,
    on_step: Callable[[str], None] = lambda _step: None,
) -> LinearModel:
    """Realise an identified model: the beam if it predicts the modes, else the modal model.

    Parameters
    ----------
    identified : IdentifiedModel
        Models of the analysis.
    options : ModelOptions
        Options of the export.
    on_step : callable, optional
        Function that is called with the name of each step before it begins.

    Raises
    ------
    LinearModelError, rigd.identified_beam.IdentifiedBeamError
        If the model cannot be realised, or samples are requested without a stated covariance.
    """
    export_beam = options.beam or identified.gate[0] == PASSED_STATUS
    uncertain = identified.beam() if export_beam else identified.modes()
    if options.samples and not uncertain.names:
        key = "covariance" if export_beam else "modal_model.covariance"
        raise LinearModelError(
            f"{identified.headline_name} has no {key}, as of an older version or of a campaign, "
            "so no "
            "samples can be drawn; analyze a session again, or add --samples 0."
        )
    on_step("order")
    nominal = uncertain.nominal
    fit = PoleFit(nominal)
    structure, system = realise_response(fit, options.order, options.given)
    on_step("accuracy")
    accuracy = _accuracy(uncertain, fit, system)
    on_step("samples")
    posterior = _draw_posterior(uncertain, fit, structure, options)
    if options.rate_hz is not None:
        rate_hz = options.rate_hz
        system = system.sampled(rate_hz)
        sampled_systems = tuple(each.sampled(rate_hz) for each in posterior.systems)
        posterior = replace(posterior, systems=sampled_systems)
    return LinearModel(
        identified,
        "beam" if export_beam else "modal",
        uncertain,
        options,
        system,
        structure,
        accuracy,
        posterior,
    )


def _accuracy(uncertain: UncertainDynamics, fit: PoleFit, system: StateSpace) -> Accuracy:
    """Return error and uncertainty of a realisation over its band."""
    low_hz, high_hz = fit.dynamics.band_hz
    pole_and_zero_hz = np.concatenate([fit.dynamics.pairs, fit.zeros]).imag / (2 * np.pi)
    inner_hz = pole_and_zero_hz[(pole_and_zero_hz > low_hz) & (pole_and_zero_hz < high_hz)]
    frequency_hz = np.sort(np.concatenate([np.geomspace(low_hz, high_hz, _TABLE_POINTS), inner_hz]))
    s = imaginary_axis(frequency_hz)
    exact_response = fit.dynamics.filtered(s)
    return Accuracy(
        fit.dynamics.band_hz,
        frequency_hz,
        exact_response * np.exp(-fit.dynamics.delay_s * s),
        np.abs(angle_response(system, s) / exact_response - 1),
        _relative_std(uncertain, s),
        float(fit.error(system).max()),
    )


def _relative_std(uncertain: UncertainDynamics, s: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Return the relative standard deviation of the response with delay (delta method)."""
    if not uncertain.names:
        return np.full(s.size, np.nan)

    def response(values: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Return the exact response with filters and delay for given parameters."""
        dynamics = uncertain.dynamics_of(uncertain.by_name(values))
        return dynamics.filtered(s) * np.exp(-dynamics.delay_s * s)

    variances, directions = np.linalg.eigh(uncertain.covariance)
    total_variance = np.zeros(s.size)
    for variance, direction in zip(variances, directions.T, strict=True):
        if variance > 0:
            value_step = np.sqrt(variance) * _STEP_STD * direction
            above, below = (
                response(uncertain.values + value_step),
                response(uncertain.values - value_step),
            )
            total_variance += np.abs((above - below) / (2 * _STEP_STD)) ** 2
    std: NDArray[np.float64] = np.sqrt(total_variance) / np.abs(response(uncertain.values))
    return std


def _draw_posterior(
    uncertain: UncertainDynamics, fit: PoleFit, structure: PoleStructure, options: ModelOptions
) -> PosteriorSamples:
    """Draw parameters from a normal distribution, and realise each sample with the same states."""
    count = options.samples
    accepted_values: list[NDArray[np.float64]] = []
    systems: list[StateSpace] = []
    generator = np.random.default_rng(_RANDOM_SEED)
    for _ in range(count * _MAX_DRAWS_PER_SAMPLE):
        if len(accepted_values) == count:
            break
        values = generator.multivariate_normal(
            uncertain.values, uncertain.covariance, method="eigh", check_valid="ignore"
        )
        dynamics = _dynamics_of_sample(uncertain, values, fit.dynamics, structure)
        if dynamics is None:
            continue
        sampled_fit = PoleFit(dynamics, near=fit)
        coefficients, _ = sampled_fit.solve(structure)
        if sampled_fit.is_stable_on_motor(structure, coefficients):
            accepted_values.append(values)
            systems.append(sampled_fit.system(structure, coefficients, options.given))
    if len(accepted_values) < count:
        raise LinearModelError(
            f"Only {len(accepted_values)} of {count} samples of the posterior have the states of "
            "the model: its parameters are too uncertain; record more, or add --samples 0."
        )
    return PosteriorSamples(
        np.array(accepted_values).reshape(count, uncertain.values.size), tuple(systems)
    )


def _dynamics_of_sample(
    uncertain: UncertainDynamics,
    values: NDArray[np.float64],
    nominal: Dynamics,
    structure: PoleStructure,
) -> Dynamics | None:
    """Return the dynamics of sampled parameters.

    Return None if they are impossible or need other states.
    """
    parameters = uncertain.by_name(values)
    if not uncertain.is_possible(parameters):
        return None
    try:
        dynamics = uncertain.dynamics_of(parameters)
    except LinearModelError:
        return None
    same_modes = dynamics.names[: structure.pairs] == nominal.names[: structure.pairs] and len(
        dynamics.real_poles
    ) == len(nominal.real_poles)
    same_filters = [each[1] for each in dynamics.filters] == [each[1] for each in nominal.filters]
    return dynamics if same_modes and same_filters else None
