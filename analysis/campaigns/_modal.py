"""Modal constants pooled over all sessions, and a nearly uniform beam estimated from them.

The noise of the sessions averages out. An unevenness of the specimen is common to all sessions and
does not, so the geometry tolerance is added to the covariance of the pooled constants, whatever the
number of sessions. Rising and falling sweeps pass each mode at different times, so their constants
differ if the specimen changes during the records.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.campaigns.pooling import PooledMode, random_effects
from analysis.identify import MODE_CONSTANT_NAMES, ModalEstimate, ModalModel
from analysis.identify.beam_uniformity import UniformBeamTest, uniform_beam_test
from analysis.identify.tolerant_estimate import TolerantEstimate, tolerant_estimate
from analysis.statistics import NORMAL_95, chi_square_p_value, student_t_quantile

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from analysis.campaigns._session import SessionAnalysis
    from analysis.campaigns.pooling import RandomEffects

_MIN_POOLED_SESSIONS: Final = 2
"""Smallest number of sessions that can be pooled."""
_MIN_COMMON_MODE_FRACTION: Final = 0.9
"""Smallest fraction of the sessions that must show a mode for the mode to be pooled."""

_SIGNIFICANCE_LEVEL: Final = 0.01
"""Level, for all modes together, at which rising and falling sweeps differ significantly."""

_LN_FREQUENCY_INDEX: Final = MODE_CONSTANT_NAMES.index("ln_frequency")
"""Index of the logarithm of the frequency among the constants of a mode."""
_LN_DAMPING_RATIO_INDEX: Final = MODE_CONSTANT_NAMES.index("ln_damping_ratio")
"""Index of the logarithm of the damping ratio among the constants of a mode."""
_RESIDUE_PHASE_INDEX: Final = MODE_CONSTANT_NAMES.index("residue_phase_rad")
"""Index of the phase of the residue among the constants of a mode."""


@dataclass(frozen=True, slots=True)
class PooledModalModel(ModalEstimate):
    """Modal model (frequencies, damping ratios, residues) pooled over all sessions.

    Attributes
    ----------
    sessions : int
        Number of sessions used: those that show all modes of the model.
    between_session_std : ndarray, shape (4 n,)
        Scatter of each modal constant between sessions beyond their own uncertainties.
    stated_uniformities : tuple of float
        Distinct values stated in the files for the relative deviation of mode frequencies from
        those of a uniform beam, in increasing order.
    uniform_beam : UniformBeamTest
        Test of whether a uniform beam predicts the pooled constants.
    tolerant : TolerantEstimate or None
        Parameters estimated with the largest value of `stated_uniformities` as tolerance. None if
        all files state 0 and no tilt of the axis, or if there is a single mode.
    """

    sessions: int
    between_session_std: NDArray[np.float64]
    stated_uniformities: tuple[float, ...]
    uniform_beam: UniformBeamTest
    tolerant: TolerantEstimate | None

    @property
    def half_width_in_stds(self) -> float:
        """Ratio of the half width of a 95 % interval to the standard deviation, by Student's t."""
        return student_t_quantile(0.95, self.sessions - 1)

    @property
    def replaces_beam_modes(self) -> bool:
        """Whether the report shows the modes of this model instead of those of a uniform beam."""
        return self.tolerant is not None or self.uniform_beam.status == "refused"

    @property
    def modes(self) -> tuple[PooledMode, ...]:
        """Frequency, damping ratio and inertia of each mode, with their standard deviations."""
        pooled_modes = []
        for mode_number in self.mode_numbers:
            mode, (inertia, relative_std) = (
                self.mode(mode_number),
                self.effective_inertia(mode_number),
            )
            scatter_std = self.between_session_std[self.constant_indices([mode_number])]
            pooled_modes.append(
                PooledMode(
                    number=mode_number,
                    frequency_hz=mode.frequency_hz,
                    frequency_std_hz=mode.frequency_std_hz,
                    frequency_between_std_hz=mode.frequency_hz
                    * float(scatter_std[_LN_FREQUENCY_INDEX]),
                    damping_ratio=mode.damping_ratio,
                    damping_ratio_std=mode.damping_ratio_std,
                    damping_ratio_between_std=mode.damping_ratio
                    * float(scatter_std[_LN_DAMPING_RATIO_INDEX]),
                    source="modal",
                    participation_kg_m2=inertia,
                    participation_std_kg_m2=inertia * relative_std,
                )
            )
        return tuple(pooled_modes)


