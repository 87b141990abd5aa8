"""Impacts (knocks): the beam was struck or touched during the record, and rang freely afterwards.

During the contact the torque is unknown. Afterwards it contains the free decay of the beam's modes.
So an impact adds to the torque one unknown value at each sample of the contact, and a decay of
unknown amplitude and phase for each mode. Each decay may have a pole slightly different from that
of the model: to first order, this adds the decay times the time since the impact. So neither a
larger deflection than that of the excitation nor inaccurate poles cause a bias.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._data import MeasurementError, RecordedImpact
from analysis.identify._finding import Finding
from analysis.identify._fit import fit_record
from analysis.identify._refit import REFIT_EVALUATIONS, Refit
from analysis.identify.parametrization import Unknowns
from analysis.identify.residual_tests import largest_deviate_limit, whiteness
from analysis.models import STRUCTURES
from analysis.statistics import chi_square_deviate

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from analysis.identify._candidates import CandidateSet
    from analysis.identify._comparison import Comparison
    from analysis.identify._data import Measurement
    from analysis.identify._modal_fit import ModalFit

_FREEST_STRUCTURE: Final = STRUCTURES["VI"]
"""Structure with both dampings and free orders."""

MAX_IMPACTS: Final = 3
"""Maximum number of impacts in one record."""

_IMPACT_WINDOW_HALF_WIDTHS_S: Final = (0.08, 0.5)
"""Half widths of the search windows about the sample that the scan finds: the first for a blow, the
second for a touch."""

_GAP_BEFORE_IMPACT_S: Final = 0.1
"""Duration in seconds between an impact and the samples before it that are tested for noise."""

_POWER_COMPARISON_DURATION_S: Final = 0.4
"""Duration in seconds, before and after an impact, over which the powers of the residual are
compared."""

_MAX_POWER_BEFORE_OVER_AFTER: Final = 0.5
"""Largest power of the residual before an impact, relative to the power after the impact."""

_IMPACT_FIT_ROUNDS: Final = 2
"""Number of rounds that estimate poles and noise with the impact as part of the fit."""

_MAX_FIRST_ORDER_POLE_CHANGE: Final = 0.05
"""Difference of a pole from that of the decays after an impact, relative to the decay rate, up to
which the decays are accurate to first order."""

_MAX_RELATIVE_POLE_DISTANCE: Final = 0.1
"""Largest distance between two poles of the same mode, relative to its frequency."""

_MIN_EVIDENT_COST_FRACTION: Final = 0.8
"""Minimum fraction of the unexplained cost that an evident impact explains."""

_MIN_WORTHWHILE_COST_FRACTION: Final = 0.5
"""Minimum fraction of the unexplained cost that an impact explains for a fit with the impact
removed."""

_MIN_OBVIOUS_COST_FRACTION: Final = 0.95
"""Minimum fraction of the unexplained cost for which an impact is accepted before any other effect
is tested."""

_MIN_DECAY_COST_FRACTION: Final = 0.5
"""Minimum fraction of the cost reduction by an impact that is due to the free decays after the
contact."""

_OVERWHELMING_COST_RATIO: Final = 10.0
"""Ratio of the cost to the cost of noise above which a torque that both impact and beam could
explain is attributed to the impact. Below this ratio it is attributed to the beam: the residual
of a wrong model is at most 3 times the noise, and decays would explain all of that residual."""

_QUIET_BEFORE_IMPACT_S: Final = 2.0
"""Duration in seconds before an impact in which the residual should be noise."""

_MAX_POWER_BEFORE_IMPACT_RATIO: Final = 1.5
"""Largest power of the residual before an impact, relative to the noise."""


@dataclass(frozen=True, slots=True)
class DetectedImpact:
    """Impact on the beam found in a record, with the fraction of the residual that it explains.

    Attributes
    ----------
    impact : RecordedImpact
        Time, poles and amplitudes of the impact.
    explained_fraction : float
        Fraction of the unexplained cost that the impact explains.
    residual_power_ratio : float
        Power of the residual in the two seconds before the impact, relative to its mean power in
        the record once the impact is removed.
    """

    impact: RecordedImpact
    explained_fraction: float
    residual_power_ratio: float

    @property
    def is_evident(self) -> bool:
        """Return whether the impact explains most of the torque residual and begins abruptly."""
        return (
            self.explained_fraction > _MIN_EVIDENT_COST_FRACTION
            and self.residual_power_ratio < _MAX_POWER_BEFORE_IMPACT_RATIO
        )

    @property
    def is_obvious(self) -> bool:
        """Return whether the impact explains so much that no other effect is tested first."""
        return (
            self.explained_fraction > _MIN_OBVIOUS_COST_FRACTION
            and self.residual_power_ratio < _MAX_POWER_BEFORE_IMPACT_RATIO
        )


def find_impacts(
    candidate_set: CandidateSet, *, only_obvious: bool = False
) -> Iterator[DetectedImpact]:
    """Search a record for one more impact on the beam; yield alternatives, the likeliest first.

    An impact may be larger than the response to the motor, so that a fit to the whole record fails.
    One half of the record then contains no impact, or only a free decay at its start. So the search
    also uses the residual of fits to either half. With `only_obvious` it is limited to obvious
    impacts.
    """
    if (
        candidate_set.misread_findings
        or len(candidate_set.comparison.measurement.impacts) == MAX_IMPACTS
    ):
        return
    impact_in_whole_record = find_impact(candidate_set)
    if impact_in_whole_record is not None and impact_in_whole_record.is_obvious:
        yield impact_in_whole_record
        impact_in_whole_record = None
    if only_obvious:
        return
    for start_refit in _refits_from_record_halves(candidate_set):
        alternative_impact = _find_impact_in_residual(start_refit)
        if alternative_impact is not None:
            yield alternative_impact
    if impact_in_whole_record is not None:
        yield impact_in_whole_record


def find_impact(candidate_set: CandidateSet) -> DetectedImpact | None:
    """Return an impact found in the residual of the candidate with the lowest cost, or None."""
    likeliest_candidate = min(candidate_set.candidates, key=lambda candidate: candidate.fit.cost)
    return _find_impact_in_residual(candidate_set.refit(likeliest_candidate, 1))


def _find_impact_in_residual(refit: Refit) -> DetectedImpact | None:
    """Return an impact on the beam found in the residual of a refit, or None."""
    start_sample = _likeliest_impact_sample(refit)
    if start_sample is None:
        return None
    comparison = refit.objective.comparison
    for window_half_width_s in _IMPACT_WINDOW_HALF_WIDTHS_S:
        half_width_samples = math.ceil(window_half_width_s * comparison.decimation.rate_hz)
        window_start, window_end = (
            max(start_sample - half_width_samples, 0),
            min(start_sample + half_width_samples, comparison.sample_count),
        )
        refit_around_impact = _fit_around_impact(refit, window_start, window_end)
        impact_extent = _impact_extent(refit_around_impact, window_start, window_end)
        if impact_extent is None:
            return None
        found_impact = _impact_with_amplitudes(refit_around_impact, *impact_extent)
        if found_impact.explained_fraction < _MIN_WORTHWHILE_COST_FRACTION:
            return None
        if impact_extent[0] > window_start:
            return found_impact
        if found_impact.explained_fraction < _MIN_EVIDENT_COST_FRACTION:
            return None
        # A touch may have begun before this window: try the wider one.
    return None


def _refits_from_record_halves(candidate_set: CandidateSet) -> Iterator[Refit]:
    """Yield refits of the whole record that start from fits to either half of it.

    The damping structure is the freest one.

    A half is skipped if its residual is not white.
    """
    comparison = candidate_set.comparison
    measurement, frequency_hz = comparison.measurement, comparison.frequency_hz
    band_hz = (
        0.0 if comparison.band_bins.start == 1 else float(frequency_hz[0]),
        float(frequency_hz[-1]),
    )
    middle_tick = measurement.angle_rad.size // 2
    for half_ticks in (slice(0, middle_tick), slice(middle_tick, None)):
        half_measurement = replace(
            measurement,
            angle_rad=measurement.angle_rad[half_ticks],
            torque_nm=measurement.torque_nm[half_ticks],
            angle_known=measurement.angle_known[half_ticks],
            torque_known=measurement.torque_known[half_ticks],
            # The ringing after the impact may be far louder than the response to the reference,
            # and the part that follows the reference then identifies no beam.
            reference_rad=None,
            impacts=(),
        )
        try:
            analysis = fit_record(half_measurement, (_FREEST_STRUCTURE,), band_hz=band_hz)
        except MeasurementError:
            continue
        fit, is_compared = analysis.fits[0], analysis.noise.is_compared
        if not whiteness(
            fit.residual[is_compared], analysis.comparison.frequency_hz[is_compared]
        ).is_white:
            continue
        comparison_with_hum = comparison.remove_hum(()).recompute_incoherent_torque(fit.plant)
        unknowns = Unknowns.for_structure(
            _FREEST_STRUCTURE, measurement.nominal_plant, candidate_set.free_settings
        )
        refit_at_start = partial(
            Refit.descend,
            comparison_with_hum,
            unknowns,
            unknowns.vector(fit.plant),
            max_evaluations=1,
        )
        first_refit = refit_at_start(noise=candidate_set.noise)
        noise_of_all_bins = replace(
            first_refit.residual_noise(),
            is_compared=np.ones(frequency_hz.size, dtype=bool),
            lines=(),
        )
        yield refit_at_start(noise=noise_of_all_bins)


def add_known_impact(measurement: Measurement, impact: DetectedImpact) -> Measurement:
    """Return the measurement with a detected impact added to its known impacts."""
    return replace(measurement, impacts=(*measurement.impacts, impact.impact))


def with_fitted_impact_poles(measurement: Measurement, modal_fit: ModalFit) -> Measurement | None:
    """Return the measurement with the poles of the fitted modes in its known impacts.

    Return None if the fit would not change: the expansion of the decays to first order is valid for
    differences that are small compared with the damping.
    """
    fitted_poles = tuple(modal_fit.poles_rad_s.values())

    def fitted_pole(pole_rad_s: complex) -> complex:
        """Return the fitted pole nearest to a pole, or the pole itself if none is near."""
        nearest = min(fitted_poles, key=lambda fitted: abs(fitted - pole_rad_s))
        is_near = abs(nearest - pole_rad_s) < _MAX_RELATIVE_POLE_DISTANCE * abs(pole_rad_s)
        return nearest if pole_rad_s.imag and is_near else pole_rad_s

    impacts = tuple(
        replace(impact, poles_rad_s=tuple(map(fitted_pole, impact.poles_rad_s)))
        for impact in measurement.impacts
    )
    largest_change = max(
        (
            abs(new_pole - pole) / max(abs(new_pole.real), abs(pole.real))
            for new_impact, impact in zip(impacts, measurement.impacts, strict=True)
            for new_pole, pole in zip(new_impact.poles_rad_s, impact.poles_rad_s, strict=True)
            if new_pole != pole
        ),
        default=0.0,
    )
    if largest_change < _MAX_FIRST_ORDER_POLE_CHANGE:
        return None
    return replace(measurement, impacts=impacts)


def impact_findings(
    impacts: tuple[RecordedImpact, ...], *, is_explained: bool
) -> Iterator[Finding]:
    """Yield a finding for each known impact of a record.

    `is_explained` states whether the model with the impacts explains the record.
    """
    for impact in impacts:
        start_uncertainty_s = impact.start_uncertainty_s
        yield Finding(
            kind="knock",
            sentence=(
                f"The beam was struck at {impact.start_s:.2f} s (to within "
                f"{start_uncertainty_s:.2g} s): {1e3 * impact.largest_torque_nm:.3g} mN·m in the "
                "torque, and from then on the free decay of its modes. "
                + (
                    "It was fitted too, and biases nothing."
                    if is_explained
                    else "It was fitted too, but is not all that is in the record."
                )
            ),
            value=impact.start_s,
            interval=(impact.start_s - start_uncertainty_s, impact.start_s + start_uncertainty_s),
            unit="s",
            remedy="Keep clear of the beam while it is recorded.",
        )


# Search


def _likeliest_impact_sample(refit: Refit) -> int | None:
    """Return the index of the sample at which an impact most likely begins.

    Free decays of all modes from this sample on explain most of the residual. Return None if chance
    may explain as much, or if the residual does not rise abruptly. One correlation per decay, by
    fast Fourier transforms, gives the sums for all possible start samples.
    """
    comparison, weight = refit.objective.comparison, refit.noise.weight
    poles = comparison.poles(refit.plant)
    if not poles:
        return None
    residual = refit.objective.project(refit.objective.linearise(refit.x), weight).residual
    decay_spectra = comparison.decay_spectra.spectra(poles) * weight
    projections = np.array(
        [comparison.to_time_series(decay.conj() * residual) for decay in decay_spectra]
    )
    projections *= comparison.sample_count / 2
    decay_norms = np.sqrt(np.sum(np.abs(decay_spectra) ** 2, axis=1))
    if not decay_norms.all():
        return None
    decay_gram = (decay_spectra.conj() @ decay_spectra.T).real / np.outer(decay_norms, decay_norms)
    projections /= decay_norms[:, None]
    cost_reductions = np.sum(
        projections * np.linalg.solve(decay_gram + 1e-9 * np.eye(decay_norms.size), projections),
        axis=0,
    )
    start_sample = int(np.argmax(cost_reductions))
    normal_deviate = chi_square_deviate(float(cost_reductions[start_sample]), decay_norms.size)
    if normal_deviate < math.sqrt(2 * largest_deviate_limit(comparison.sample_count)):
        return None
    # The residual of a wrong model rises and falls with the sweep; an impact begins abruptly.
    residual_power = comparison.to_time_series(residual) ** 2
    rate_hz = comparison.decimation.rate_hz
    gap_samples, window_samples = (
        math.ceil(duration_s * rate_hz)
        for duration_s in (
            _GAP_BEFORE_IMPACT_S,
            _GAP_BEFORE_IMPACT_S + _POWER_COMPARISON_DURATION_S,
        )
    )
    power_before = residual_power[
        max(start_sample - window_samples, 0) : max(start_sample - gap_samples, 0)
    ]
    power_after = residual_power[start_sample : start_sample + window_samples]
    is_abrupt = (
        power_before.size == 0
        or power_before.mean() < _MAX_POWER_BEFORE_OVER_AFTER * power_after.mean()
    )
    return start_sample if is_abrupt else None


def _fit_around_impact(refit: Refit, first_sample: int, end_sample: int) -> Refit:
    """Return a refit whose plant and noise were estimated with an impact between two samples.

    The model of the refit itself does not contain the impact.
    """
    comparison, spectra_before = refit.objective.comparison, refit.effect_spectra
    for _ in range(_IMPACT_FIT_ROUNDS):
        assumed_impact = _impact_between(refit, first_sample, end_sample)
        all_spectra = np.concatenate(
            [spectra_before, comparison.spectrum(_impact_torques(comparison, assumed_impact))]
        )
        refit = Refit.descend(
            comparison, refit.objective.unknowns, refit.x, refit.noise, all_spectra,
            max_evaluations=REFIT_EVALUATIONS,
        )  # fmt: skip
        refit = replace(refit, noise=refit.residual_noise())
    return Refit.descend(
        comparison,
        refit.objective.unknowns,
        refit.x,
        refit.noise,
        spectra_before,
        max_evaluations=1,
    )


def _impact_between(refit: Refit, first_sample: int, end_sample: int) -> RecordedImpact:
    """Return an impact between two samples, without amplitudes, with the poles of a refit."""
    comparison = refit.objective.comparison
    rate_hz = comparison.decimation.rate_hz
    poles = comparison.poles(refit.plant)
    return RecordedImpact(
        start_s=comparison.first_sample_s + first_sample / rate_hz,
        end_s=comparison.first_sample_s + end_sample / rate_hz,
        # The soft beginning of a touch is not visible before the torque has grown.
        start_uncertainty_s=max(2, end_sample - first_sample) / rate_hz,
        poles_rad_s=tuple(pole.at_rad_s for pole in poles),
    )


def _impact_torques(comparison: Comparison, impact: RecordedImpact) -> NDArray[np.float64]:
    """Return the torques of an impact of unit amplitudes at the compared samples, (c, samples)."""
    return impact.unit_torques(comparison.times_s(), comparison.decimation.rate_hz)


def _successive_cost_reductions(
    refit: Refit, unit_torques: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the cost reduction by each torque in addition to the torques of earlier rows, (c,).

    `unit_torques` are torques of unit amplitude at the compared samples, shape (c, samples). All
    free parameters of the fit stay free, to first order.
    """
    unexplained_spectra, residual = refit.unexplained_spectra(
        refit.objective.comparison.spectrum(unit_torques)
    )
    unexplained_spectra /= np.maximum(
        np.linalg.norm(unexplained_spectra, axis=1), np.finfo(float).tiny
    )[:, None]
    # Gram-Schmidt orthogonalisation: each torque without its projection on the earlier ones.
    orthonormal_basis, triangular_factor = np.linalg.qr(
        np.ascontiguousarray(unexplained_spectra).view(np.float64).T
    )
    projections = orthonormal_basis.T @ residual.view(np.float64)
    projections[np.abs(np.diag(triangular_factor)) < _DEPENDENT_SPECTRUM_NORM] = 0.0
    cost_reductions: NDArray[np.float64] = projections**2
    return cost_reductions


