"""Modal model of a beam in air, together with air drag of unknown size.

Drag damps a mode in proportion to its amplitude. A record in which each mode vibrates with one
amplitude hardly distinguishes drag from the damping of the beam itself: the residual is white
without drag, and the damping ratios are those in air at that amplitude. Drag of unknown size is
therefore fitted with the modes unless the record excludes that of a thin wire. The damping ratios
then are those without air, and as uncertain as the drag makes them.

The drag torque depends on the poles of the modes, and these depend on the drag that is fitted with
them. The torque is computed for the last poles and the last drag, until the drag does not change.

The whole motor angle is the input of such a fit. The motor also follows the drag torque, and a part
of the angle that is coherent with the reference for one drag is not so for another: if the torque
of the remaining part were removed, the estimate would hardly leave the drag that was assumed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._finding import Finding
from analysis.identify._modal_fit import fit_modes, fit_with_given_poles
from analysis.identify.drag_torque import DragError, DragLaw
from analysis.identify.residual_tests import SIGNIFICANT_STD
from analysis.statistics import NORMAL_95
from rigd.units import interval_text, rounded_to_uncertainty

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from analysis.identify._candidates import CandidateSet
    from analysis.identify._comparison import Comparison
    from analysis.identify._modal_fit import ModalFit

_SMALLEST_DRAG_M: Final = 3e-4
"""Smallest C_D d of a beam in air: that of a wire of about 0.2 mm."""

_LARGEST_DRAG_M: Final = 1e-2
"""C_D d of a thick beam, which is the standard deviation assumed for C_D d before the fit."""

_MIN_DRAG_STDS: Final = 5.0
"""Ratio of `_SMALLEST_DRAG_M` to the standard deviation of C_D d above which a record without drag
excludes all drag."""

_MIN_DAMPING_STD_GROWTH: Final = 1.1
"""Ratio of the standard deviation of a damping ratio with drag of unknown size to that without
drag, above which the drag matters."""

_MIN_LIKELY_DRAG_DEVIANCE: Final = 6.6
"""Reduction of the deviance from which drag is fitted although the record could exclude it. It
happens by chance in one record of a hundred."""

MAX_DRAG_COMPUTATIONS: Final = 8
"""Maximum number of computations of the drag torque for one record."""

_MIN_COMPUTED_DRAG_M: Final = 1e-6
"""C_D d that hardly brakes a beam, for which the torque is computed if the estimate is less."""

_MIN_CHANGED_DAMPING_STDS: Final = 3.0
"""Change of a damping ratio if drag is fitted, in its standard deviations without drag, from which
the value without drag is doubtful even if the fit with drag explains the record less well."""

_DRAG_TOLERANCE_STDS: Final = 0.2
"""Remaining change of the drag, in standard deviations, below which its computation has converged.
"""


@dataclass(frozen=True, slots=True, eq=False)
class ModesWithDrag:
    """Modal model of a record together with air drag of unknown size.

    Attributes
    ----------
    modal_fit : ModalFit
        Modes without air.
    law : DragLaw
        Drag coefficient times width, C_D d.
    drag_std_m : float
        Standard deviation of the part of C_D d that does not depend on the speed, in m.
    comparison : Comparison
        Record without the torque of this drag, which the expansion of the torque corrects.
    drag_spectra : ndarray of complex, shape (1, K)
        Derivative of the torque by the first number of the law.
    has_converged : bool
        Whether another computation of the drag torque would hardly change the drag.
    """

    modal_fit: ModalFit
    law: DragLaw
    drag_std_m: float
    comparison: Comparison
    drag_spectra: NDArray[np.complex128]
    has_converged: bool = False

    def fit_with_effect(
        self, candidate_set: CandidateSet, effect_spectrum: NDArray[np.complex128]
    ) -> ModalFit | None:
        """Return the modes fitted with this drag and another effect, or None if none is visible.

        The candidates are those without drag. `effect_spectrum`, shape (K,), is the torque of the
        other effect in N·m per unit of its size.
        """
        return fit_modes(
            self.comparison,
            candidate_set.noise,
            _mode_starts(self.modal_fit),
            np.concatenate([self.drag_spectra, effect_spectrum[None]]),
        )

    @property
    def is_significant(self) -> bool:
        """Return whether C_D d is that of a beam, and exceeds 0 by more than chance explains.

        A damping that changes along the record resembles a smaller drag.
        """
        return self.law.constant_m > max(_SMALLEST_DRAG_M, SIGNIFICANT_STD * self.drag_std_m)

    def finding(self) -> Finding:
        """Return the finding that the damping ratios are those without air, and less certain.

        If C_D d is significant, the finding has its value and interval.
        """
        drag_m, std_m = self.law.constant_m, self.drag_std_m
        remedy = "Repeat the session at twice and at half the amplitude."
        if self.is_significant:
            interval_95_m = (drag_m - NORMAL_95 * std_m, drag_m + NORMAL_95 * std_m)
            (drag_mm,) = rounded_to_uncertainty((drag_m,), NORMAL_95 * std_m, 1e3)
            return Finding(
                kind="air drag",
                sentence=(
                    f"Air drag acts on the beam: C_D d = {drag_mm} mm "
                    f"({interval_text(interval_95_m, 1e3)} mm; 95 %), so damping grows with the "
                    "amplitude. Drag was fitted with the modes; damping ratios are those without "
                    "air."
                ),
                value=drag_m,
                interval=interval_95_m,
                unit="m",
                remedy=remedy,
            )
        drag_mm, std_mm = rounded_to_uncertainty((drag_m, std_m), std_m, 1e3)
        return Finding(
            kind="air drag",
            sentence=(
                "The modes were fitted together with air drag, since this record hardly "
                f"distinguishes drag from other damping: C_D d = {drag_mm} ± {std_mm} mm "
                "(standard deviation). Damping ratios are those without air."
            ),
            remedy=remedy,
        )


def fit_modes_with_drag(
    candidate_set: CandidateSet,
    modal_fit: ModalFit,
    drag_spectrum: NDArray[np.complex128],
    *,
    max_computations: int = MAX_DRAG_COMPUTATIONS,
) -> ModesWithDrag | None:
    """Return the modes fitted together with air drag, or None if drag does not matter.

    Drag does not matter if the record excludes that of a thin wire, or if it hardly makes a damping
    ratio less certain.

    Candidates and modes are those without drag. `drag_spectrum`, shape (K,), is the torque of a
    small drag on a beam with these modes, in N·m per metre of C_D d. The drag torque is computed at
    most `max_computations` times.
    """
    comparison_without_drag = candidate_set.comparison.use_whole_angle()
    whole_angle_fit: ModalFit | None = modal_fit
    if comparison_without_drag is not candidate_set.comparison:
        mode_starts = _mode_starts(modal_fit)
        whole_angle_fit = fit_with_given_poles(
            comparison_without_drag, modal_fit.noise, mode_starts
        )
    if whole_angle_fit is None or not _drag_matters(whole_angle_fit, drag_spectrum):
        return None
    current_fit = ModesWithDrag(
        modal_fit, DragLaw(0.0), 0.0, comparison_without_drag, drag_spectrum[None]
    )
    drag_estimates_m = [0.0]
    for remaining_computations in reversed(range(max_computations)):
        fit_with_drag = fit_modes(
            current_fit.comparison,
            candidate_set.noise,
            _mode_starts(current_fit.modal_fit),
            current_fit.drag_spectra,
        )
        if (
            fit_with_drag is None
            or fit_with_drag.visible_mode_numbers != modal_fit.visible_mode_numbers
        ):
            # Drag of any size imitates a mode that hardly shows.
            return None if len(drag_estimates_m) == 1 else current_fit
        [drag_change_m], [std_m] = fit_with_drag.effect_sizes, fit_with_drag.effect_stds
        law = DragLaw(current_fit.law.constant_m + drag_change_m)
        drag_estimates_m.append(law.constant_m)
        is_first_order_estimate = (
            len(drag_estimates_m) == 2
        )  # which misses that drag limits the amplitude
        has_converged = _remaining_change_m(drag_estimates_m) < _DRAG_TOLERANCE_STDS * std_m
        current_fit = replace(
            current_fit,
            modal_fit=fit_with_drag,
            law=law,
            drag_std_m=std_m,
            has_converged=has_converged and not is_first_order_estimate,
        )
        if current_fit.has_converged or not remaining_computations:
            break
        # Negative drag is an error of the estimate. Its torque is that of hardly any drag, whose
        # derivatives belong to these poles; those of a small drag may be too far off.
        assumed_law = DragLaw(max(law.constant_m, _MIN_COMPUTED_DRAG_M))
        try:
            comparison = comparison_without_drag.remove_drag_torque(
                fit_with_drag.uniform_plant(comparison_without_drag.measurement.nominal_plant),
                assumed_law,
                fit_with_drag,
            )
        except DragError:
            break  # that of the last fit is not exact
        assert comparison.drag is not None
        current_fit = replace(
            current_fit,
            law=assumed_law,
            comparison=comparison,
            drag_spectra=comparison.drag.law_derivatives[:1],
        )
    return current_fit


def _remaining_change_m(drag_estimates_m: Sequence[float]) -> float:
    """Return the change of C_D d in m that another computation of the drag torque would cause.

    It is extrapolated from the last changes: each is the same fraction of the one before.
    """
    drag_changes_m = np.abs(np.diff(drag_estimates_m))[-2:]
    largest_change_m = float(drag_changes_m.max())
    return float(drag_changes_m[-1]) ** 2 / largest_change_m if largest_change_m else 0.0


def mode_numbers_changed_by_drag(modal_fit: ModalFit, fit_with_drag: ModalFit) -> tuple[int, ...]:
    """Return the numbers of the modes whose damping ratio drag changes by more than chance would.

    `modal_fit` has the modes of the same record without drag.
    """
    changed_mode_numbers = []
    for mode_number in set(modal_fit.visible_mode_numbers) & set(
        fit_with_drag.visible_mode_numbers
    ):
        mode_without_drag = modal_fit.mode(mode_number)
        damping_ratio_reduction = (
            mode_without_drag.damping_ratio - fit_with_drag.mode(mode_number).damping_ratio
        )
        if (
            abs(damping_ratio_reduction)
            > _MIN_CHANGED_DAMPING_STDS * mode_without_drag.damping_ratio_std
        ):
            changed_mode_numbers.append(mode_number)
    return tuple(sorted(changed_mode_numbers))


def _mode_starts(modal_fit: ModalFit) -> list[tuple[int, float, float]]:
    """Return number, frequency in hertz and damping ratio of each mode, as starts of a search."""
    return [
        (mode_number, pole.imag / (2 * math.pi), -pole.real / abs(pole))
        for mode_number, pole in modal_fit.poles_rad_s.items()
    ]


def _drag_matters(modal_fit: ModalFit, drag_spectrum: NDArray[np.complex128]) -> bool:
    """Return whether drag may bias a damping ratio by more than a fraction of its uncertainty.

    `drag_spectrum`, shape (K,), is that of a small drag.
    """
    std_growth_factors = modal_fit.damping_std_growth_factors(drag_spectrum, _LARGEST_DRAG_M)
    if std_growth_factors.max() < _MIN_DAMPING_STD_GROWTH:
        return False
    is_drag_excludable = modal_fit.effect_std(drag_spectrum) < _SMALLEST_DRAG_M / _MIN_DRAG_STDS
    [cost_reduction] = modal_fit.cost_reduction_by_spectrum(drag_spectrum[None])
    return not is_drag_excludable or bool(cost_reduction > _MIN_LIKELY_DRAG_DEVIANCE)
