"""Identified model as state-space matrices for other programs, with its error and uncertainty."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
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

DEFAULT_POSTERIOR_SAMPLES: Final = 50
"""Default number of samples of the posterior distribution of the parameters."""

_RANDOM_SEED: Final = 0
"""Seed of the random samples, so that an export is reproducible."""

_MAX_DRAWS_PER_SAMPLE: Final = 10
"""Largest number of random draws for each accepted sample."""

_ACCURACY_TABLE_POINTS: Final = 400
"""Number of frequencies of the exported response, in addition to those of poles and zeros."""

_DERIVATIVE_STEP_STDS: Final = 1e-3
"""Step of the numerical derivatives, in standard deviations of the parameters."""


@dataclass(frozen=True, slots=True)
class ModelOptions:
    """Options of the export of a linear model.

    Attributes
    ----------
    beam : bool
        Whether to export the beam's model even if a uniform beam does not predict the modes.
    input_kind : str
        Input: "acceleration", or "angle" for angle, velocity and acceleration.
    order : int or None
        Number of states. None for the fewest that reach `MAX_RELATIVE_ERROR`.
    rate_hz : float or None
        Sampling rate of the model, whose input is held between samples. None for continuous time.
    posterior_sample_count : int
        Number of samples of the posterior distribution.
    """

    beam: bool = False
    input_kind: InputKind = "acceleration"
    order: int | None = None
    rate_hz: float | None = None
    posterior_sample_count: int = DEFAULT_POSTERIOR_SAMPLES


@dataclass(frozen=True, slots=True, eq=False)
class PosteriorSamples:
    """Random samples of the fitted model parameters, and the state space of each sample.

    Attributes
    ----------
    parameter_samples : ndarray, shape (samples, k)
        Sampled parameters.
    systems : tuple of StateSpace
        State space of each sample. All have the same states.
    """

    parameter_samples: NDArray[np.float64]
    systems: tuple[StateSpace, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Accuracy:
    """Relative error of an exported state space, and relative uncertainty of the response.

    Both are relative to the exact response in continuous time, over a frequency band.

    Attributes
    ----------
    band_hz : tuple of float
        Band for which the model is made.
    frequency_hz : ndarray, shape (m,)
        Logarithmically spaced frequencies, and those of the poles and zeros of the response.
    response : ndarray of complex, shape (m,)
        Exact response with filters and delay, coupling torque over motor angle in N·m/rad.
    relative_error : ndarray, shape (m,)
        Relative error of the realisation.
    relative_std : ndarray, shape (m,)
        Relative standard deviation of the response. NaN if no covariance is stated.
    max_relative_error : float
        Largest relative error at frequencies several times denser than `frequency_hz`.
    """

    band_hz: tuple[float, float]
    frequency_hz: NDArray[np.float64]
    response: NDArray[np.complex128]
    relative_error: NDArray[np.float64]
    relative_std: NDArray[np.float64]
    max_relative_error: float

    @property
    def median_relative_error(self) -> float:
        """Return the relative error of the state space as a median over the frequencies."""
        return float(np.median(self.relative_error))

    @property
    def max_relative_std(self) -> float:
        """Return the largest relative standard deviation of the response, NaN if unknown."""
        return float(self.relative_std.max())

    @property
    def median_relative_std(self) -> float:
        """Return the median relative standard deviation of the response, NaN if unknown."""
        return float(np.median(self.relative_std))


@dataclass(frozen=True, slots=True, eq=False)
class LinearModel:
    """State space of an identified beam, with the analysis behind it, its error and uncertainty.

    Attributes
    ----------
    identified : IdentifiedModel
        Models of the analysis.
    kind : str
        Realised model: "beam" or "modal".
    uncertain_dynamics : UncertainDynamics
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

    # The members without repr would print thousands of lines in a notebook.
    identified: IdentifiedModel = field(repr=False)
    kind: Literal["beam", "modal"]
    uncertain_dynamics: UncertainDynamics = field(repr=False)
    options: ModelOptions
    system: StateSpace = field(repr=False)
    structure: PoleStructure
    accuracy: Accuracy = field(repr=False)
    posterior: PosteriorSamples = field(repr=False)

    @property
    def notes(self) -> tuple[str, ...]:
        """Return remarks for users of the model: doubts, and effects that it leaves out."""
        if self.kind == "modal":
            return self.identified.modal_notes
        test_status = self.identified.uniform_beam_test.status
        doubt_note = (
            ""
            if test_status == PASSED_STATUS
            else f"whether a uniform beam predicts the modes: {test_status}"
        )
        return (*filter(None, [doubt_note]), *self.identified.beam_notes)

    def variables(self) -> dict[str, Any]:
        """Return the variables that an exported file of the linear model contains, by name.

        Their values are strings, numbers, lists of strings or arrays.
        """
        state_space, model_accuracy, posterior_samples = self.system, self.accuracy, self.posterior
        modal_model = self.identified.modal
        modal_names_and_covariance = self.identified.modal_covariance()
        modal_names, modal_covariance = modal_names_and_covariance or ((), np.zeros((0, 0)))
        uniform_beam_test = self.identified.uniform_beam_test
        n, (p, m) = state_space.order, state_space.d.shape
        stacked_matrices = {
            matrix_name: np.array(
                [
                    getattr(sample_system, matrix_name.lower())
                    for sample_system in posterior_samples.systems
                ]
            ).reshape(-1, *matrix_shape)
            for matrix_name, matrix_shape in (
                ("A", (n, n)),
                ("B", (n, m)),
                ("C", (p, n)),
                ("D", (p, m)),
            )
        }
        return {
            "format": "rigd linear model",
            "format_version": 1,
            "source": self.identified.source,
            "model": self.kind,
            "uniform_beam_status": uniform_beam_test.status,
            "uniform_beam_p_value": np.nan
            if uniform_beam_test.p_value is None
            else uniform_beam_test.p_value,
            "notes": list(self.notes),
            "order": n,
            "A": state_space.a,
            "B": state_space.b,
            "C": state_space.c,
            "D": state_space.d,
            "Ts": state_space.period_s,
            "delay_s": state_space.delay_s,
            "inputs": list(state_space.inputs.names),
            "input_units": list(state_space.inputs.units),
            "outputs": list(state_space.outputs.names),
            "output_units": list(state_space.outputs.units),
            "states": list(state_space.states.names),
            "state_units": list(state_space.states.units),
            "band_hz": np.array(model_accuracy.band_hz),
            "frequency_hz": model_accuracy.frequency_hz,
            "response_nm_per_rad": model_accuracy.response,
            "error": model_accuracy.relative_error,
            "error_max": model_accuracy.max_relative_error,
            "error_median": model_accuracy.median_relative_error,
            "uncertainty": model_accuracy.relative_std,
            "uncertainty_max": model_accuracy.max_relative_std,
            "uncertainty_median": model_accuracy.median_relative_std,
            "parameter_names": list(self.uncertain_dynamics.parameter_names),
            "parameter_values": self.uncertain_dynamics.parameter_values,
            "parameter_covariance": self.uncertain_dynamics.covariance,
            "parameter_samples": posterior_samples.parameter_samples,
            **{
                f"{matrix_name}_samples": value_list
                for matrix_name, value_list in stacked_matrices.items()
            },
            "delay_samples_s": np.array(
                [sample_system.delay_s for sample_system in posterior_samples.systems]
            ),
            "poles_rad_s": np.array(
                [] if modal_model is None else modal_model.poles_rad_s, complex
            ),
            "residues_nm_per_s": np.array(
                [] if modal_model is None else modal_model.residues, complex
            ),
            "background": np.array([] if modal_model is None else modal_model.background),
            "modal_names": list(modal_names),
            "modal_covariance": modal_covariance,
        }


