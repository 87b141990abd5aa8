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

_CONSTANT_TOLERANCES: Final = (0.03, 1e-3, 0.0)
"""Additional standard deviation of all modal constants in successive descents.

Frequencies are known so precisely that a descent without tolerance would converge slowly along a
long and narrow curve."""

_GIVE_UP_CHI_SQUARE: Final = 6.0
"""Chi-square per degree of freedom above which a cause is given up after a descent with tolerance.
"""

_DERIVATIVE_STEP: Final = 1e-6
"""Step of an unknown for numerical derivatives. Steps of the unknowns of a cause are relative to
their range."""

_MAX_DESCENT_STEPS: Final = 12
"""Maximum number of Gauss-Newton steps in the fit of a cause."""

_MAX_RELATIVE_STEP: Final = 1.0
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

_NAMED_CHI_SQUARE_MARGIN: Final = 6.0
"""Excess of chi-square over the lowest of all causes, up to which a cause is named anyway.

A general cause is considered only if its chi-square is lower than that of its special cases by more
than this."""

_NAMED_P_VALUE: Final = 0.05
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
    problem, best_beam = test.problem, test.unknowns
    if problem is None:
        return ()
    middle_start = problem.starts()[len(problem.starts()) // 2]
    without_internal = np.where(np.arange(best_beam.size) == 0, problem.lower, middle_start)
    explained_by: dict[str, CauseFit] = {}
    for cause in CAUSES:
        start_beams = (
            (best_beam, middle_start, without_internal)
            if cause.name == RELAXATION_CAUSE
            else (best_beam, middle_start)
        )
        cause_fit = _fit_cause(problem, cause, start_beams)
        if cause_fit is None:
            continue
        # Of each name only the best fit, and no general cause if a special case suffices.
        rival_chi_squares = [
            explained_by[cause_name].chi_square
            for cause_name in cause.special_case_names
            if cause_name in explained_by
        ]
        required_reduction = _NAMED_CHI_SQUARE_MARGIN
        if cause.name in explained_by:
            rival_chi_squares, required_reduction = [explained_by[cause.name].chi_square], 0.0
        if (
            not rival_chi_squares
            or cause_fit.chi_square < min(rival_chi_squares) - required_reduction
        ):
            explained_by[cause.name] = cause_fit
    lowest_chi_square = min(
        (cause_fit_found.chi_square for cause_fit_found in explained_by.values()), default=0.0
    )
    named_causes = [
        cause_fit_found
        for cause_fit_found in explained_by.values()
        if cause_fit_found.p_value >= _NAMED_P_VALUE
        or cause_fit_found.chi_square <= lowest_chi_square + _NAMED_CHI_SQUARE_MARGIN
    ]
    named_causes.sort(key=lambda cause_fit_found: -cause_fit_found.p_value)
    return tuple(named_causes[:_MAX_NAMED_CAUSES])


def _fit_cause(
    problem: UniformBeamProblem, cause: Cause, start_beams: Sequence[NDArray[np.float64]]
) -> CauseFit | None:
    """Fit one cause to the modes; return None if it cannot be tested or does not explain them.

    `start_beams` are unknowns of the beam from which the search starts. A cause at the limit of its
    plausible range does not count as an explanation.
    """
    beam_unknowns = problem.lower.size
    degrees_of_freedom = problem.constant_count - beam_unknowns - len(cause.lower_bounds)
    if degrees_of_freedom <= 0:
        return None
    starts = [(*_CauseSearch(problem, cause, x).best_start(), x) for x in start_beams]
    for _, start_unknowns, x in sorted(starts, key=lambda each: each[0]):
        chi_square, y = _descend_with_tolerances(
            problem, cause, x, start_unknowns, degrees_of_freedom
        )
        p_value = float(chi_square_p_value(chi_square, degrees_of_freedom))
        if p_value >= MIN_P_VALUE_OF_UNIFORM_BEAM:
            break
    else:
        return None
    cause_unknowns = y[beam_unknowns:]
    at_bound = (cause_unknowns <= cause.lower_bounds) | (cause_unknowns >= cause.upper_bounds)
    at_bound[1:] &= cause_unknowns[1:] != 0  # a loss factor of 0 is allowed
    if at_bound.any():
        return None
    plant = problem.plant(y[:beam_unknowns])
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
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    degrees_of_freedom: int,
) -> tuple[float, NDArray[np.float64]]:
    """Return chi-square and unknowns of beam and cause at a minimum reached from `y`.

    The first descents tolerate deviations of the modal constants; the last one does not.
    """
    chi_square = math.inf
    for tolerance in _CONSTANT_TOLERANCES:
        chi_square, y = _CauseSearch(problem, cause, x, tolerance).descend(y)
        if chi_square > _GIVE_UP_CHI_SQUARE * degrees_of_freedom:
            break
    return chi_square, y


