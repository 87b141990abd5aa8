"""Diagnostics of a record: effects other than the linear uniform beam, with kind and size.

They are parameters at the limit of the search range or different from the file, disturbances of the
torque, nonlinear forces, drag, a free decay at the start, and the unexplained residual.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._channel_checks import clipping_findings, standstill_findings
from analysis.identify._finding import Finding
from analysis.identify._leakage import repetition_period_s
from analysis.identify.residual_tests import SIGNIFICANT_STD
from analysis.statistics import NORMAL_95, chi_square_deviate
from rigd.units import interval_text, rounded_to_uncertainty

if TYPE_CHECKING:
    from collections.abc import Iterator

    from analysis.identify._candidates import CandidateSet
    from analysis.identify._data import Measurement
    from analysis.identify._estimates import ModeEstimate
    from analysis.identify._modal_fit import ModalFit
    from analysis.identify._nonlinear import NonlinearForce
    from analysis.identify._settings import Setting
    from analysis.identify._step_in_time import StiffnessStep
    from analysis.identify.headline import Headline
    from analysis.identify.residual_tests import Harmonic, InputRelation, Whiteness


def findings(
    candidate_set: CandidateSet,
    modal_fit: ModalFit | None,
    forces: tuple[NonlinearForce, ...],
    harmonics: tuple[Harmonic, ...],
) -> tuple[Finding, ...]:
    """Return the effects found in a record that a linear damped beam does not explain.

    If a sign or unit of the record is wrong, only findings that need no model are returned.
    `modal_fit` is None if no mode is visible. All `forces` are significant, and `harmonics` are the
    residual at multiples of the sweep's frequency.
    """
    measurement = candidate_set.comparison.measurement
    model_independent_findings = (
        *candidate_set.misread_findings,
        *clipping_findings(measurement),
        *standstill_findings(measurement),
    )
    if candidate_set.misread_findings:
        return model_independent_findings
    if modal_fit is not None and not modal_fit.determines_response:
        return (*model_independent_findings, _hidden_response_finding(measurement, modal_fit))
    all_findings = (
        *model_independent_findings,
        *_hum_findings(candidate_set),
        *_drag_findings(candidate_set),
        *map(_force_finding, forces),
        *_harmonic_findings(harmonics),
    )
    return (*all_findings, *search_limit_findings(candidate_set))


def _hidden_response_finding(measurement: Measurement, modal_fit: ModalFit) -> Finding:
    """Return the finding that the response to the motor is not determined."""
    lowest_hz = min(pole.imag for pole in modal_fit.poles_rad_s.values()) / (2 * math.pi)
    period_s = math.ceil(10 / lowest_hz) / 10  # of the first mode, in tenths of a second
    return Finding(
        kind="hidden response",
        sentence=(
            "The response to the motor cannot be distinguished from a ringing of the beam when the "
            "record began, because the motor moves too early in the record, or too little. The "
            "record does not determine inertias, stiffness, delay and orders, and damping ratios "
            "only roughly."
        ),
        remedy=(
            f"Begin the part (--from) at least {period_s:g} s before the motor moves."
            if measurement.is_later_part
            else f"Let the beam rest for at least {period_s:g} s before the motor moves (--rest)."
        ),
    )


# Settings at the limit of the search range, or different from the file

_MIN_REPORTED_DELAY_S: Final = 1e-4
"""Smallest deviation of the torque delay from the file that is reported, in seconds. Backlash of a
few tenths of a milliradian resembles a shorter delay."""

_MIN_REPORTED_BEAM_DEVIATION: Final = 0.003
"""Smallest relative deviation of stiffness or density from the file that is reported."""


def search_limit_findings(candidate_set: CandidateSet) -> Iterator[Finding]:
    """Yield a finding for each fitted parameter at the limit of its search range."""
    fit = candidate_set.best.fit
    for parameter_name, quantity_name, unit_factor, unit_name in (
        ("delay_s", "The delay between the channels", 1e3, "ms"),
        ("density_over_stiffness", "Mass per length over bending stiffness (rho/EI)", 1, "s²/m⁴"),
        ("bending_stiffness_n_m2", "The bending stiffness (EI)", 1, "N·m²"),
    ):
        if parameter_name in fit.at_bounds:
            limit_value = fit.parameters[parameter_name]
            yield Finding(
                kind="implausible",
                sentence=(
                    f"{quantity_name} would have to be {unit_factor * limit_value:.4g} {unit_name} "
                    "or beyond, which is the limit of the search range: the record contradicts its "
                    "file. No number here is valid for the antenna."
                ),
                value=limit_value,
                unit=unit_name if unit_factor == 1 else "s",
                remedy=(
                    "Check the signs and the units of angle and torque, and the beam's length, "
                    "density and stiffness in the file."
                ),
            )


def setting_findings(candidate_set: CandidateSet, headline: Headline) -> Iterator[Finding]:
    """Yield findings of settings whose estimates differ from the session file.

    They are torque delay, tool inertia, density and stiffness of the beam. A ringing of the beam at
    the beginning of the record yields a finding, too.

    A parameter with a flag in `headline` yields no finding.
    """
    yield from _instrument_findings(candidate_set, headline)
    yield from _beam_findings(candidate_set, headline)
    yield from _initial_ringing_findings(candidate_set, headline)


def _significant_deviation(
    candidate_set: CandidateSet, headline: Headline, setting_name: Setting
) -> tuple[float, float, float] | None:
    """Return the deviation of a setting from the file's value, and the ends of its 95 % interval.

    Return None if the deviation is not significant, or if the estimate carries a flag.
    """
    reported_value, stated_value = (
        headline.parameters.get(setting_name),
        _stated_value(candidate_set, setting_name),
    )
    if (
        reported_value is None
        or reported_value.flag
        or not reported_value.std
        or reported_value.interval_95 is None
    ):
        return None
    if abs(reported_value.value - stated_value) < SIGNIFICANT_STD * reported_value.std:
        return None
    interval_low, interval_high = reported_value.interval_95
    return (
        reported_value.value - stated_value,
        interval_low - stated_value,
        interval_high - stated_value,
    )


def _instrument_findings(candidate_set: CandidateSet, headline: Headline) -> Iterator[Finding]:
    """Yield findings of a torque delay and a tool inertia that differ from the session file."""
    deviation = _significant_deviation(candidate_set, headline, "delay_s")
    if deviation is not None and abs(deviation[0]) > _MIN_REPORTED_DELAY_S:
        setting_deviation, *deviation_interval = deviation
        interval_low, interval_high = deviation_interval
        (rounded_size,) = rounded_to_uncertainty(
            (abs(setting_deviation),), (interval_high - interval_low) / 2, 1e3
        )
        delay_s = headline.parameters["delay_s"].value
        yield Finding(
            kind="delay",
            sentence=(
                f"The torque is {rounded_size} ms "
                f"{'later' if setting_deviation > 0 else 'earlier'} than the file states "
                f"({interval_text(deviation_interval, 1e3)} ms; 95 %): an undeclared delay between "
                "the channels. It was fitted and is not damping."
            ),
            value=setting_deviation,
            interval=(interval_low, interval_high),
            unit="s",
            remedy=f"Declare the delay between the channels as {1e3 * delay_s:.3f} ms.",
            parameters=("delay_s",),
        )
    if deviation := _significant_deviation(candidate_set, headline, "tool_inertia_kg_m2"):
        setting_deviation, *deviation_interval = deviation
        interval_low, interval_high = deviation_interval
        (rounded_size,) = rounded_to_uncertainty(
            (setting_deviation,), (interval_high - interval_low) / 2, 1e6
        )
        yield Finding(
            kind="tool inertia",
            sentence=(
                f"The inertia between torque sensor and beam is {rounded_size}·10⁻⁶ kg·m² larger "
                f"than the file states ({interval_text(deviation_interval, 1e6)}; 95 %): clamp or "
                "flange."
            ),
            value=setting_deviation,
            interval=(interval_low, interval_high),
            unit="kg·m²",
            remedy="A run without the beam measures it; declare it as tool inertia.",
            parameters=("tool_inertia_kg_m2",),
        )


def _beam_findings(candidate_set: CandidateSet, headline: Headline) -> Iterator[Finding]:
    """Yield findings of the beam's density and stiffness that differ from the session file."""
    beam_parameters: tuple[tuple[Setting, str], ...] = (
        ("density_over_stiffness", "Mass per length over bending stiffness (rho/EI)"),
        ("bending_stiffness_n_m2", "The bending stiffness (EI)"),
    )
    for setting_name, description in beam_parameters:
        stated_value = _stated_value(candidate_set, setting_name)
        deviation = _significant_deviation(candidate_set, headline, setting_name)
        if deviation is None or abs(deviation[0]) < _MIN_REPORTED_BEAM_DEVIATION * stated_value:
            continue
        relative_deviation, *deviation_interval = (bound / stated_value for bound in deviation)
        interval_low, interval_high = deviation_interval
        (percent_size,) = rounded_to_uncertainty(
            (abs(relative_deviation),), (interval_high - interval_low) / 2, 100
        )
        other_causes = _equivalent_causes(candidate_set, setting_name)
        yield Finding(
            kind="beam data",
            sentence=(
                f"{description} is {percent_size} % "
                f"{'higher' if relative_deviation > 0 else 'lower'} than the file states "
                f"({interval_text(deviation_interval, 100, '+')} %; 95 %){other_causes}."
            ),
            value=relative_deviation,
            # An interval would claim that it is the beam.
            interval=None if other_causes else (interval_low, interval_high),
            remedy="Weigh and measure the link again, or take the value found.",
            parameters=(setting_name,),
        )