def linear_model(
    identified: IdentifiedModel,
    options: ModelOptions = ModelOptions(),
    on_step: Callable[[str], None] = lambda _step: None,
) -> LinearModel:
    """Convert an identified model to a state space.

    The model is the uniform beam if it predicts the measured modes, otherwise the modal model.

    Parameters
    ----------
    identified : IdentifiedModel
        Models of the analysis.
    options : ModelOptions, optional
        Options of the export.
    on_step : callable, optional
        Function that is called with the name of each step before it begins.

    Raises
    ------
    LinearModelError, rigd.identified_beam.IdentifiedBeamError
        If the model cannot be realised, or samples are requested without a stated covariance.
    """
    export_beam = options.beam or identified.uniform_beam_test.status == PASSED_STATUS
    uncertain_dynamics = identified.beam() if export_beam else identified.modes()
    if options.posterior_sample_count and not uncertain_dynamics.parameter_names:
        covariance_key = "covariance" if export_beam else "modal_model.covariance"
        raise LinearModelError(
            f"{identified.headline_name} has no {covariance_key}, as of an older version or of a "
            "campaign, so no samples can be drawn; analyze a session again, or add --samples 0."
        )
    on_step("order")
    nominal_dynamics = uncertain_dynamics.nominal_dynamics
    fit = PoleFit(nominal_dynamics)
    pole_structure, state_space = realise_response(fit, options.order, options.input_kind)
    on_step("accuracy")
    model_accuracy = _accuracy(uncertain_dynamics, fit, state_space)
    on_step("samples")
    posterior_samples = _draw_posterior(uncertain_dynamics, fit, pole_structure, options)
    if options.rate_hz is not None:
        rate_hz = options.rate_hz
        state_space = state_space.discretized(rate_hz)
        sampled_systems = tuple(
            sample_system.discretized(rate_hz) for sample_system in posterior_samples.systems
        )
        posterior_samples = replace(posterior_samples, systems=sampled_systems)
    return LinearModel(
        identified,
        "beam" if export_beam else "modal",
        uncertain_dynamics,
        options,
        state_space,
        pole_structure,
        model_accuracy,
        posterior_samples,
    )


