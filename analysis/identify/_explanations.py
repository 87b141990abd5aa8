"""Simple causes of modes that deviate from a uniform beam; they are hypotheses, not facts.

Each cause is fitted to the modal constants together with the seven parameters of the beam, without
a tolerance of the geometry. About twelve constants are compatible with several causes, so a cause
that explains them is not established.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from analysis.identify._altered_beam import BeamDeviations, galerkin_mode_terms
from analysis.identify._causes import CAUSES, RELAXATION_CAUSE
from analysis.identify._finding import Finding
from analysis.identify.beam_uniformity import MIN_P_VALUE_OF_UNIFORM_BEAM
from analysis.identify.uniform_beam import UniformBeamProblem
from analysis.statistics import chi_square_p_value

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from analysis.identify._altered_beam import ModeTerms
    from analysis.identify._causes import Cause
    from analysis.identify._step_in_time import StiffnessStep
    from analysis.identify.beam_uniformity import UniformBeamTest
    from rigd.beam import Damping, Plant

_MODAL_CONSTANT_TOLERANCES: Final = (0.03, 1e-3, 0.0)
"""Additional standard deviation of all modal constants in successive descents.

Frequencies are known so precisely that a descent without tolerance would converge slowly along a
long and narrow curve."""

_GIVE_UP_CHI_SQUARE: Final = 6.0
"""Chi-square per degree of freedom above which a cause is given up after a descent with tolerance.
"""

_NUMERICAL_DERIVATIVE_STEP: Final = 1e-6
"""Step of an unknown for numerical derivatives. Steps of the unknowns of a cause are relative to
their range."""

_MAX_DESCENT_STEPS: Final = 12
"""Maximum number of Gauss-Newton steps in the fit of a cause."""

_MAX_RELATIVE_UNKNOWN_STEP: Final = 1.0
"""Largest Gauss-Newton step of any unknown, relative to the scale of the unknown."""

_MAX_CHI_SQUARE_RISE: Final = 10.0
"""Largest factor by which chi-square may rise in one Gauss-Newton step."""

_MAX_STEP_HALVINGS: Final = 3
"""Maximum number of times that a Gauss-Newton step is halved."""

_CONVERGED_CHI_SQUARE_REDUCTION: Final = 0.02
"""Predicted reduction of chi-square below which the fit of a cause has converged, relative to
chi-square or to 1 if that is larger."""

_STEP_REGULARIZATION: Final = 1e-3
"""Regularization of Gauss-Newton steps: an unknown without effect keeps its value, and a determined
unknown moves almost freely."""

_CHI_SQUARE_MARGIN_OF_NAMED_CAUSE: Final = 6.0
"""Excess of chi-square over the lowest of all causes, up to which a cause is named anyway.

