"""Changes along the record (damping, stiffness, gain), clocks of different rates, and backlash.

Each effect adds to the torque a spectrum of known shape and unknown size, as in
`analysis.identify._refit`: the change of the torque if damping, stiffness or gain rise in
proportion to time, and the effect of a hub that follows the shaft with backlash. In one sweep time
and frequency increase together, so a drifting damping competes with an order of the damping, and a
drifting gain with a filter. If torque and angle were sampled by clocks of different rates, the
delay of the torque changes along the record.

A mode that rings for seconds depends on its damping and stiffness in the past: with 0.4 % of
stiffness in 22 s, a mode of 2.6 Hz is 0.03 rad out of phase with a mode of its present frequency.
With ``p = rho/EI s² + gamma s^lambda``, ``c = 1 + zeta s^alpha``, ``R = p / (c k⁴ + p)``, its
position u (the rigid part a angle plus the vibration q) and a stress D of the stiffness or damping
that changes as ``1 + e w(t)``::

    D = o k⁴ q + gamma s^lambda u,    q = -R a angle - e (c k⁴ + p)^-1 w D

the torque gains ``e a EI (w gamma s^lambda u - R w D)``, where w multiplies the term to its right
in time. o is ``zeta s^alpha`` for a damping that changes, and c for the stiffness of a beam whose
mass is constant. Repeated substitution of the second equation into the first gives D.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from analysis.identify._finding import Finding
from analysis.identify._predictor import eigenvalues
from analysis.identify._refit import DESCENT_EVALUATIONS, Refit
from analysis.identify.residual_tests import SIGNIFICANT_STD
from analysis.models import STRUCTURES
from analysis.statistics import BIC_DECISIVE, NORMAL_95
from rigd.beam import CausalTransform, ResponseGrid

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from numpy.typing import NDArray

    from analysis.identify._candidate import Candidate
    from analysis.identify._candidates import CandidateSet
    from analysis.identify._comparison import Comparison
    from analysis.identify._finding import FindingKind
    from rigd.beam import Plant


# Search for changes along the record

ChangingProperty = Literal["damping", "stiffness", "gain", "clock", "play"]
"""Property that changes along the record, or "play" for backlash."""

_TESTED_STRUCTURES: Final = tuple(STRUCTURES[name] for name in ("III", "VII", "VI"))
"""Structures that are tested with a change along the record, in addition to the best one."""

_GRADIENT_PARAMETERS: Final = ("zeta", "gamma", "ln_stiffness", "ln_density_over_stiffness")
"""Parameters by which the predicted torque is differentiated."""

_MIN_DEVIANCE_REDUCTION: Final = SIGNIFICANT_STD**2 + 2 * math.log(20)
"""Deviance by which an effect must reduce the residual: five effects are tried on four
candidates."""

_RIVAL_BIC_FRACTION: Final = 0.75
"""Fraction of the BIC advantage of another explanation that an effect must reach as well, by
first-order prediction. The prediction is accurate to a tenth."""

_PREDICTED_BIC_FRACTION: Final = 0.5
"""An effect is fitted if its predicted BIC advantage reaches this fraction of the advantage that it
needs to rival the best fitted effect. The first order predicts at least this fraction of the
advantage that a fit shows."""

UNIT_BACKLASH_RAD: Final = 1e-4
"""Backlash that corresponds to 1 of the fitted size, in rad."""

_CLOCK_RATE_UNIT: Final = 1e-5
"""Relative difference of the clock rates that corresponds to 1 of the fitted size."""

_CHANGE_SIZE_UNITS: Final[Mapping[ChangingProperty, float]] = {
    "play": UNIT_BACKLASH_RAD,
    "clock": _CLOCK_RATE_UNIT,
}
"""Value that corresponds to 1 of the fitted size, by effect. It is 1 for the other effects."""

_CLOCK_TAYLOR_TERM_COUNT: Final = 16
"""Number of terms of the Taylor series in time: enough for three radians."""

_MAX_CHANGE_SIZE_FITS: Final = 8
"""Largest number of fits. After each, the torque spectrum is recomputed for the fitted size."""

_RELATIVE_CHANGE_SIZE_TOLERANCE: Final = 0.01
"""Relative change of the fitted size at which the repeated fits end."""


@dataclass(frozen=True, slots=True)
class TemporalChange:
    """Change of a property of the rig during the record, or backlash, with its estimated size.

    Attributes
    ----------
    effect : str
        Property that changes: "damping", "stiffness", "gain" or "clock"; or "play" for backlash.
    size, std : float
        Estimate and standard deviation: the relative change from the first sample to the last, the
        relative difference of the clock rates, or the backlash in rad.
    bic_difference : float
        BIC with this effect minus the lowest BIC without it.
    """

    effect: ChangingProperty
    size: float
    std: float
    bic_difference: float

    @property
    def name(self) -> str:
        """Return the change in words, as the beginning of a sentence."""
        return _EFFECT_NAMES[self.effect]

    @property
    def is_certain(self) -> bool:
        """Return whether no model without this change explains the record as well."""
        return self.bic_difference < -BIC_DECISIVE


def find_temporal_changes(
    candidate_set: CandidateSet, rival_bic: float = math.inf
) -> tuple[CandidateSet, tuple[TemporalChange, ...]]:
    """Search for changes along the record. Refit all candidates with a change that is certain.

    Only changes whose predicted BIC may come near `rival_bic`, the BIC of another explanation
    (`CandidateSet.bic`), are fitted. Return the candidates, and the changes that explain the record
    best or equally well.
    """
    if candidate_set.misread_findings:
        return candidate_set, ()
    backlash_angle = _backlash_angle(candidate_set.comparison)
    highest_tested_bic = candidate_set.best.bic + min(
        BIC_DECISIVE, _RIVAL_BIC_FRACTION * (rival_bic - candidate_set.bic)
    )
    fitted_changes: dict[ChangingProperty, tuple[float, Refit]] = {}
    for candidate in _candidates_to_test(candidate_set):
        for changing_property, predicted_bic in _promising_changes(
            candidate_set, candidate, backlash_angle, highest_tested_bic
        ):
            if predicted_bic < min(
                fitted_changes.get(changing_property, (math.inf,))[0],
                _highest_predicted_bic(candidate_set, fitted_changes),
            ):
                best_refit, bic = _fit_with_change(
                    candidate_set, candidate, changing_property, backlash_angle
                )
                if bic < fitted_changes.get(changing_property, (math.inf,))[0]:
                    fitted_changes[changing_property] = (bic, best_refit)
    possible_changes = []
    for changing_property, (bic, best_refit) in fitted_changes.items():
        size_factors, std = best_refit.amplitudes()
        size_unit = _CHANGE_SIZE_UNITS.get(changing_property, 1.0)
        temporal_change = TemporalChange(
            changing_property,
            size_unit * float(size_factors[-1]),
            size_unit * float(std[-1]),
            bic - candidate_set.best.bic,
        )
        if temporal_change.bic_difference < BIC_DECISIVE and _has_possible_size(temporal_change):
            possible_changes.append((temporal_change, best_refit))
    possible_changes.sort(key=lambda change_and_refit: change_and_refit[0].bic_difference)
    if not possible_changes:
        return candidate_set, ()
    best_change, best_refit = possible_changes[0]
    equivalent_changes = tuple(
        c
        for c, _ in possible_changes
        if c.bic_difference < best_change.bic_difference + BIC_DECISIVE
    )
    if not best_change.is_certain or len(equivalent_changes) > 1:
        return candidate_set, equivalent_changes
    return candidate_set.refit_with_effect_spectra(
        best_refit.effect_spectra, best_refit.residual_noise()
    ), equivalent_changes


def _highest_predicted_bic(
    candidate_set: CandidateSet, fitted_changes: Mapping[ChangingProperty, tuple[float, Refit]]
) -> float:
    """Return the predicted BIC above which no change would rival the best of the fitted ones."""
    lowest_bic = min((bic for bic, _ in fitted_changes.values()), default=math.inf)
    required_bic_reduction = candidate_set.best.bic - lowest_bic - BIC_DECISIVE
    if required_bic_reduction <= 0:
        return math.inf
    return candidate_set.best.bic - _PREDICTED_BIC_FRACTION * required_bic_reduction


def _has_possible_size(temporal_change: TemporalChange) -> bool:
    """Return whether the size of a change is possible.

    Backlash is positive, and other changes are below 100 %.
    """
    return (
        temporal_change.size > 0
        if temporal_change.effect == "play"
        else abs(temporal_change.size) < 1
    )


def _candidates_to_test(candidate_set: CandidateSet) -> Iterator[Candidate]:
    """Yield the fitted structures that are tested with a change along the record.

    The best one is first.
    """
    yield candidate_set.best
    for candidate in candidate_set.candidates[1:]:
        if candidate.structure in _TESTED_STRUCTURES:
            yield candidate


def _promising_changes(
    candidate_set: CandidateSet,
    candidate: Candidate,
    backlash_angle: NDArray[np.float64],
    highest_bic: float,
) -> Iterator[tuple[ChangingProperty, float]]:
    """Yield the changes with which a candidate may become the best one, with their predicted BIC.

    The lowest BIC is first. A change must reduce the deviance significantly, and its BIC must be
    below `highest_bic`.
    """
    candidate_refit = candidate_set.refit(candidate, 1)
    effect_spectra = _torque_spectra(candidate_set.comparison, candidate.fit.plant, backlash_angle)
    cost_reductions = candidate_refit.cost_reduction_by_spectrum(
        np.array(list(effect_spectra.values()))
    )
    for changing_property, cost_reduction in sorted(
        zip(effect_spectra, cost_reductions.tolist(), strict=True),
        key=lambda property_and_reduction: -property_and_reduction[1],
    ):
        remaining_cost = max(candidate_refit.cost - cost_reduction, 1e-3 * candidate_refit.cost)
        deviance_reduction = candidate.compared_value_count * math.log(
            candidate_refit.cost / remaining_cost
        )
        bic = candidate.bic - deviance_reduction + math.log(candidate.compared_value_count)
        if deviance_reduction > _MIN_DEVIANCE_REDUCTION and bic < highest_bic:
            yield changing_property, bic


def _fit_with_change(
    candidate_set: CandidateSet,
    candidate: Candidate,
    changing_property: ChangingProperty,
    backlash_angle: NDArray[np.float64],
) -> tuple[Refit, float]:
    """Fit a candidate with one change along the record. Return the fit and its BIC."""
    change_refit = candidate_set.refit(candidate, 1)
    beam_unknowns = change_refit.objective.unknowns
    change_size = 0.0
    for _ in range(_MAX_CHANGE_SIZE_FITS):
        change_spectrum = _torque_spectrum(
            candidate_set.comparison,
            change_refit.plant,
            backlash_angle,
            changing_property,
            change_size,
        )
        added_spectra = np.concatenate([candidate_set.effect_spectra, change_spectrum[None]])
        cost_before = change_refit.cost
        change_refit = Refit.descend(
            candidate_set.comparison,
            beam_unknowns,
            change_refit.x,
            candidate_set.noise,
            added_spectra,
            max_evaluations=DESCENT_EVALUATIONS,
        )
        previous_size, change_size = change_size, float(change_refit.amplitudes()[0][-1])
        is_converged = abs(change_size - previous_size) < _RELATIVE_CHANGE_SIZE_TOLERANCE * abs(
            change_size
        )
        if (
            is_converged
            and abs(candidate.compared_value_count * math.log(cost_before / change_refit.cost)) < 1
        ):
            break
    refit_deviance = candidate.compared_value_count * math.log(
        change_refit.cost / candidate.compared_value_count
    )
    return change_refit, refit_deviance + (candidate.parameter_count + 1) * math.log(
        candidate.compared_value_count
    )


def _torque_spectra(
    comparison: Comparison, plant: Plant, backlash_angle: NDArray[np.float64]
) -> dict[ChangingProperty, NDArray[np.complex128]]:
    """Return the torque spectrum of each possible change per unit of its size, each (K,)."""
    torque_slopes = _torque_slopes(comparison, plant)
    return {
        changing_property: _torque_spectrum(
            comparison, plant, backlash_angle, changing_property, 0.0, torque_slopes
        )
        for changing_property in _EFFECT_NAMES
    }


def _torque_slopes(
    comparison: Comparison, plant: Plant
) -> dict[ChangingProperty, NDArray[np.float64]]:
    """Return the torque change in N·m per relative change of damping, stiffness and gain.

    Each has the shape (samples,).
    """
    _, (by_zeta, by_gamma, by_gain, by_density_over_stiffness) = comparison.torque_predictor.torque(
        plant, _GRADIENT_PARAMETERS
    )
    return {
        "damping": plant.damping.zeta * by_zeta + plant.damping.gamma * by_gamma,
        "stiffness": by_gain - by_density_over_stiffness,  # EI rises, rho stays
        "gain": by_gain,
    }


def _torque_spectrum(
    comparison: Comparison,
    plant: Plant,
    backlash_angle: NDArray[np.float64],
    changing_property: ChangingProperty,
    change_size: float,
    torque_slopes: Mapping[ChangingProperty, NDArray[np.float64]] | None = None,
) -> NDArray[np.complex128]:
    """Return the torque spectrum of an effect at a given size, divided by that size, shape (K,).

    `torque_slopes` is the result of `_torque_slopes`, if it is known already.
    """
    if changing_property == "play":
        return comparison.spectrum(
            comparison.torque_predictor.with_angle(backlash_angle).torque(plant)[0]
        )
    if changing_property == "clock":
        return comparison.spectrum(_clock_torque(comparison, plant, change_size))
    unit_ramp = np.linspace(-0.5, 0.5, comparison.sample_count)
    torque_change = (
        unit_ramp * (torque_slopes or _torque_slopes(comparison, plant))[changing_property]
    )
    if changing_property != "gain":
        torque_change += torque_change_by_past_values(
            comparison, plant, unit_ramp, changing_property, change_size
        )
    return comparison.spectrum(torque_change)


def _clock_torque(comparison: Comparison, plant: Plant, change_size: float) -> NDArray[np.float64]:
    """Return the torque change in N·m by different clock rates, per `_CLOCK_RATE_UNIT`, (samples,).

    The torque stamped t is that of the time t plus the rate difference times the time since the
    middle of the record. It is computed by its Taylor series, for the rate difference
    `change_size` in units of `_CLOCK_RATE_UNIT`.
    """
    prediction, time_s = comparison.torque_predictor, comparison.times_s()
    unit_time_offset_s = _CLOCK_RATE_UNIT * (time_s - time_s.mean())
    response_grid = ResponseGrid(prediction.s)
    response_derivative = response_grid.evaluate(plant)[0]
    taylor_factor = unit_time_offset_s
    torque_change = np.zeros(unit_time_offset_s.size)
    for term_number in range(1, _CLOCK_TAYLOR_TERM_COUNT + 1 if change_size else 2):
        response_derivative = response_derivative * response_grid.s
        torque_change += taylor_factor * prediction.to_time_series(response_derivative)
        taylor_factor = taylor_factor * change_size * unit_time_offset_s / (term_number + 1)
    return torque_change


def backlash_spectrum(comparison: Comparison, plant: Plant) -> NDArray[np.complex128]:
    """Return the torque spectrum in N·m of a backlash of `UNIT_BACKLASH_RAD`, shape (K,)."""
    return _torque_spectrum(comparison, plant, _backlash_angle(comparison), "play", 0.0)


def _backlash_angle(comparison: Comparison) -> NDArray[np.float64]:
    """Return the hub angle minus the shaft angle under backlash, in rad, at the decimated rate."""
    highest_hz = float(comparison.frequency_hz[-1])
    shaft_angle_rad = comparison.measurement.angle_from_rest_rad(highest_hz)
    hub_angle_rad = _hub_angle(shaft_angle_rad, UNIT_BACKLASH_RAD / 2)
    hub_lag_rad: NDArray[np.float64] = comparison.decimation.apply(hub_angle_rad - shaft_angle_rad)
    return hub_lag_rad


def _hub_angle(
    shaft_angle_rad: NDArray[np.float64], half_backlash_rad: float
) -> NDArray[np.float64]:
    """Return the angle of a hub that starts at 0 and follows a shaft with backlash, shape (n,).

    At each sample the last angle of the hub is limited to a range about the angle of the shaft. The
    limits of successive samples are combined until a single angle remains.
    """
    lowest_rad, highest_rad = (
        shaft_angle_rad - half_backlash_rad,
        shaft_angle_rad + half_backlash_rad,
    )
    lowest_rad[0] = highest_rad[0] = np.clip(0.0, lowest_rad[0], highest_rad[0])
    combined_sample_count = 1
    while (undecided_samples := np.flatnonzero(lowest_rad < highest_rad)).size:
        undecided_limits_rad = lowest_rad[undecided_samples], highest_rad[undecided_samples]
        earlier_samples = undecided_samples - combined_sample_count
        lowest_rad[undecided_samples], highest_rad[undecided_samples] = (
            np.clip(lowest_rad[earlier_samples], *undecided_limits_rad),
            np.clip(highest_rad[earlier_samples], *undecided_limits_rad),
        )
        combined_sample_count *= 2
    return lowest_rad


# Effect of past values of damping and stiffness

_TRANSFORM_PADDING_RATIO: Final = 1.5
"""Length of the transforms over that of the record."""

_TRANSFORM_DECAY_EXPONENT: Final = 9.0
"""Decay exponent of the `CausalTransform`, as in `analysis.identify._nonlinear`."""

_MAX_CHANGE_SIZE_ORDER: Final = 12
"""Highest order in the size of the change to which the torque is computed."""

_RELATIVE_STRESS_TOLERANCE: Final = 1e-4
"""Relative change of the stress below which higher orders are left out."""


def torque_change_by_past_values(
    comparison: Comparison,
    plant: Plant,
    relative_change: NDArray[np.float64],
    changing_property: Literal["damping", "stiffness"],
    change_size: float = 0.0,
) -> NDArray[np.float64]:
    """Return the torque change by past values of a changing property, per unit size, (samples,).

    It is the part of the torque change that the derivative by the present value does not contain.
    `relative_change`, shape (samples,), is w of the module's equations at the retained samples,
    constant before and after; `change_size` is e. If the stiffness changes, the mass is constant.
    """
    sample_count = comparison.angle_rad.size
    transform = CausalTransform.for_record(
        sample_count,
        comparison.decimation.rate_hz,
        _TRANSFORM_PADDING_RATIO,
        _TRANSFORM_DECAY_EXPONENT,
    )
    s = transform.s
    retained_samples = comparison.retained_samples
    w = np.interp(
        np.arange(sample_count),
        np.arange(retained_samples.start, retained_samples.stop),
        relative_change,
    )
    damping, beam = plant.damping, plant.beam
    internal_damping = damping.zeta * s**damping.alpha
    external_damping = damping.gamma * s**damping.lambda_
    inertial_term = beam.density_over_stiffness * s * s + external_damping
    changing_factor = internal_damping + 1 if changing_property == "stiffness" else internal_damping
    angle_transform = transform.forward(comparison.angle_rad) * plant.channel_response(s)
    total_torque = np.zeros(sample_count)

    def to_time_series(laplace_transform: NDArray[np.complex128]) -> NDArray[np.float64]:
        """Convert a Laplace transform to values over time, shape (n,)."""
        return transform.inverse(laplace_transform, sample_count)

    def multiply_by_change(laplace_transform: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Return the transform of w times a quantity, from the transform of the quantity."""
        return transform.forward(w * to_time_series(laplace_transform))

    k4_of_modes = (eigenvalues(comparison.visible_mode_count) / beam.length_m) ** 4
    modal_stiffnesses = 4 * beam.bending_stiffness_n_m2 / (beam.length_m * k4_of_modes)
    for modal_stiffness, k in zip(modal_stiffnesses.tolist(), k4_of_modes.tolist(), strict=True):
        modal_compliance = 1 / ((1 + internal_damping) * k + inertial_term)
        rigid_response = inertial_term * modal_compliance
        stress_per_angle = changing_factor * k * -rigid_response + external_damping * (
            1 - rigid_response
        )
        constant_stress = modal_stress = stress_per_angle * angle_transform
        vibration_change = np.zeros_like(modal_stress)
        for _ in range(_MAX_CHANGE_SIZE_ORDER if change_size else 1):
            vibration_change = -modal_compliance * multiply_by_change(modal_stress)
            previous_stress, modal_stress = (
                modal_stress,
                constant_stress
                + change_size * (changing_factor * k + external_damping) * vibration_change,
            )
            if (
                np.abs(modal_stress - previous_stress).max()
                < _RELATIVE_STRESS_TOLERANCE * np.abs(constant_stress).max()
            ):
                break
        modal_deflection = (1 - rigid_response) * angle_transform + change_size * vibration_change
        torque_part = to_time_series(inertial_term * vibration_change) + w * to_time_series(
            external_damping * modal_deflection
        )
        total_torque += modal_stiffness * (
            torque_part
            - w
            * to_time_series(
                external_damping * (1 - rigid_response) * angle_transform
                - rigid_response * constant_stress
            )
        )
    return total_torque[retained_samples]


