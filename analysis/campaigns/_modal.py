"""Modal constants of all sessions together, and a beam with a tolerance of the geometry.

Each session's noise averages out, an unevenness of the specimen does not: it is common to all. So
the tolerance of the geometry is added to the covariance of the pooled constants, whatever the
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
from analysis.identify import CONSTANTS, ModalEstimate, ModalModel
from analysis.identify.uniform_beam import (
    TolerantEstimate,
    UniformBeamTest,
    tolerant_estimate,
    uniform_beam_test,
)
from analysis.statistics import NORMAL_95, chi_square_p_value, student_t_quantile

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from analysis.campaigns._session import SessionAnalysis
    from analysis.campaigns.pooling import RandomEffects

_FEWEST: Final = 2
_NEARLY_ALL: Final = 0.9
"""Fraction of the sessions that must show a mode."""

_SIGNIFICANT: Final = 0.01
"""Level of all modes together at which rising and falling sweeps differ."""

_LN_FREQUENCY: Final = CONSTANTS.index("ln_frequency")
_LN_RATIO: Final = CONSTANTS.index("ln_damping_ratio")
_PHASE: Final = CONSTANTS.index("residue_phase_rad")


@dataclass(frozen=True, slots=True)
class PooledModal(ModalEstimate):
    """Modal model of all sessions together.

    Attributes
    ----------
    sessions : int
        Used: those that show all of its modes.
    between_std : ndarray, shape (4 n,)
        Scatter of each constant between sessions, beyond their own uncertainties.
    stated : tuple of float
        Uniformities that the files state, each once, the largest last.
    uniform_beam : UniformBeamTest
        Whether a uniform beam predicts the pooled constants.
    tolerant : TolerantEstimate or None
        Parameters at the largest uniformity stated. None with a uniformity of 0 in all files, or
        with a single mode.
    """

    sessions: int
    between_std: NDArray[np.float64]
    stated: tuple[float, ...]
    uniform_beam: UniformBeamTest
    tolerant: TolerantEstimate | None

    @property
    def half_width(self) -> float:
        """Half width of a 95 % interval in standard deviations, by Student's t."""
        return student_t_quantile(0.95, self.sessions - 1)

    @property
    def leads(self) -> bool:
        """Whether the reported modes are its own, and not those of an exactly uniform beam."""
        return self.tolerant is not None or self.uniform_beam.status == "refused"

    @property
    def modes(self) -> tuple[PooledMode, ...]:
        """Its modes."""
        found = []
        for number in self.numbers:
            mode, (inertia, relative_std) = self.mode(number), self.inertia(number)
            between = self.between_std[self.rows([number])]
            found.append(
                PooledMode(
                    number=number,
                    frequency_hz=mode.frequency_hz,
                    frequency_std_hz=mode.frequency_std_hz,
                    frequency_between_std_hz=mode.frequency_hz * float(between[_LN_FREQUENCY]),
                    damping_ratio=mode.damping_ratio,
                    damping_ratio_std=mode.damping_ratio_std,
                    damping_ratio_between_std=mode.damping_ratio * float(between[_LN_RATIO]),
                    source="modal",
                    participation_kg_m2=inertia,
                    participation_std_kg_m2=inertia * relative_std,
                )
            )
        return tuple(found)


def pooled_modal(sessions: Sequence[SessionAnalysis]) -> PooledModal | None:
    """Pool the modal constants of sessions; None unless two of them show a common mode.

    Parameters
    ----------
    sessions : sequence of SessionResult
    """
    shown = [each for each in sessions if each.modal is not None and each.nominal is not None]
    modes = _common_modes([each.modal for each in shown if each.modal is not None])
    used = [each for each in shown if each.modal and set(modes) <= set(each.modal.visible)]
    if not modes or len(used) < _FEWEST:
        return None
    effects = _pooled_constants([each.modal for each in used if each.modal is not None], modes)
    estimate = _estimate(modes, effects.mean, effects.covariance)
    nominal = used[0].nominal
    assert nominal is not None
    stated = tuple(sorted({each.uniformity for each in used}))
    tolerant = None
    if stated[-1]:
        # Intervals are normal ones, and Student's t of few sessions is wider.
        widened = (student_t_quantile(0.95, len(used) - 1) / NORMAL_95) ** 2
        wide = replace(estimate, joint_covariance=widened * effects.covariance)
        tolerant = tolerant_estimate(wide, nominal, stated[-1])
    return PooledModal(
        model=estimate.model,
        numbers=modes,
        constants=estimate.constants,
        joint_covariance=effects.covariance,
        sessions=len(used),
        between_std=effects.between_std[: estimate.constants.size],
        stated=stated,
        uniform_beam=uniform_beam_test(estimate, nominal),
        tolerant=tolerant,
    )