A general cause is considered only if its chi-square is lower than that of its special cases by more
than this."""

_MIN_P_VALUE_OF_NAMED_CAUSE: Final = 0.05
"""p-value above which a cause is named, however well another cause explains the modes."""

_MAX_NAMED_CAUSES: Final = 5
"""Maximum number of causes that the finding names."""


@dataclass(frozen=True, slots=True)
class CauseFit:
    """Fit of one cause to the modal constants.

    Attributes
    ----------
    name : str
        Name of the cause.
    phrase : str
        Cause and size as a phrase for sentences.
    size : float
        Size of the cause in `unit`.
    unit : str
        Unit of `size`.
    chi_square, p_value : float
        Misfit of the modal constants with this cause, and the probability of a larger misfit by
        chance.
    damping : Damping
        Damping of the beam with this cause.
    plant : Plant or None
        Plant with this cause; None if a `Plant` cannot represent it.
    """

    name: str
    phrase: str
    size: float
    unit: str
    chi_square: float
    p_value: float
    damping: Damping
    plant: Plant | None = None

    def as_json(self) -> dict[str, Any]:
        """Return name, size and goodness of fit of the cause as a dictionary for `json.dumps`."""
        return {
            "name": self.name,
            "size": self.size,
            "unit": self.unit,
            "chi_square": self.chi_square,
            "p_value": self.p_value,
        }


def explanations(test: UniformBeamTest) -> tuple[CauseFit, ...]:
    """Return fits of the causes that each alone explain the modes, by falling p-value.

    The test has refused the plain uniform beam.
    """
    problem, best_beam_unknowns = test.problem, test.best_fit_unknowns
    if problem is None:
        return ()
    middle_start = problem.starts()[len(problem.starts()) // 2]
    start_without_internal_damping = np.where(
        np.arange(best_beam_unknowns.size) == 0, problem.lower, middle_start
    )
    cause_fits_by_name: dict[str, CauseFit] = {}
    for cause in CAUSES:
        beam_start_vectors = (
            (best_beam_unknowns, middle_start, start_without_internal_damping)
            if cause.name == RELAXATION_CAUSE
            else (best_beam_unknowns, middle_start)
        )
        cause_fit = _fit_cause(problem, cause, beam_start_vectors)
        if cause_fit is None:
            continue
        # Of each name only the best fit, and no general cause if a special case suffices.
        rival_chi_squares = [
            cause_fits_by_name[cause_name].chi_square
            for cause_name in cause.special_case_names
            if cause_name in cause_fits_by_name
        ]
        required_chi_square_reduction = _CHI_SQUARE_MARGIN_OF_NAMED_CAUSE
        if cause.name in cause_fits_by_name:
            rival_chi_squares, required_chi_square_reduction = (
                [cause_fits_by_name[cause.name].chi_square],
                0.0,
            )
        if (
            not rival_chi_squares
            or cause_fit.chi_square < min(rival_chi_squares) - required_chi_square_reduction
        ):
            cause_fits_by_name[cause.name] = cause_fit
    lowest_chi_square = min(
        (cause_fit_found.chi_square for cause_fit_found in cause_fits_by_name.values()), default=0.0
    )
    named_causes = [
        cause_fit_found
        for cause_fit_found in cause_fits_by_name.values()
        if cause_fit_found.p_value >= _MIN_P_VALUE_OF_NAMED_CAUSE
        or cause_fit_found.chi_square <= lowest_chi_square + _CHI_SQUARE_MARGIN_OF_NAMED_CAUSE
    ]
    named_causes.sort(key=lambda cause_fit_found: -cause_fit_found.p_value)
    return tuple(named_causes[:_MAX_NAMED_CAUSES])


def _fit_cause(
    problem: UniformBeamProblem, cause: Cause, beam_start_vectors: Sequence[NDArray[np.float64]]
) -> CauseFit | None:
    """Fit one cause to the modes; return None if it cannot be tested or does not explain them.

    `beam_start_vectors` are unknowns of the beam from which the search starts. A cause at the limit
    of its plausible range does not count as an explanation.
    """
    beam_unknown_count = problem.lower.size
    degrees_of_freedom = problem.constant_count - beam_unknown_count - len(cause.lower_bounds)
    if degrees_of_freedom <= 0:
        return None
    search_starts = [
        (*_CauseSearch(problem, cause, beam_unknowns).best_start(), beam_unknowns)
        for beam_unknowns in beam_start_vectors
    ]
    for _, start_unknowns, beam_unknowns in sorted(
        search_starts, key=lambda search_start: search_start[0]
    ):
        chi_square, all_unknowns = _descend_with_tolerances(
            problem, cause, beam_unknowns, start_unknowns, degrees_of_freedom
        )
        p_value = float(chi_square_p_value(chi_square, degrees_of_freedom))
        if p_value >= MIN_P_VALUE_OF_UNIFORM_BEAM:
            break
    else:
        return None
    cause_unknowns = all_unknowns[beam_unknown_count:]
    is_at_bound = (cause_unknowns <= cause.lower_bounds) | (cause_unknowns >= cause.upper_bounds)
    is_at_bound[1:] &= cause_unknowns[1:] != 0  # a loss factor of 0 is allowed
    if is_at_bound.any():
        return None
    plant = problem.plant(all_unknowns[:beam_unknown_count])
    cause_size, size_unit, phrase = cause.describe(cause_unknowns.tolist(), plant.beam)
    return CauseFit(
        name=cause.name,
        phrase=phrase,
        size=cause_size,
        unit=size_unit,
        chi_square=chi_square,
        p_value=p_value,
        damping=plant.damping,
        plant=cause.plant(cause_unknowns.tolist(), plant) if cause.plant else None,
    )


def _descend_with_tolerances(
    problem: UniformBeamProblem,
    cause: Cause,
    beam_unknowns: NDArray[np.float64],
    all_unknowns: NDArray[np.float64],
    degrees_of_freedom: int,
) -> tuple[float, NDArray[np.float64]]:
    """Return chi-square and unknowns of beam and cause at a minimum reached from `all_unknowns`.

    The first descents tolerate deviations of the modal constants; the last one does not.
    """
    chi_square = math.inf
    for tolerance in _MODAL_CONSTANT_TOLERANCES:
        chi_square, all_unknowns = _CauseSearch(problem, cause, beam_unknowns, tolerance).descend(
            all_unknowns
        )
        if chi_square > _GIVE_UP_CHI_SQUARE * degrees_of_freedom:
            break
    return chi_square, all_unknowns


class _CauseSearch:
    """Search for the parameters of beam and cause, with one tolerance of the modal constants.

    `beam_unknowns`, shape (7,), are the unknowns of the beam without the cause; an absent damping
    stays absent. The tolerance is a standard deviation of every constant, in addition to the
    uncertainty of the record.
    """

    def __init__(
        self,
        problem: UniformBeamProblem,
        cause: Cause,
        beam_unknowns: NDArray[np.float64],
        constant_tolerance: float = _MODAL_CONSTANT_TOLERANCES[0],
    ) -> None:
        self._problem, self._cause, self._beam_x = problem, cause, beam_unknowns
        self._lower = np.concatenate([problem.lower, cause.lower_bounds])
        upper_beam_bounds = np.where(beam_unknowns <= problem.lower, problem.lower, problem.upper)
        self._upper = np.concatenate([upper_beam_bounds, cause.upper_bounds])
        cause_scale = np.max(np.abs([cause.lower_bounds, cause.upper_bounds]), axis=0)
        self._scale = np.concatenate([np.ones(beam_unknowns.size), cause_scale])
        covariance = problem.covariance + constant_tolerance**2 * np.eye(problem.constant_count)
        self._whitener = np.linalg.inv(np.linalg.cholesky(covariance))

    def best_start(self) -> tuple[float, NDArray[np.float64]]:
        """Return chi-square and unknowns of beam and cause at the best start of the cause.

        The unknowns of the beam have taken one step from each start before they are compared.
        """
        beam_unknowns, derivatives = self._beam_x, None
        lowest_step, highest_step = (
            limits[: beam_unknowns.size] - beam_unknowns for limits in (self._lower, self._upper)
        )
        stepped_starts = []
        for cause_start in self._cause.start_points:
            all_unknowns = np.concatenate([beam_unknowns, cause_start])
            mode_terms = self._mode_terms(all_unknowns)
            residual, slopes = self._residual_and_slopes(beam_unknowns, mode_terms)
            if derivatives is None:
                derivatives = slopes()
            beam_step, _ = _limited_step(residual, derivatives, lowest_step, highest_step)
            residual, _ = self._residual_and_slopes(beam_unknowns + beam_step, mode_terms)
            stepped_starts.append(
                (
                    float(residual @ residual),
                    np.concatenate([beam_unknowns + beam_step, cause_start]),
                )
            )
        return min(stepped_starts, key=lambda chi_square_and_start: chi_square_and_start[0])

    def descend(self, all_unknowns: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """Return the lowest chi-square on a Gauss-Newton path, and the unknowns there.

        Steps are not shortened as a rule, even where chi-square rises a little: along a curved flat
        direction it rises first and then falls further.
        """
        unknown_scale, lowest_chi_square, best_unknowns = self._scale, math.inf, all_unknowns
        residual, beam_slopes = self._residual_at(all_unknowns)
        for _ in range(_MAX_DESCENT_STEPS):
            chi_square = float(residual @ residual)
            if chi_square < lowest_chi_square:
                lowest_chi_square, best_unknowns = chi_square, all_unknowns
            derivatives = np.concatenate(
                [beam_slopes(), self._cause_slopes(all_unknowns, residual)]
            )
            scaled_step, predicted_chi_square = _limited_step(
                residual,
                derivatives * unknown_scale[:, None],
                (self._lower - all_unknowns) / unknown_scale,
                (self._upper - all_unknowns) / unknown_scale,
            )
            if chi_square - predicted_chi_square < _CONVERGED_CHI_SQUARE_REDUCTION * max(
                chi_square, 1.0
            ):
                break
            scaled_step = (
                scaled_step
                * unknown_scale
                * min(1.0, _MAX_RELATIVE_UNKNOWN_STEP / float(np.abs(scaled_step).max()))
            )
            for halving in range(_MAX_STEP_HALVINGS + 1):
                next_unknowns = np.clip(
                    all_unknowns + scaled_step / 2**halving, self._lower, self._upper
                )
                residual, beam_slopes = self._residual_at(next_unknowns)
                if residual @ residual < _MAX_CHI_SQUARE_RISE * chi_square:
                    break
            all_unknowns = next_unknowns
        return lowest_chi_square, best_unknowns

    def _mode_terms(self, all_unknowns: NDArray[np.float64]) -> ModeTerms:
        """Return the Galerkin coefficients of the modes for the unknowns of beam and cause."""
        beam_unknowns, cause_unknowns = (
            all_unknowns[: self._beam_x.size],
            all_unknowns[self._beam_x.size :].tolist(),
        )
        beam = self._problem.plant(beam_unknowns).beam
        deviations = self._cause.add_deviation(
            self._problem.stated_alteration, cause_unknowns, beam
        )
        if deviations.has_same_mode_shapes(BeamDeviations()):
            return replace(self._problem.plain_terms, deviations=deviations)
        terms = galerkin_mode_terms(deviations, beam, self._problem.modes)
        # The mass of a cause is a fraction of the beam's: the mode shapes do not change with that.
        return (
            terms
            if self._problem.stated_alteration.point_masses
            else replace(terms, density_kg_per_m=None)
        )

    def _residual_and_slopes(
        self, beam_unknowns: NDArray[np.float64], mode_terms: ModeTerms
    ) -> tuple[NDArray[np.float64], Callable[[], NDArray[np.float64]]]:
        """Return predicted minus measured modal constants, whitened, and a function for slopes.

        `beam_unknowns` are the unknowns of the beam, shape (7,), and `mode_terms` describe the beam
        with the cause. The slopes are the derivatives by `beam_unknowns` at constant mode shapes.
        """
        return self._problem.residual_and_slopes(beam_unknowns, self._whitener, mode_terms)

    def _residual_at(
        self, all_unknowns: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], Callable[[], NDArray[np.float64]]]:
        """Return `_residual_and_slopes` for the unknowns `all_unknowns` of beam and cause."""
        return self._residual_and_slopes(
            all_unknowns[: self._beam_x.size], self._mode_terms(all_unknowns)
        )

    def _cause_slopes(
        self, all_unknowns: NDArray[np.float64], residual: NDArray[np.float64]
    ) -> list[NDArray[np.float64]]:
        """Return the derivatives of the `residual` by the unknowns of the cause."""
        return [
            (self._residual_at(all_unknowns + cause_step)[0] - residual) / cause_step.sum()
            for cause_step in _NUMERICAL_DERIVATIVE_STEP * np.diag(self._scale)[self._beam_x.size :]
        ]


def _limited_step(
    deviation: NDArray[np.float64],
    derivative_rows: NDArray[np.float64],
    lowest_step: NDArray[np.float64],
    highest_step: NDArray[np.float64],
) -> tuple[NDArray[np.float64], float]:
    """Return the Gauss-Newton step within limits, and the chi-square predicted after it.

    The least-squares problem is solved without normal equations. They would square the ratio of the
    precisions of frequencies and residues, which is a thousand.
    """
    step, free_unknowns = np.zeros(len(derivative_rows)), np.arange(len(derivative_rows))
    while free_unknowns.size:
        step[free_unknowns] = 0.0
        remaining_deviation = deviation + step @ derivative_rows
        design_matrix = np.concatenate(
            [derivative_rows[free_unknowns].T, _STEP_REGULARIZATION * np.eye(free_unknowns.size)]
        )
        negative_deviation = np.concatenate([-remaining_deviation, np.zeros(free_unknowns.size)])
        unlimited_step, *_ = np.linalg.lstsq(design_matrix, negative_deviation)
        step[free_unknowns] = np.clip(
            unlimited_step, lowest_step[free_unknowns], highest_step[free_unknowns]
        )
        is_at_limit = step[free_unknowns] != unlimited_step
        if not is_at_limit.any():
            break
        free_unknowns = free_unknowns[~is_at_limit]
    remaining_deviation = deviation + step @ derivative_rows
    return step, float(remaining_deviation @ remaining_deviation)


# Words


def finding(
    test: UniformBeamTest, causes: Sequence[CauseFit], stiffness_step: StiffnessStep | None = None
) -> Finding:
    """Return the finding that names possible causes of modes deviating from a uniform beam.

    The test has refused the plain uniform beam. The causes are those of `explanations`, and the
    step of the stiffness is that of `best_stiffness_step`.
    """
    cause_phrases = [cause_fit.phrase for cause_fit in causes]
    if stiffness_step is not None and stiffness_step.is_significant:
        cause_phrases.append(stiffness_step.text)
    refusal_sentence = f"A plain uniform beam does not predict the modes ({test.summary.chance})."
    if not cause_phrases:
        return Finding(
            kind="rival explanations",
            sentence=(
                f"{refusal_sentence} No single one of the simple causes tried explains them: tilt, "
                "a mass at the tip or elsewhere, an uneven or tapered beam, a soft or lossy clamp, "
                "a filter or resonance of the sensor, a relaxation of the material."
            ),
            remedy="Check the beam and its clamp for several of these at once.",
        )
    if len(cause_phrases) == 1:
        cause_sentence = (
            f"{refusal_sentence} This would explain them: {cause_phrases[0]}. It is not "
            "established by this record."
        )
    else:
        cause_sentence = (
            f"{refusal_sentence} Each of these alone would explain them: "
            f"{'; '.join(cause_phrases)}. None is established by this record."
        )
    return Finding(
        kind="rival explanations",
        sentence=cause_sentence,
        remedy="Weigh, measure or change one of them, state it in the file, and sweep again.",
    )