# Findings

_EFFECT_NAMES: Final[dict[ChangingProperty, str]] = {
    "damping": "Damping that changes along the record",
    "stiffness": "Stiffness that changes along the record",
    "gain": "A torque gain that changes along the record",
    "clock": "Clocks of different rates",
    "play": "Backlash between encoder and beam",
}
"""Name of each effect, as the beginning of a sentence."""

_FINDING_KINDS: Final[dict[ChangingProperty, FindingKind]] = {
    "damping": "drifting damping",
    "stiffness": "drifting stiffness",
    "gain": "drifting gain",
    "clock": "clock rate difference",
    "play": "play",
}
"""Kind of the finding on each effect."""


def is_single_change_established(
    equivalent_changes: tuple[TemporalChange, ...], *, is_single_sweep: bool
) -> bool:
    """Return whether the record establishes exactly one change as its explanation.

    `equivalent_changes` explain the record best or equally well. A change with time is never
    established by one sweep: it may depend on frequency instead. Backlash may be established.
    """
    if len(equivalent_changes) != 1 or not equivalent_changes[0].is_certain:
        return False
    return equivalent_changes[0].effect == "play" or not is_single_sweep


def temporal_change_findings(
    equivalent_changes: tuple[TemporalChange, ...], *, is_single_sweep: bool, explained: bool
) -> Iterator[Finding]:
    """Yield a finding on each change along the record.

    `equivalent_changes` explain the record best or equally well. `explained` states whether the
    residual of the model with them is noise.
    """
    for change in equivalent_changes:
        finding = _established_finding(change)
        if is_single_change_established(equivalent_changes, is_single_sweep=is_single_sweep):
            yield finding
        elif not explained:
            # Without a model that explains the record, the fitted size means nothing.
            yield replace(
                finding,
                sentence=(
                    f"{_EFFECT_NAMES[change.effect]} would explain some of the record. How large "
                    "the effect is remains open: in one sweep, time and frequency vary together."
                ),
                value=None,
                interval=None,
            )
        else:
            rival_names = "the others named" if len(equivalent_changes) > 1 else "any other model"
            yield replace(
                finding,
                sentence=(
                    f"{_EFFECT_NAMES[change.effect]} ({_size_text(change)}) would explain the "
                    f"record as well as {rival_names}: in one sweep, time and frequency vary "
                    "together."
                ),
                value=None,
                interval=None,
            )