def _estimate(
    modes: tuple[int, ...], joint: NDArray[np.float64], covariance: NDArray[np.float64]
) -> ModalEstimate:
    """Return the estimate with given constants and background, and their covariance."""
    constants, background = np.split(joint, [len(modes) * len(CONSTANTS)])
    model = ModalModel.of_constants(constants, background.tolist())
    return ModalEstimate(model, modes, constants, covariance)


def _common_modes(estimates: Sequence[ModalEstimate]) -> tuple[int, ...]:
    """Modes that nearly all sessions show."""
    count = Counter(number for each in estimates for number in each.visible)
    least = max(_NEARLY_ALL * len(estimates), _FEWEST)
    return tuple(sorted(number for number, often in count.items() if often >= least))


def _pooled_constants(estimates: Sequence[ModalEstimate], modes: Sequence[int]) -> RandomEffects:
    """Pool `CONSTANTS` of some modes, and the background with them.

    Phases are as near to those of the first as whole turns allow.
    """
    values, covariances = map(np.array, zip(*(_joint(e, modes) for e in estimates), strict=True))
    phases = values[:, _PHASE : len(modes) * len(CONSTANTS) : len(CONSTANTS)]
    phases -= 2 * math.pi * np.round((phases - phases[0]) / (2 * math.pi))
    return random_effects(values, covariances)


def _joint(
    estimate: ModalEstimate, modes: Sequence[int]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Constants of some modes and background of one session, with their covariance."""
    rows = estimate.rows(modes)
    joint = np.concatenate(
        [rows, np.arange(estimate.constants.size, len(estimate.joint_covariance))]
    )
    values = np.concatenate([estimate.constants[rows], estimate.model.background])
    return values, estimate.joint_covariance[np.ix_(joint, joint)]


# Rising and falling sweeps


@dataclass(frozen=True, slots=True)
class ModeInSweeps:
    """One mode in falling sweeps against rising ones.

    Attributes
    ----------
    mode : int
    frequency, frequency_std : float
        Relative difference of the frequency, falling less rising, and its standard deviation.
    damping, damping_std : float
        Likewise of the damping ratio.
    chance : float
        Probability of constants that differ as much by chance.
    changed : bool
        Whether they differ significantly, over all modes.
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
    """Whether rising and falling sweeps show the same modes.

    Attributes
    ----------
    rising, falling : int
        Sessions of either.
    modes : tuple of ModeInSweeps
    """

    rising: int
    falling: int
    modes: tuple[ModeInSweeps, ...]

    @property
    def changed(self) -> tuple[ModeInSweeps, ...]:
        """Modes that differ."""
        return tuple(each for each in self.modes if each.changed)


def opposite_sweeps(sessions: Sequence[SessionAnalysis]) -> OppositeSweeps | None:
    """Compare the modes of rising with those of falling sweeps; None without both.

    Parameters
    ----------
    sessions : sequence of SessionResult
    """
    rising = [each.modal for each in sessions if each.modal and each.experiment.rising is True]
    falling = [each.modal for each in sessions if each.modal and each.experiment.rising is False]
    if not rising or not falling:
        return None
    common = set.intersection(*(set(each.visible) for each in (*rising, *falling)))
    modes = tuple(sorted(common))
    if not modes:
        return None
    values, covariances = zip(*_of_groups((rising, falling), modes), strict=True)
    difference, covariance = values[1] - values[0], covariances[0] + covariances[1]
    phases = difference[_PHASE : len(modes) * len(CONSTANTS) : len(CONSTANTS)]  # a view
    phases -= 2 * math.pi * np.round(phases / (2 * math.pi))
    found = []
    for index, mode in enumerate(modes):
        rows = slice(len(CONSTANTS) * index, len(CONSTANTS) * (index + 1))
        off, spread = difference[rows], covariance[rows, rows]
        chance = float(chi_square_p_value(off @ np.linalg.solve(spread, off), len(CONSTANTS)))
        std = np.sqrt(np.diag(spread))
        found.append(
            ModeInSweeps(
                mode,
                float(off[_LN_FREQUENCY]), float(std[_LN_FREQUENCY]),
                float(off[_LN_RATIO]), float(std[_LN_RATIO]),
                chance, chance < _SIGNIFICANT / len(modes),
            )
        )  # fmt: skip
    return OppositeSweeps(len(rising), len(falling), tuple(found))


def _of_groups(
    groups: Iterable[Sequence[ModalEstimate]], modes: Sequence[int]
) -> Iterable[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Yield constants and background of each group with their covariance."""
    for group in groups:
        if len(group) < _FEWEST:
            yield _joint(group[0], modes)
        else:
            effects = _pooled_constants(group, modes)
            yield effects.mean, effects.covariance