def pooled_modal_model(sessions: Sequence[SessionAnalysis]) -> PooledModalModel | None:
    """Return the modal model of all sessions, or None if no two sessions show a common mode."""
    modal_sessions = [
        session for session in sessions if session.modal is not None and session.nominal is not None
    ]
    common_modes = _common_modes(
        [session.modal for session in modal_sessions if session.modal is not None]
    )
    used_sessions = [
        session
        for session in modal_sessions
        if session.modal and set(common_modes) <= set(session.modal.visible_mode_numbers)
    ]
    if not common_modes or len(used_sessions) < _MIN_POOLED_SESSIONS:
        return None
    pooled_constants = _pooled_constants(
        [session.modal for session in used_sessions if session.modal is not None], common_modes
    )
    modal_estimate = _modal_estimate(
        common_modes, pooled_constants.mean, pooled_constants.covariance
    )
    nominal_plant = used_sessions[0].nominal
    assert nominal_plant is not None
    # The tilts of the sessions agree where they are stated (`Experiment.difference`).
    tilts_deg = [session.experiment.axis_tilt_deg for session in used_sessions]
    tilt_deg = next(
        (session_tilt_deg for session_tilt_deg in tilts_deg if session_tilt_deg is not None), None
    )
    beam_test = uniform_beam_test(modal_estimate, nominal_plant, tilt_deg)
    stated_uniformities = tuple(sorted({session.uniformity for session in used_sessions}))
    tolerant_fit = None
    if stated_uniformities[-1] or tilt_deg:
        # The intervals assume a normal distribution, but Student's t of few sessions is wider.
        variance_factor = (student_t_quantile(0.95, len(used_sessions) - 1) / NORMAL_95) ** 2
        widened_estimate = replace(
            modal_estimate, joint_covariance=variance_factor * pooled_constants.covariance
        )
        tolerant_fit = tolerant_estimate(
            widened_estimate,
            nominal_plant,
            stated_uniformities[-1],
            tilt_deg,
            is_uniform=beam_test.status != "refused",
        )
    return PooledModalModel(
        model=modal_estimate.model,
        mode_numbers=common_modes,
        mode_constants=modal_estimate.mode_constants,
        joint_covariance=pooled_constants.covariance,
        sessions=len(used_sessions),
        between_session_std=pooled_constants.between_session_std[
            : modal_estimate.mode_constants.size
        ],
        stated_uniformities=stated_uniformities,
        uniform_beam=beam_test,
        tolerant=tolerant_fit,
    )


def _modal_estimate(
    mode_numbers: tuple[int, ...],
    constants_and_background: NDArray[np.float64],
    joint_covariance: NDArray[np.float64],
) -> ModalEstimate:
    """Return the modal estimate of some modes, whose constants and background are one vector."""
    constants, background = np.split(
        constants_and_background, [len(mode_numbers) * len(MODE_CONSTANT_NAMES)]
    )
    modal_model = ModalModel.from_constants(constants, background.tolist())
    return ModalEstimate(modal_model, mode_numbers, constants, joint_covariance)


def _common_modes(estimates: Sequence[ModalEstimate]) -> tuple[int, ...]:
    """Return the numbers of the modes that are visible in nearly all sessions.

    Such a mode is visible in at least 90 % of the sessions, and in at least two.
    """
    mode_counts = Counter(
        mode_number for estimate in estimates for mode_number in estimate.visible_mode_numbers
    )
    min_sessions = max(_MIN_COMMON_MODE_FRACTION * len(estimates), _MIN_POOLED_SESSIONS)
    return tuple(
        sorted(
            mode_number
            for mode_number, session_count in mode_counts.items()
            if session_count >= min_sessions
        )
    )


def _pooled_constants(
    estimates: Sequence[ModalEstimate], mode_numbers: Sequence[int]
) -> RandomEffects:
    """Pool the constants of some modes, and the background, over the estimates of all sessions.

    Residue phases are first shifted by whole turns to be nearest to those of the first estimate.
    """
    session_values, session_covariances = map(
        np.array, zip(*(_constants_and_background(e, mode_numbers) for e in estimates), strict=True)
    )
    residue_phases = session_values[
        :,
        _RESIDUE_PHASE_INDEX : len(mode_numbers) * len(MODE_CONSTANT_NAMES) : len(
            MODE_CONSTANT_NAMES
        ),
    ]
    residue_phases -= 2 * math.pi * np.round((residue_phases - residue_phases[0]) / (2 * math.pi))
    return random_effects(session_values, session_covariances)