def _equivalent_causes(candidate_set: CandidateSet, setting_name: Setting) -> str:
    """Return a clause naming other causes of a deviating density or stiffness of the beam.

    Return an empty string if there are none.
    """
    if setting_name == "bending_stiffness_n_m2":
        return ", or the torque's gain is wrong, or the clamp is elastic"
    fit, stated_beam = candidate_set.best.fit, candidate_set.comparison.measurement.beam
    tip_mass_effect = (
        math.log(fit.plant.beam.density_over_stiffness / stated_beam.density_over_stiffness) / 4
    )
    stiffness_n_m2 = fit.plant.beam.bending_stiffness_n_m2
    stiffness_std = fit.std["bending_stiffness_n_m2"] or 0.0
    # A small mass at the tip shifts all modes alike, and the torque by a quarter of that shift.
    unexplained_log_stiffness = (
        math.log(stiffness_n_m2 / stated_beam.bending_stiffness_n_m2) + tip_mass_effect
    )
    if (
        fit.plant.tip_mass_kg
        or tip_mass_effect <= 0
        or abs(unexplained_log_stiffness) > SIGNIFICANT_STD * stiffness_std / stiffness_n_m2
    ):
        return ""
    mass_g = 1e3 * tip_mass_effect * stated_beam.density_kg_per_m * stated_beam.length_m
    return f", or the beam carries {mass_g:.2g} g at its tip"