def _accuracy(
    uncertain_dynamics: UncertainDynamics, fit: PoleFit, state_space: StateSpace
) -> Accuracy:
    """Return the relative error of a state space and the relative uncertainty of the response."""
    low_hz, high_hz = fit.dynamics.band_hz
    pole_and_zero_hz = np.concatenate([fit.dynamics.pole_pairs, fit.zeros]).imag / (2 * np.pi)
    pole_and_zero_in_band_hz = pole_and_zero_hz[
        (pole_and_zero_hz > low_hz) & (pole_and_zero_hz < high_hz)
    ]
    frequency_hz = np.sort(
        np.concatenate(
            [np.geomspace(low_hz, high_hz, _ACCURACY_TABLE_POINTS), pole_and_zero_in_band_hz]
        )
    )
    s = imaginary_axis(frequency_hz)
    exact_response = fit.dynamics.filtered_response(s)
    return Accuracy(
        fit.dynamics.band_hz,
        frequency_hz,
        exact_response * np.exp(-fit.dynamics.delay_s * s),
        np.abs(angle_response(state_space, s) / exact_response - 1),
        _relative_std(uncertain_dynamics, s),
        float(fit.relative_error(state_space).max()),
    )


def _relative_std(
    uncertain_dynamics: UncertainDynamics, s: NDArray[np.complex128]
) -> NDArray[np.float64]:
    """Return the relative standard deviation of the torque response with delay, shape (len(s),).

    It follows from the covariance of the parameters to first order; it is NaN if there is none.
    """
    if not uncertain_dynamics.parameter_names:
        return np.full(s.size, np.nan)

    def response(parameter_values: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Return the exact torque response in N·m/rad, with filters and delay, at the points s."""
        sampled_dynamics = uncertain_dynamics.dynamics_of(
            uncertain_dynamics.parameters_by_name(parameter_values)
        )
        return sampled_dynamics.filtered_response(s) * np.exp(-sampled_dynamics.delay_s * s)

    variances, eigenvectors = np.linalg.eigh(uncertain_dynamics.covariance)
    total_variance = np.zeros(s.size)
    for variance, eigenvector in zip(variances, eigenvectors.T, strict=True):
        if variance > 0:
            parameter_step = np.sqrt(variance) * _DERIVATIVE_STEP_STDS * eigenvector
            upper_response, lower_response = (
                response(uncertain_dynamics.parameter_values + parameter_step),
                response(uncertain_dynamics.parameter_values - parameter_step),
            )
            total_variance += (
                np.abs((upper_response - lower_response) / (2 * _DERIVATIVE_STEP_STDS)) ** 2
            )
    relative_std: NDArray[np.float64] = np.sqrt(total_variance) / np.abs(
        response(uncertain_dynamics.parameter_values)
    )
    return relative_std


def _draw_posterior(
    uncertain_dynamics: UncertainDynamics,
    fit: PoleFit,
    pole_structure: PoleStructure,
    options: ModelOptions,
) -> PosteriorSamples:
    """Draw parameters from their normal distribution, and convert each sample to a state space.

    Samples whose model needs other states than the nominal one are rejected. Raise
    `LinearModelError` if too few remain.
    """
    requested_count = options.posterior_sample_count
    accepted_values: list[NDArray[np.float64]] = []
    sample_systems: list[StateSpace] = []
    random_generator = np.random.default_rng(_RANDOM_SEED)
    for _ in range(requested_count * _MAX_DRAWS_PER_SAMPLE):
        if len(accepted_values) == requested_count:
            break
        drawn_values = random_generator.multivariate_normal(
            uncertain_dynamics.parameter_values,
            uncertain_dynamics.covariance,
            method="eigh",
            check_valid="ignore",
        )
        sampled_dynamics = _dynamics_with_same_poles(
            uncertain_dynamics, drawn_values, fit.dynamics, pole_structure
        )
        if sampled_dynamics is None:
            continue
        sampled_fit = PoleFit(sampled_dynamics, similar_fit=fit)
        fit_coefficients, _ = sampled_fit.solve(pole_structure)
        if sampled_fit.is_stable_on_motor(pole_structure, fit_coefficients):
            accepted_values.append(drawn_values)
            sample_systems.append(
                sampled_fit.system(pole_structure, fit_coefficients, options.input_kind)
            )
    if len(accepted_values) < requested_count:
        raise LinearModelError(
            f"Only {len(accepted_values)} of {requested_count} samples of the posterior have the "
            "states of the model: its parameters are too uncertain; record more, or add "
            "--samples 0."
        )
    return PosteriorSamples(
        np.array(accepted_values).reshape(
            requested_count, uncertain_dynamics.parameter_values.size
        ),
        tuple(sample_systems),
    )


def _dynamics_with_same_poles(
    uncertain_dynamics: UncertainDynamics,
    sampled_values: NDArray[np.float64],
    nominal_dynamics: Dynamics,
    pole_structure: PoleStructure,
) -> Dynamics | None:
    """Return the motor-to-torque dynamics of sampled parameters.

    Return None if the parameters are impossible or their model needs other states.
    """
    parameter_values = uncertain_dynamics.parameters_by_name(sampled_values)
    if not uncertain_dynamics.is_possible(parameter_values):
        return None
    try:
        sampled_dynamics = uncertain_dynamics.dynamics_of(parameter_values)
    except LinearModelError:
        return None
    has_same_poles = sampled_dynamics.pair_names[
        : pole_structure.pair_count
    ] == nominal_dynamics.pair_names[: pole_structure.pair_count] and len(
        sampled_dynamics.real_poles
    ) == len(nominal_dynamics.real_poles)
    has_same_filters = [torque_filter[1] for torque_filter in sampled_dynamics.torque_filters] == [
        torque_filter[1] for torque_filter in nominal_dynamics.torque_filters
    ]
    return sampled_dynamics if has_same_poles and has_same_filters else None