def _size_text(temporal_change: TemporalChange) -> str:
    """Return the size of a change as text with its unit."""
    if temporal_change.effect == "play":
        return f"{1e3 * temporal_change.size:.2g} mrad"
    if temporal_change.effect == "clock":
        return f"the torque's by {1e6 * temporal_change.size:+.3g} ppm"
    return f"{100 * temporal_change.size:+.2g} % from beginning to end"


_DISPLAY_FACTORS: Final[Mapping[ChangingProperty, float]] = {"play": 1e3, "clock": 1e6}
"""Factor from the size to its value in text: mrad, ppm. It is 100 for changes in per cent."""

_TWO_WAY_SWEEP_ADVICE: Final = (
    "weep up and down in one session (rigd run chirp --there-and-back): that separates changes "
    "with time from those with frequency."
)
"""Advice to sweep in both directions, without its first letter."""


def _established_finding(temporal_change: TemporalChange) -> Finding:
    """Return the finding that a change along the record is established."""
    size_half_width = NORMAL_95 * temporal_change.std
    is_backlash = temporal_change.effect == "play"
    remedy_text = f"S{_TWO_WAY_SWEEP_ADVICE}"
    if is_backlash:
        remedy_text = "Remove the backlash in gear and clamp."
    elif temporal_change.effect == "clock":
        remedy_text = f"Sample angle and torque by one clock, or s{_TWO_WAY_SWEEP_ADVICE}"
    return Finding(
        kind=_FINDING_KINDS[temporal_change.effect],
        sentence=(
            f"{_EFFECT_NAMES[temporal_change.effect]}: {_size_text(temporal_change)} "
            f"(± {_DISPLAY_FACTORS.get(temporal_change.effect, 100.0) * size_half_width:.1g}; "
            "95 %). It was fitted too"
            + (
                ", to first order in its size."
                if is_backlash
                else "; all parameters are those at the middle of the record."
            )
        ),
        value=temporal_change.size,
        interval=(temporal_change.size - size_half_width, temporal_change.size + size_half_width),
        unit="rad" if is_backlash else "1",
        remedy=remedy_text,
    )