def _initial_ringing_findings(candidate_set: CandidateSet, headline: Headline) -> Iterator[Finding]:
    """Yield a finding if the modal model shows that the beam was ringing when the record began."""
    if headline.modal is None or not headline.modal.determines_response:
        return
    initial_ringing = headline.modal.ringing
    if not initial_ringing.degrees_of_freedom:
        return
    largest_ringing_nm = max(initial_ringing.amplitude_nm)
    # A hum begins and ends with the record, and so resembles a decay.
    hum_nm = max((noise_line.amplitude_nm for noise_line in candidate_set.noise.lines), default=0.0)
    if (
        largest_ringing_nm <= hum_nm
        or chi_square_deviate(initial_ringing.chi_square, initial_ringing.degrees_of_freedom)
        < SIGNIFICANT_STD
    ):
        return
    yield Finding(
        kind="ringing start",
        sentence=(
            f"The beam was ringing when the record began ({1e3 * largest_ringing_nm:.3g} mN·m); "
            "its free decay was fitted and biases nothing."
        ),
        value=largest_ringing_nm,
        unit="N·m",
        remedy=""
        if candidate_set.comparison.measurement.is_later_part
        else "Wait longer at rest before the sweep.",
    )


def _stated_value(candidate_set: CandidateSet, setting_name: Setting) -> float:
    """Return the value in SI units that the session file states for a setting."""
    return candidate_set.comparison.measurement.nominal_plant.parameters[setting_name]