_DEPENDENT_SPECTRUM_NORM: Final = 1e-6
"""Length of the part of a torque of length 1 that is orthogonal to the earlier torques, below which
the torque is a linear combination of them."""


def _impact_extent(refit: Refit, window_start: int, window_end: int) -> tuple[int, int] | None:
    """Return first sample and end sample of an impact within a window of samples, or None.

    Each sample of unknown torque has to reduce the cost by the BIC penalty of a parameter. Return
    None also if such samples explain the residual without free decays: then the sensor was
    disturbed, and there was no impact.
    """
    bic_penalty = math.log(2 * np.count_nonzero(refit.noise.is_compared))
    comparison = refit.objective.comparison
    # Beginning: decays from the window's end on, then single samples backwards from there.
    impact = _impact_between(refit, window_end, window_end)
    decay_torques = _impact_torques(comparison, impact)
    single_sample_pulses = np.zeros((window_end - window_start, comparison.sample_count))
    single_sample_pulses[
        np.arange(window_end - window_start), np.arange(window_start, window_end)
    ] = 1.0
    cost_reductions = _successive_cost_reductions(
        refit, np.concatenate([decay_torques, single_sample_pulses[::-1]])
    )[len(decay_torques) :]
    net_cost_reductions = np.concatenate([[0.0], np.cumsum(cost_reductions - bic_penalty)])
    first_sample = window_end - max(int(np.argmax(net_cost_reductions)), 1)
    # End: decays from the beginning on, then single samples forwards.
    impact = _impact_between(refit, first_sample, first_sample)
    decay_torques = _impact_torques(comparison, impact)
    cost_reductions = _successive_cost_reductions(
        refit, np.concatenate([decay_torques, single_sample_pulses[first_sample - window_start :]])
    )[len(decay_torques) :]
    net_cost_reductions = np.concatenate([[0.0], np.cumsum(cost_reductions - bic_penalty)])
    end_sample = first_sample + int(np.argmax(net_cost_reductions))
    cost_reductions_samples_first = _successive_cost_reductions(
        refit,
        np.concatenate(
            [
                single_sample_pulses[first_sample - window_start : end_sample - window_start],
                decay_torques,
            ]
        ),
    )
    cost_reduction_by_decays = float(
        cost_reductions_samples_first[end_sample - first_sample :].sum()
    )
    normal_deviate = chi_square_deviate(cost_reduction_by_decays, len(decay_torques))
    is_significant = normal_deviate > math.sqrt(2 * largest_deviate_limit(comparison.sample_count))
    return (
        (first_sample, end_sample)
        if is_significant
        and cost_reduction_by_decays
        > _MIN_DECAY_COST_FRACTION * float(cost_reductions_samples_first.sum())
        else None
    )