class _CauseSearch:
    """Search for the parameters of beam and cause, with one tolerance of the modal constants.

    `x`, shape (7,), are the unknowns of the beam without the cause; an absent damping stays absent.
    The tolerance is a standard deviation of every constant, in addition to the uncertainty of the
    record.
    """

    def __init__(
        self,
        problem: UniformBeamProblem,
        cause: Cause,
        x: NDArray[np.float64],
        tolerance: float = _CONSTANT_TOLERANCES[0],
    ) -> None:
        self._problem, self._cause, self._beam_x = problem, cause, x
        self._lower = np.concatenate([problem.lower, cause.lower_bounds])
        upper = np.where(x <= problem.lower, problem.lower, problem.upper)
        self._upper = np.concatenate([upper, cause.upper_bounds])
        cause_scale = np.max(np.abs([cause.lower_bounds, cause.upper_bounds]), axis=0)
        self._scale = np.concatenate([np.ones(x.size), cause_scale])
        covariance = problem.covariance + tolerance**2 * np.eye(problem.constant_count)
        self._whitener = np.linalg.inv(np.linalg.cholesky(covariance))

    def best_start(self) -> tuple[float, NDArray[np.float64]]:
        """Return chi-square and unknowns of beam and cause at the best start of the cause.

        The unknowns of the beam have taken one step from each start before they are compared.
        """
        x, derivatives = self._beam_x, None
        lowest_step, highest_step = (limits[: x.size] - x for limits in (self._lower, self._upper))
        stepped_starts = []
        for cause_start in self._cause.start_points:
            y = np.concatenate([x, cause_start])
            mode_terms = self._mode_terms(y)
            residual, slopes = self._residual_and_slopes(x, mode_terms)
            if derivatives is None:
                derivatives = slopes()
            beam_step, _ = _limited_step(residual, derivatives, lowest_step, highest_step)
            residual, _ = self._residual_and_slopes(x + beam_step, mode_terms)
            stepped_starts.append(
                (float(residual @ residual), np.concatenate([x + beam_step, cause_start]))
            )
        return min(stepped_starts, key=lambda pair: pair[0])

    def descend(self, y: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """Return the lowest chi-square on a Gauss-Newton path from `y`, and the unknowns there.

        Steps are not shortened as a rule, even where chi-square rises a little: along a curved flat
        direction it rises first and then falls further.
        """
        unknown_scale, lowest_chi_square, best_y = self._scale, math.inf, y
        residual, beam_slopes = self._residual_at(y)
        for _ in range(_MAX_DESCENT_STEPS):
            chi_square = float(residual @ residual)
            if chi_square < lowest_chi_square:
                lowest_chi_square, best_y = chi_square, y
            derivatives = np.concatenate([beam_slopes(), self._cause_slopes(y, residual)])
            scaled_step, predicted_chi_square = _limited_step(
                residual,
                derivatives * unknown_scale[:, None],
                (self._lower - y) / unknown_scale,
                (self._upper - y) / unknown_scale,
            )
            if chi_square - predicted_chi_square < _CONVERGED_CHI_SQUARE_REDUCTION * max(
                chi_square, 1.0
            ):
                break
            scaled_step = (
                scaled_step
                * unknown_scale
                * min(1.0, _MAX_RELATIVE_STEP / float(np.abs(scaled_step).max()))
            )
            for halving in range(_MAX_STEP_HALVINGS + 1):
                next_y = np.clip(y + scaled_step / 2**halving, self._lower, self._upper)
                residual, beam_slopes = self._residual_at(next_y)
                if residual @ residual < _MAX_CHI_SQUARE_RISE * chi_square:
                    break
            y = next_y
        return lowest_chi_square, best_y

    def _mode_terms(self, y: NDArray[np.float64]) -> ModeTerms:
        """Return the Galerkin coefficients of the modes for the unknowns of beam and cause."""
        x, cause_unknowns = y[: self._beam_x.size], y[self._beam_x.size :].tolist()
        beam = self._problem.plant(x).beam
        alteration = self._cause.add_deviation(
            self._problem.stated_alteration, cause_unknowns, beam
        )
        if alteration.has_same_mode_shapes(BeamDeviations()):
            return replace(self._problem.plain_terms, deviations=alteration)
        terms = galerkin_mode_terms(alteration, beam, self._problem.modes)
        # The mass of a cause is a fraction of the beam's: the mode shapes do not change with that.
        return (
            terms
            if self._problem.stated_alteration.point_masses
            else replace(terms, density_kg_per_m=None)
        )

    def _residual_and_slopes(
        self, x: NDArray[np.float64], mode_terms: ModeTerms
    ) -> tuple[NDArray[np.float64], Callable[[], NDArray[np.float64]]]:
        """Return predicted minus measured modal constants, whitened, and a function for slopes.

        `x` are the unknowns of the beam, shape (7,), and `mode_terms` describe the beam with the
        cause. The slopes are the derivatives by `x` at constant mode shapes.
        """
        return self._problem.residual_and_slopes(x, self._whitener, mode_terms)

    def _residual_at(
        self, y: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], Callable[[], NDArray[np.float64]]]:
        """Return `_residual_and_slopes` for the unknowns `y` of beam and cause."""
        return self._residual_and_slopes(y[: self._beam_x.size], self._mode_terms(y))

    def _cause_slopes(
        self, y: NDArray[np.float64], residual: NDArray[np.float64]
    ) -> list[NDArray[np.float64]]:
        """Return the derivatives of the `residual` at `y` by the unknowns of the cause."""
        return [
            (self._residual_at(y + cause_step)[0] - residual) / cause_step.sum()
            for cause_step in _DERIVATIVE_STEP * np.diag(self._scale)[self._beam_x.size :]
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
        reduced_deviation = np.concatenate([-remaining_deviation, np.zeros(free_unknowns.size)])
        unlimited, *_ = np.linalg.lstsq(design_matrix, reduced_deviation)
        step[free_unknowns] = np.clip(
            unlimited, lowest_step[free_unknowns], highest_step[free_unknowns]
        )
        at_limit = step[free_unknowns] != unlimited
        if not at_limit.any():
            break
        free_unknowns = free_unknowns[~at_limit]
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