# Disturbances, forces, and what remains

_MAINS_FREQUENCY_TOLERANCE: Final = 0.005
"""Largest relative difference between a multiple of the mains frequency and a hum that is
attributed to the mains."""

_SENSOR_DRIFT_LIMIT_HZ: Final = 0.5
"""Frequency below which a loud residual is attributed to a drift of the torque sensor."""

_MIN_HUM_PERIODS: Final = 5.0
"""Minimum number of periods of a hum within the record. A slower disturbance is attributed to a
drift of the sensor."""

_HARMONIC_PHASE_TOLERANCE_TURNS: Final = 0.5
"""Largest phase difference over the whole record, in turns, between a line and a harmonic of the
excitation."""


def mains_harmonic_text(frequency_hz: float) -> str:
    """Return words that name the mains harmonic near a frequency as source of a disturbance.

    Return an empty string if there is no mains harmonic near it.
    """
    for mains_hz in (50, 60):
        for n in range(1, 9):
            if abs(frequency_hz - n * mains_hz) < _MAINS_FREQUENCY_TOLERANCE * n * mains_hz:
                return "the mains" if n == 1 else f"{n} times the mains frequency"
    return ""


def unexplained_residual_finding(
    whiteness: Whiteness,
    input_dependence: InputRelation,
    modes: tuple[ModeEstimate, ...],
    stiffness_step: StiffnessStep | None = None,
) -> Finding:
    """Return the finding that describes the unexplained residual of a record.

    `stiffness_step` is a step of the stiffness during the record, if it explains more of the
    residual than any effect of the amplitude.
    """
    peak_low_hz, peak_high_hz = whiteness.loudest_hz
    modes_at_peak = [
        mode.number for mode in modes if peak_low_hz <= mode.frequency_hz <= peak_high_hz
    ]
    if stiffness_step is not None:
        description = (
            f"The modes do not fit together. The likeliest cause is {stiffness_step.text}, but one "
            "sweep does not distinguish a change in time from one with frequency."
        )
        remedy = (
            "Fasten clamp and motor mount, and sweep again in both directions "
            "(rigd run chirp --there-and-back)."
        )
    elif input_dependence.related:
        location_words = (
            f"near {input_dependence.at_hz:.1f} Hz"
            if input_dependence.local
            else "all through the band"
        )
        description = (
            f"Unmodelled linear dynamics {location_words}: part of the torque is a linear response "
            "to the motor angle that no nearly uniform beam has."
        )
        remedy = (
            "Fasten clamp, motor mount and sensor cable, and sweep again; then sweep without the "
            "beam: what remains belongs to the rig."
        )
    elif whiteness.loud and modes_at_peak:
        description = (
            f"The residual is {whiteness.loudest_ratio:.1f} times the noise at mode "
            f"{modes_at_peak[0]} ({peak_low_hz:.2f} to {peak_high_hz:.2f} Hz): encoder "
            "quantisation amplified by the resonance, or an unmodelled effect in that mode."
        )
        remedy = "Sweep again at twice the amplitude, which halves the effect of quantisation."
    elif whiteness.loud and peak_high_hz < _SENSOR_DRIFT_LIMIT_HZ:
        description = (
            f"The residual below {peak_high_hz:.2f} Hz is {whiteness.loudest_ratio:.1f} times the "
            "noise and does not follow the motor: zero drift of the torque sensor."
        )
        remedy = ""
    else:
        mains_words = mains_harmonic_text((peak_low_hz + peak_high_hz) / 2)
        description = (
            f"The residual is {whiteness.loudest_ratio:.1f} times the noise from {peak_low_hz:.2f} "
            f"to {peak_high_hz:.2f} Hz and does not follow the motor: a disturbance"
            f"{', such as intermittent mains interference' if mains_words else ''}."
            if whiteness.loud
            else "The residual is not white (most power from "
            f"{peak_low_hz:.2f} to {peak_high_hz:.2f} Hz) and does not follow the motor."
        )
        remedy = (
            "Record for as long with the motor held (rigd run hold). If it is there too, search "
            "for machines nearby, and check shield and earth of the sensor cable."
        )
    return Finding(
        kind="unexplained",
        sentence=f"{description} Until this is explained, do not rely on intervals and orders.",
        value=whiteness.loudest_ratio,
        remedy=remedy,
    )