def _constants_and_background(
    estimate: ModalEstimate, mode_numbers: Sequence[int]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the modal constants and the background of a session in one vector, with covariance."""
    constant_indices = estimate.constant_indices(mode_numbers)
    joint_indices = np.concatenate(
        [constant_indices, np.arange(estimate.mode_constants.size, len(estimate.joint_covariance))]
    )
    constants_and_background = np.concatenate(
        [estimate.mode_constants[constant_indices], estimate.model.background]
    )
    return constants_and_background, estimate.joint_covariance[np.ix_(joint_indices, joint_indices)]


# Rising and falling sweeps


@dataclass(frozen=True, slots=True)
class ModeInSweeps:
    """Difference of one mode between falling and rising sweeps.

    Attributes
    ----------
    mode : int
        Number of the mode, from 1.
    frequency, frequency_std : float
        Relative difference of the frequency, falling less rising, and its standard deviation.
    damping, damping_std : float
        Relative difference of the damping ratio, falling less rising, and its standard deviation.
    chance : float
        p-value of the difference of the modal constants.
    changed : bool
        Whether the difference is significant, at a level for all modes together.
    """

    mode: int
    frequency: float
    frequency_std: float
    damping: float
    damping_std: float
    chance: float
    changed: bool


@dataclass(frozen=True, slots=True)
class OppositeSweeps:
    """Comparison of the modes of rising and falling sweeps.

    Attributes
    ----------
    rising, falling : int
        Number of sessions with rising and with falling sweeps.
    modes : tuple of ModeInSweeps
        Differences of the modes common to all these sessions.
    """

    rising: int
    falling: int
    modes: tuple[ModeInSweeps, ...]

    @property
    def changed(self) -> tuple[ModeInSweeps, ...]:
        """Modes that differ significantly between rising and falling sweeps."""
        return tuple(mode for mode in self.modes if mode.changed)


def opposite_sweeps(sessions: Sequence[SessionAnalysis]) -> OppositeSweeps | None:
    """Compare rising with falling sweeps by the modes of both; None if they have none in common."""
    rising_estimates = [
        session.modal
        for session in sessions
        if session.modal and session.experiment.is_rising is True
    ]
    falling_estimates = [
        session.modal
        for session in sessions
        if session.modal and session.experiment.is_rising is False
    ]
    if not rising_estimates or not falling_estimates:
        return None
    common_modes = set.intersection(
        *(
            set(estimate.visible_mode_numbers)
            for estimate in (*rising_estimates, *falling_estimates)
        )
    )
    mode_numbers = tuple(sorted(common_modes))
    if not mode_numbers:
        return None
    pooled_values, covariances = zip(
        *_pool_groups((rising_estimates, falling_estimates), mode_numbers), strict=True
    )
    value_difference, covariance = (
        pooled_values[1] - pooled_values[0],
        covariances[0] + covariances[1],
    )
    phase_differences = value_difference[
        _RESIDUE_PHASE_INDEX : len(mode_numbers) * len(MODE_CONSTANT_NAMES) : len(
            MODE_CONSTANT_NAMES
        )
    ]  # a view into `value_difference`
    phase_differences -= 2 * math.pi * np.round(phase_differences / (2 * math.pi))
    mode_changes = []
    for mode_index, mode_number in enumerate(mode_numbers):
        mode_slice = slice(
            len(MODE_CONSTANT_NAMES) * mode_index, len(MODE_CONSTANT_NAMES) * (mode_index + 1)
        )
        mode_difference, mode_covariance = (
            value_difference[mode_slice],
            covariance[mode_slice, mode_slice],
        )
        p_value = float(
            chi_square_p_value(
                mode_difference @ np.linalg.solve(mode_covariance, mode_difference),
                len(MODE_CONSTANT_NAMES),
            )
        )
        std = np.sqrt(np.diag(mode_covariance))
        mode_changes.append(
            ModeInSweeps(
                mode_number,
                float(mode_difference[_LN_FREQUENCY_INDEX]),
                float(std[_LN_FREQUENCY_INDEX]),
                float(mode_difference[_LN_DAMPING_RATIO_INDEX]),
                float(std[_LN_DAMPING_RATIO_INDEX]),
                p_value, p_value < _SIGNIFICANCE_LEVEL / len(mode_numbers),
            )
        )  # fmt: skip
    return OppositeSweeps(len(rising_estimates), len(falling_estimates), tuple(mode_changes))


def _pool_groups(
    estimate_groups: Iterable[Sequence[ModalEstimate]], mode_numbers: Sequence[int]
) -> Iterable[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Yield pooled constants and background of each group of estimates, with their covariance."""
    for group_estimates in estimate_groups:
        if len(group_estimates) < _MIN_POOLED_SESSIONS:
            yield _constants_and_background(group_estimates[0], mode_numbers)
        else:
            pooled_effects = _pooled_constants(group_estimates, mode_numbers)
            yield pooled_effects.mean, pooled_effects.covariance
