"""Diagnostics of a record: effects other than the beam of Eq. 25, by name and size.

Settings at the edge of the search range or different from the file, disturbances of the torque,
nonlinear forces, drag, a free decay at the start, and the unexplained residual.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from analysis.identify._channel_checks import clipping, drift_of_zero, stops
from analysis.identify._finding import Finding
from analysis.identify._leakage import repeats_after_s
from analysis.identify.residual_tests import SIGNIFICANT_STD
from analysis.statistics import NORMAL_95, chi_square_deviate
from rigd.units import interval_text, to_uncertainty

if TYPE_CHECKING:
    from collections.abc import Iterator

    from analysis.identify._candidates import CandidateSet
    from analysis.identify._nonlinear import NonlinearForce
    from analysis.identify._plant import Setting
    from analysis.identify._result import ModeEstimate
    from analysis.identify._step_in_time import Step
    from analysis.identify.headline import Headline
    from analysis.identify.residual_tests import Harmonic, InputRelation, Whiteness


def findings(
    candidate_set: CandidateSet,
    forces: tuple[NonlinearForce, ...],
    multiples: tuple[Harmonic, ...],
) -> tuple[Finding, ...]:
    """Return the findings; for a record with a wrong sign or unit, only those without a model.

    Parameters
    ----------
    candidate_set : CandidateSet
    forces : tuple of NonlinearForce
        Significant forces.
    multiples : tuple of Harmonic
        Residual at multiples of the sweep's frequency.
    """
    measurement = candidate_set.comparison.measurement
    seen = (*candidate_set.misread, *clipping(measurement), *stops(measurement))
    if candidate_set.misread:
        return seen
    found = (
        *seen,
        *_hum(candidate_set),
        *_air(candidate_set),
        *map(_force, forces),
        *_harmonics(multiples),
    )
    return (*found, *at_edges(candidate_set))


# Settings at an edge, or not as the file states them

_DELAY_OFF_S: Final = 1e-4
"""Smallest reported delay: backlash of a few tenths of a milliradian passes for a shorter one."""

_BEAM_OFF: Final = 0.003
"""Deviation of stiffness or density, relative to the file, that is reported."""


def at_edges(candidate_set: CandidateSet) -> Iterator[Finding]:
    """Yield settings at the edge of the search range, which no real rig reaches."""
    fit = candidate_set.best.fit
    for name, words, factor, unit in (
        ("delay_s", "The delay between the channels", 1e3, "ms"),
        ("density_over_stiffness", "Mass per length over bending stiffness (rho/EI)", 1, "s²/m⁴"),
        ("bending_stiffness_n_m2", "The bending stiffness (EI)", 1, "N·m²"),
    ):
        if name in fit.at_bounds:
            value = fit.parameters[name]
            yield Finding(
                kind="implausible",
                sentence=(
                    f"{words} would have to be {factor * value:.4g} {unit} or beyond, which is "
                    "the limit of the search range: the record contradicts its file. "
                    "No number here is valid for the antenna."
                ),
                value=value,
                unit=unit if factor == 1 else "s",
                remedy=(
                    "Check the signs and the units of angle and torque, and the beam's length, "
                    "density and stiffness in the file."
                ),
            )


def of_settings(candidate_set: CandidateSet, headline: Headline) -> Iterator[Finding]:
    """Yield delay, inertia, beam data and initial ringing that differ from the file.

    Parameters with a flag in `headline` are no finding.
    """
    yield from _of_instruments(candidate_set, headline)
    yield from _of_beam(candidate_set, headline)
    yield from _of_start(candidate_set, headline)


def _difference(
    candidate_set: CandidateSet, headline: Headline, name: Setting
) -> tuple[float, float, float] | None:
    """Return the difference of a setting from the file, with the ends of its interval.

    Return None if chance explains the difference, or if the value carries a flag.
    """
    quantity, stated = headline.parameters.get(name), _stated(candidate_set, name)
    if quantity is None or quantity.flag or not quantity.std or quantity.interval_95 is None:
        return None
    if abs(quantity.value - stated) < SIGNIFICANT_STD * quantity.std:
        return None
    low, high = quantity.interval_95
    return quantity.value - stated, low - stated, high - stated


def _of_instruments(candidate_set: CandidateSet, headline: Headline) -> Iterator[Finding]:
    """Yield a delay and an inertia that the file does not state."""
    off = _difference(candidate_set, headline, "delay_s")
    if off is not None and abs(off[0]) > _DELAY_OFF_S:
        value, *interval = off
        low, high = interval
        (size,) = to_uncertainty((abs(value),), (high - low) / 2, 1e3)
        delay_s = headline.parameters["delay_s"].value
        yield Finding(
            kind="delay",
            sentence=(
                f"The torque is {size} ms {'later' if value > 0 else 'earlier'} "
                f"than the file states ({interval_text(interval, 1e3)} ms; 95 %): an "
                "undeclared delay between the channels. It was fitted and is not damping."
            ),
            value=value,
            interval=(low, high),
            unit="s",
            remedy=f"Declare the delay between the channels as {1e3 * delay_s:.3f} ms.",
            parameters=("delay_s",),
        )
    if off := _difference(candidate_set, headline, "tool_inertia_kg_m2"):
        value, *interval = off
        low, high = interval
        (size,) = to_uncertainty((value,), (high - low) / 2, 1e6)
        yield Finding(
            kind="tool inertia",
            sentence=(
                f"The inertia between torque sensor and beam is {size}·10⁻⁶ kg·m² larger than the "
                f"file states ({interval_text(interval, 1e6)}; 95 %): clamp or flange."
            ),
            value=value,
            interval=(low, high),
            unit="kg·m²",
            remedy="A run without the beam measures it; declare it as tool inertia.",
            parameters=("tool_inertia_kg_m2",),
        )


def _of_beam(candidate_set: CandidateSet, headline: Headline) -> Iterator[Finding]:
    """Yield density and stiffness that differ from the file."""
    beam: tuple[tuple[Setting, str], ...] = (
        ("density_over_stiffness", "Mass per length over bending stiffness (rho/EI)"),
        ("bending_stiffness_n_m2", "The bending stiffness (EI)"),
    )
    for name, words in beam:
        stated = _stated(candidate_set, name)
        off = _difference(candidate_set, headline, name)
        if off is None or abs(off[0]) < _BEAM_OFF * stated:
            continue
        relative, *interval = (part / stated for part in off)
        low, high = interval
        (size,) = to_uncertainty((abs(relative),), (high - low) / 2, 100)
        yield Finding(
            kind="beam data",
            sentence=(
                f"{words} is {size} % {'higher' if relative > 0 else 'lower'} than the "
                f"file states ({interval_text(interval, 100, '+')} %; 95 %)"
                f"{_equivalent_causes(candidate_set, name)}."
            ),
            value=relative,
            interval=(low, high),
            remedy="Weigh and measure the link again, or take the value found.",
            parameters=(name,),
        )


def _equivalent_causes(candidate_set: CandidateSet, name: Setting) -> str:
    """Return the end of the sentence that names other causes with the same effect on the torque."""
    if name == "bending_stiffness_n_m2":
        return ", or the torque's gain is"
    fit, beam = candidate_set.best.fit, candidate_set.comparison.measurement.beam
    relative = math.log(fit.plant.beam.density_over_stiffness / beam.density_over_stiffness) / 4
    stiffness = fit.plant.beam.bending_stiffness_n_m2
    std = fit.std["bending_stiffness_n_m2"] or 0.0
    # A small mass at the tip moves all modes alike, and the torque by a quarter of that.
    missing = math.log(stiffness / beam.bending_stiffness_n_m2) + relative
    if fit.plant.tip_mass_kg or relative <= 0 or abs(missing) > SIGNIFICANT_STD * std / stiffness:
        return ""
    mass_g = 1e3 * relative * beam.density_kg_per_m * beam.length_m
    return f", or the beam carries {mass_g:.2g} g at its tip"


def _of_start(candidate_set: CandidateSet, headline: Headline) -> Iterator[Finding]:
    """Yield a finding if the modal model shows that the beam rang at the beginning."""
    ringing = None if headline.modal is None else headline.modal.ringing
    if ringing is None or not ringing.degrees_of_freedom:
        return
    loudest = max(ringing.amplitude_nm)
    # A hum begins and ends with the record, and so resembles a decay.
    hum = max((line.amplitude_nm for line in candidate_set.noise.lines), default=0.0)
    if (
        loudest <= hum
        or chi_square_deviate(ringing.chi_square, ringing.degrees_of_freedom) < SIGNIFICANT_STD
    ):
        return
    yield Finding(
        kind="ringing start",
        sentence=(
            f"The beam was ringing when the record began ({1e3 * loudest:.3g} mN·m); its free "
            "decay was fitted and biases nothing."
        ),
        value=loudest,
        unit="N·m",
        remedy="Wait longer at rest before the sweep.",
    )


def _stated(candidate_set: CandidateSet, name: Setting) -> float:
    """Return the value of a setting in the file."""
    measurement = candidate_set.comparison.measurement
    return {
        "density_over_stiffness": measurement.beam.density_over_stiffness,
        "bending_stiffness_n_m2": measurement.beam.bending_stiffness_n_m2,
        "delay_s": measurement.delay_s,
        "tool_inertia_kg_m2": measurement.tool_inertia_kg_m2,
    }[name]


# Disturbances, forces, and what remains

_MAINS_WANDER: Final = 0.005

_SLOW_HZ: Final = 0.5
_FEWEST_PERIODS: Final = 5.0
"""In the record: what is slower is not a hum but a sensor that drifts."""

_SAME_TURN: Final = 0.5
"""Phase over the whole record, in turns, within which a line's frequency is a harmonic's."""


def mains(frequency_hz: float) -> str:
    """Return the name of the mains if it may be the source, else an empty string."""
    for base in (50, 60):
        for n in range(1, 9):
            if abs(frequency_hz - n * base) < _MAINS_WANDER * n * base:
                return "the mains" if n == 1 else f"{n} times the mains frequency"
    return ""


def unexplained(
    white: Whiteness,
    related: InputRelation,
    modes: tuple[ModeEstimate, ...],
    step: Step | None = None,
) -> Finding:
    """Return the finding that describes the unexplained residual.

    `step` is the step of the stiffness that explains more of it than any effect of the amplitude.
    """
    low, high = white.loudest_hz
    at_mode = [mode.number for mode in modes if low <= mode.frequency_hz <= high]
    if step is not None:
        what = (
            f"The modes do not fit together. The likeliest cause is {step.words}, but one sweep "
            "does not tell a change in time from one with the frequency."
        )
        remedy = (
            "Fasten clamp and motor mount, and sweep again in both directions "
            "(rigd run chirp --there-and-back)."
        )
    elif related.related:
        where = f"near {related.at_hz:.1f} Hz" if related.local else "all through the band"
        what = (
            f"Unmodelled linear dynamics {where}: part of the torque is a linear response to "
            "the motor angle that no nearly uniform beam has."
        )
        remedy = (
            "Fasten clamp, motor mount and sensor cable, and sweep again; then sweep without the "
            "beam: what remains belongs to the rig."
        )
    elif white.loud and at_mode:
        what = (
            f"The residual is {white.loudest_ratio:.1f} times the noise at mode {at_mode[0]} "
            f"({low:.2f} to {high:.2f} Hz): encoder quantisation amplified by the resonance, or an "
            "unmodelled effect in that mode."
        )
        remedy = "Sweep again at twice the amplitude, which halves the effect of quantisation."
    elif white.loud and high < _SLOW_HZ:
        what = (
            f"The residual below {high:.2f} Hz is {white.loudest_ratio:.1f} times the noise and "
            "does not follow the motor: zero drift of the torque sensor."
        )
        remedy = ""
    else:
        near = mains((low + high) / 2)
        what = (
            f"The residual is {white.loudest_ratio:.1f} times the noise from {low:.2f} to "
            f"{high:.2f} Hz and does not follow the motor: a disturbance"
            f"{', such as intermittent mains interference' if near else ''}."
            if white.loud
            else "The residual is not white (most power from "
            f"{low:.2f} to {high:.2f} Hz) and does not follow the motor."
        )
        remedy = (
            "Record for as long with the motor held (rigd run hold). If it is there too, search "
            "for machines nearby, and check shield and earth of the sensor cable."
        )
    return Finding(
        kind="unexplained",
        sentence=f"{what} Until this is explained, do not rely on intervals and orders.",
        value=white.loudest_ratio,
        remedy=remedy,
    )


def _hum(candidate_set: CandidateSet) -> Iterator[Finding]:
    comparison = candidate_set.comparison
    duration_s = comparison.samples / comparison.decimation.rate_hz
    drift_nm = drift_of_zero(candidate_set)
    if drift_nm > 0:
        yield _drift(drift_nm)
    period_s = repeats_after_s(comparison)
    for line in candidate_set.noise.lines:
        if line.frequency_hz * duration_s < _FEWEST_PERIODS:
            continue
        near = mains(line.frequency_hz)
        source = f", {near}" if near else ""
        turns = line.frequency_hz * period_s
        with_drive = period_s > 0 and abs(turns - round(turns)) < _SAME_TURN * period_s / duration_s
        yield Finding(
            kind="hum",
            sentence=(
                f"Narrow-band disturbance of the torque at {line.frequency_hz:.2f} Hz{source}: "
                f"{1e3 * line.amplitude_nm:.3g} mN·m throughout the record. "
                + (
                    f"The excitation repeats every {period_s:.4g} s, and so does this line: it may "
                    "be a harmonic due to a nonlinearity. It was left out of the fit."
                    if with_drive
                    else "The motor did not cause it; it was removed."
                )
            ),
            value=line.amplitude_nm,
            unit="N·m",
            remedy=(
                "Repeat with half the amplitude: a line that shrinks is caused by the motor."
                if with_drive
                else "Check shield and earth of the torque sensor's cable."
            ),
        )


def _drift(size_nm: float) -> Finding:
    return Finding(
        kind="sensor drift",
        sentence=(
            f"The zero of the torque sensor drifts by about {1e3 * size_nm:.2g} mN·m over the "
            "record, more slowly than the beam responds."
        ),
        value=size_nm,
        unit="N·m",
    )


def _air(candidate_set: CandidateSet) -> Iterator[Finding]:
    drag = candidate_set.drag
    if drag is None:
        return
    low, high = drag.interval_95_m
    (size,) = to_uncertainty((drag.value_m,), (high - low) / 2, 1e3)
    yield Finding(
        kind="air drag",
        sentence=(
            f"Air drag acts on the beam: C_D d = {size} mm "
            f"({interval_text(drag.interval_95_m, 1e3)} mm; 95 %) at {drag.speed_m_s:.2g} "
            "m/s, so damping grows with the amplitude. Drag was fitted too; the beam's parameters "
            "are those without air."
        ),
        value=drag.value_m,
        interval=drag.interval_95_m,
        unit="m",
        remedy="Sweep at a quarter of the amplitude, where drag is negligible, or in vacuum.",
        parameters=("drag",),
    )


def _force(force: NonlinearForce) -> Finding:
    size, std, mode = force.size, force.std, force.term.mode
    percent = f"{100 * abs(size):.2g} % (± {100 * NORMAL_95 * std:.1g} %)"
    if force.term.kind == "quadratic drag":
        sentence = (
            f"The damping of mode {mode} depends on its speed, as drag in air does: its damping "
            f"ratio is {abs(size):.2g} (± {NORMAL_95 * std:.1g}) "
            f"{'higher' if size > 0 else 'lower'} at the highest speed than at rest."
        )
    elif force.term.kind == "cubic stiffness":
        sentence = (
            f"The beam is not linear: the stiffness of mode {mode} "
            f"{'rises' if size > 0 else 'falls'} by {percent} up to its largest deflection (a "
            "cubic force). It was fitted too, and affects neither modes nor orders."
        )
    else:
        sentence = (
            f"The beam is not linear: the stiffness of mode {mode} differs from one side to the "
            f"other, by {percent} at its largest deflection (a quadratic force)."
        )
    return Finding(
        kind="nonlinear damping" if force.term.kind == "quadratic drag" else "nonlinear stiffness",
        sentence=sentence,
        value=size,
        interval=(size - NORMAL_95 * std, size + NORMAL_95 * std),
        remedy="Repeat the sweep at half the amplitude, where nonlinear effects are far smaller.",
    )


def _harmonics(multiples: tuple[Harmonic, ...]) -> Iterator[Finding]:
    for harmonic in multiples:
        if harmonic.present:
            parity = "odd" if harmonic.multiple % 2 else "even"
            yield Finding(
                kind="harmonics",
                sentence=(
                    f"The residual follows the sweep at {harmonic.multiple} times its frequency, "
                    f"most with the sweep at {harmonic.drive_hz:.1f} Hz: an {parity} harmonic, "
                    "which only a nonlinearity produces."
                ),
                value=harmonic.deviate,
                unit="standard deviations",
                remedy="Repeat the sweep at half the amplitude; check the clamp for backlash.",
            )