_DRIFT_SEGMENT_COUNT: Final = 16
"""Number of segments of a record whose mean residual torques are compared."""

_MIN_DRIFT_SCATTER_RATIO: Final = 10.0
"""Minimum scatter of the mean residual torques that is reported as drift, relative to the scatter
due to noise."""


def _torque_zero_drift_nm(candidate_set: CandidateSet) -> float:
    """Return how far the torque sensor's zero point drifts, in N·m; 0 if noise explains it.

    It is the range of the mean residuals of segments of the record.
    """
    comparison = candidate_set.comparison
    predicted_nm, _ = comparison.torque_predictor.torque(candidate_set.best.fit.plant)
    residual_nm = comparison.torque_nm[comparison.retained_samples] - predicted_nm
    segment_length = residual_nm.size // _DRIFT_SEGMENT_COUNT
    segment_means_nm = (
        residual_nm[: _DRIFT_SEGMENT_COUNT * segment_length]
        .reshape(_DRIFT_SEGMENT_COUNT, segment_length)
        .mean(axis=1)
    )
    # Expected scatter for white noise with the power of the band's upper half.
    noise_power_in_upper_half = candidate_set.noise.power[candidate_set.noise.power.size // 2 :]
    noise_std_nm = math.sqrt(
        float(np.median(noise_power_in_upper_half)) / comparison.sample_count / segment_length
    )
    return (
        float(np.ptp(segment_means_nm))
        if float(segment_means_nm.std()) > _MIN_DRIFT_SCATTER_RATIO * noise_std_nm
        else 0.0
    )


def _hum_findings(candidate_set: CandidateSet) -> Iterator[Finding]:
    """Yield findings of torque-sensor drift and of narrow-band disturbances of the torque."""
    comparison = candidate_set.comparison
    duration_s = comparison.sample_count / comparison.decimation.rate_hz
    drift_nm = _torque_zero_drift_nm(candidate_set)
    if drift_nm > 0:
        yield _drift_finding(drift_nm)
    period_s = repetition_period_s(comparison)
    for noise_line in candidate_set.noise.lines:
        if noise_line.frequency_hz * duration_s < _MIN_HUM_PERIODS:
            continue
        mains_words = mains_harmonic_text(noise_line.frequency_hz)
        source_words = f", {mains_words}" if mains_words else ""
        phase_turns = noise_line.frequency_hz * period_s
        is_harmonic = (
            period_s > 0
            and abs(phase_turns - round(phase_turns))
            < _HARMONIC_PHASE_TOLERANCE_TURNS * period_s / duration_s
        )
        yield Finding(
            kind="hum",
            sentence=(
                f"Narrow-band disturbance of the torque at {noise_line.frequency_hz:.2f} "
                f"Hz{source_words}: {1e3 * noise_line.amplitude_nm:.3g} mN·m throughout the "
                "record. "
                + (
                    f"The excitation repeats every {period_s:.4g} s, and so does this line: it may "
                    "be a harmonic due to a nonlinearity. It was left out of the fit."
                    if is_harmonic
                    else "The motor did not cause it; it was removed."
                )
            ),
            value=noise_line.amplitude_nm,
            unit="N·m",
            remedy=(
                "Repeat with half the amplitude: a line that shrinks is caused by the motor."
                if is_harmonic
                else "Check shield and earth of the torque sensor's cable."
            ),
        )


def _drift_finding(drift_nm: float) -> Finding:
    """Return the finding of a zero drift of the torque sensor by `drift_nm` newton metres."""
    return Finding(
        kind="sensor drift",
        sentence=(
            f"The zero of the torque sensor drifts by about {1e3 * drift_nm:.2g} mN·m over the "
            "record, more slowly than the beam responds."
        ),
        value=drift_nm,
        unit="N·m",
    )


def _drag_findings(candidate_set: CandidateSet) -> Iterator[Finding]:
    """Yield the finding of air drag, if the candidates include drag."""
    drag = candidate_set.drag
    if drag is None:
        return
    interval_low_m, interval_high_m = drag.interval_95_m
    (rounded_sizes,) = rounded_to_uncertainty(
        (drag.drag_m,), (interval_high_m - interval_low_m) / 2, 1e3
    )
    yield Finding(
        kind="air drag",
        sentence=(
            f"Air drag acts on the beam: C_D d = {rounded_sizes} mm "
            f"({interval_text(drag.interval_95_m, 1e3)} mm; 95 %) at {drag.pivot_speed_m_s:.2g} "
            "m/s, so damping grows with the amplitude. Drag was fitted too; the beam's parameters "
            "are those without air."
        ),
        value=drag.drag_m,
        interval=drag.interval_95_m,
        unit="m",
        remedy="Sweep at a quarter of the amplitude, where drag is negligible, or in vacuum.",
        parameters=("drag",),
    )


def _force_finding(force: NonlinearForce) -> Finding:
    """Return the finding of a nonlinear restoring force or of quadratic damping."""
    force_size, std, mode_number = force.size, force.std, force.term.mode
    percent_text = f"{100 * abs(force_size):.2g} % (± {100 * NORMAL_95 * std:.1g} %)"
    if force.term.kind == "quadratic drag":
        sentence = (
            f"The damping of mode {mode_number} depends on its speed, as drag in air does: its "
            f"damping ratio is {abs(force_size):.2g} (± {NORMAL_95 * std:.1g}) "
            f"{'higher' if force_size > 0 else 'lower'} at the highest speed than at rest."
        )
    elif force.term.kind == "cubic stiffness":
        sentence = (
            f"The beam is not linear: the stiffness of mode {mode_number} "
            f"{'rises' if force_size > 0 else 'falls'} by {percent_text} up to its largest "
            "deflection (a cubic force). It was fitted too, and affects neither modes nor orders."
        )
    else:
        sentence = (
            f"The beam is not linear: the stiffness of mode {mode_number} differs from one side to "
            f"the other, by {percent_text} at its largest deflection (a quadratic force)."
        )
    return Finding(
        kind="nonlinear damping" if force.term.kind == "quadratic drag" else "nonlinear stiffness",
        sentence=sentence,
        value=force_size,
        interval=(force_size - NORMAL_95 * std, force_size + NORMAL_95 * std),
        remedy="Repeat the sweep at half the amplitude, where nonlinear effects are far smaller.",
    )


def _harmonic_findings(harmonics: tuple[Harmonic, ...]) -> Iterator[Finding]:
    """Yield a finding for each multiple of the sweep frequency that is present in the residual."""
    for harmonic in harmonics:
        if harmonic.present:
            parity_words = "odd" if harmonic.multiple % 2 else "even"
            yield Finding(
                kind="harmonics",
                sentence=(
                    f"The residual follows the sweep at {harmonic.multiple} times its frequency, "
                    f"most with the sweep at {harmonic.drive_hz:.1f} Hz: an {parity_words} "
                    "harmonic, which only a nonlinearity produces."
                ),
                value=harmonic.deviate,
                unit="standard deviations",
                remedy="Repeat the sweep at half the amplitude; check the clamp for backlash.",
            )