def _impact_with_amplitudes(refit: Refit, first_sample: int, end_sample: int) -> DetectedImpact:
    """Return an impact between two samples with its amplitudes and explained cost fraction."""
    comparison = refit.objective.comparison
    impact = _impact_between(refit, first_sample, end_sample)
    unit_torques = _impact_torques(comparison, impact)
    cost_before, expected_cost = refit.cost, refit.expected_cost
    are_beam_unknowns_free = bool(cost_before < _OVERWHELMING_COST_RATIO * expected_cost)
    unexplained_spectra, residual = refit.unexplained_spectra(
        comparison.spectrum(unit_torques), are_beam_unknowns_free=are_beam_unknowns_free
    )
    real_unexplained_spectra = unexplained_spectra.view(np.float64)
    spectrum_norms = np.linalg.norm(real_unexplained_spectra, axis=1)
    spectrum_norms[spectrum_norms == 0] = 1.0
    real_unexplained_spectra /= spectrum_norms[:, None]
    amplitudes = -np.linalg.lstsq(
        real_unexplained_spectra.T, residual.view(np.float64), rcond=1e-10
    )[0]
    remaining_residual = (residual.view(np.float64) + amplitudes @ real_unexplained_spectra).view(
        np.complex128
    )
    remaining_cost = float(np.vdot(remaining_residual, remaining_residual).real)
    amplitudes /= spectrum_norms
    torque_nm = amplitudes @ unit_torques
    samples_of_first_second = slice(
        first_sample, first_sample + math.ceil(comparison.decimation.rate_hz)
    )
    remaining_residual_samples = comparison.to_time_series(remaining_residual)
    residual_before_impact = remaining_residual_samples[
        max(
            first_sample - math.ceil(_QUIET_BEFORE_IMPACT_S * comparison.decimation.rate_hz), 0
        ) : first_sample
    ]
    return DetectedImpact(
        impact=replace(
            impact,
            component_amplitudes=tuple(amplitudes.tolist()),
            largest_torque_nm=float(np.abs(torque_nm[samples_of_first_second]).max()),
        ),
        explained_fraction=float(
            (cost_before - remaining_cost) / max(cost_before - expected_cost, 1.0)
        ),
        residual_power_ratio=float(
            np.mean(residual_before_impact**2) / np.mean(remaining_residual_samples**2)
        )
        if residual_before_impact.size
        else 0.0,
    )
