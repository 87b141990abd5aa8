"""What is in the record beside the beam of Eq. 25, each by its name and size."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from analysis.selection.channel_checks import clipping, stops
from analysis.selection.finding import Finding
from analysis.selection.hum import repeats_after_s
from analysis.selection.sensor_drift import drift_of_zero
from analysis.selection.stated_otherwise import at_edges, of_settings

if TYPE_CHECKING:
    from collections.abc import Iterator

    from analysis.selection.candidates import Field
    from analysis.selection.harmonics import Harmonic
    from analysis.selection.nonlinear_search import NonlinearForce
    from analysis.selection.whiteness import InputRelation, Whiteness
    from analysis.whole_record import ModeEstimate

_NORMAL_95: Final = 1.959963984540054
_MAINS_WANDER: Final = 0.005
_MODES_TO_JUDGE: Final = 2
_SLOW_HZ: Final = 0.5
_FEWEST_PERIODS: Final = 5.0
"""In the record: what is slower is no hum but a sensor that drifts."""

_SAME_TURN: Final = 0.5
"""Of a turn over the whole record, within which a line's frequency is that of a harmonic."""


def findings(
    field: Field,
    forces: tuple[NonlinearForce, ...],
    multiples: tuple[Harmonic, ...],
    visible: tuple[int, ...],
) -> tuple[Finding, ...]:
    """Name what is there: of a record with a wrong sign or unit, only what needs no model.

    Parameters
    ----------
    field : Field
    forces : tuple of NonlinearForce
        Those the record calls for.
    multiples : tuple of Harmonic
        What the residual holds at multiples of the sweep's frequency.
    visible : tuple of int
        Modes that stand out of the noise. With fewer than two, what the file states is not
        doubted: delay, inertias and stiffness then make up for whatever a structure lacks.
    """
    measurement = field.comparison.measurement
    seen = (*field.misread, *clipping(measurement), *stops(measurement))
    if field.misread:
        return seen
    found = (
        *seen,
        *_hum(field),
        *_air(field),
        *map(_force, forces),
        *_harmonics(multiples),
    )
    edges = tuple(at_edges(field))
    if edges:
        return (*found, *edges)
    if len(visible) < _MODES_TO_JUDGE:
        return found
    return (*found, *of_settings(field))


def mains(frequency_hz: float) -> str:
    """Name the mains if that may be the source, else nothing."""
    for base in (50, 60):
        for n in range(1, 9):
            if abs(frequency_hz - n * base) < _MAINS_WANDER * n * base:
                return "the mains" if n == 1 else f"{n} times the mains frequency"
    return ""


def _hum(field: Field) -> Iterator[Finding]:
    comparison = field.comparison
    duration_s = comparison.samples / comparison.decimation.rate_hz
    drift_nm = drift_of_zero(field)
    if drift_nm > 0:
        yield _drift(drift_nm)
    period_s = repeats_after_s(comparison)
    for line in field.noise.lines:
        if line.frequency_hz * duration_s < _FEWEST_PERIODS:
            continue
        near = mains(line.frequency_hz)
        source = f", {near}" if near else ""
        turns = line.frequency_hz * period_s
        with_drive = period_s > 0 and abs(turns - round(turns)) < _SAME_TURN * period_s / duration_s
        yield Finding(
            kind="hum",
            sentence=(
                f"The torque holds a line at {line.frequency_hz:.2f} Hz{source}, with "
                f"{1e3 * line.amplitude_nm:.3g} mN·m all through the record. "
                + (
                    f"The drive repeats every {period_s:.4g} s, and so does this line: the motor "
                    "may cause it, as a harmonic of what is not linear. It was left out."
                    if with_drive
                    else "The motor did not cause it; it was taken out."
                )
            ),
            value=line.amplitude_nm,
            interval=None,
            unit="N·m",
            remedy=(
                "Repeat with half the amplitude: a line that shrinks is the motor's doing."
                if with_drive
                else "Check shield and earth of the torque sensor's cable."
            ),
        )


def _drift(size_nm: float) -> Finding:
    return Finding(
        kind="sensor drift",
        sentence=(
            f"The zero of the torque sensor drifts by about {1e3 * size_nm:.2g} mN·m in the "
            "course of the record. That is slower than anything the beam does."
        ),
        value=size_nm,
        interval=None,
        unit="N·m",
        remedy="",
    )


def _air(field: Field) -> Iterator[Finding]:
    drag = field.drag
    if drag is None:
        return
    low, high = (1e3 * end for end in drag.interval_95_m)
    yield Finding(
        kind="air drag",
        sentence=(
            f"The air brakes the beam: C_D d = {1e3 * drag.value_m:.4g} mm ({low:.4g} to "
            f"{high:.4g} mm; 95 %) at {drag.speed_m_s:.2g} m/s. The damping therefore grows "
            "with the amplitude; the drag was fitted beside the beam, whose parameters are those "
            "without air."
        ),
        value=drag.value_m,
        interval=drag.interval_95_m,
        unit="m",
        remedy="Sweep at a quarter of the amplitude, where drag all but vanishes, or in vacuum.",
    )


def _force(force: NonlinearForce) -> Finding:
    size, std, mode = force.size, force.std, force.term.mode
    percent = f"{100 * abs(size):.2g} % (± {100 * _NORMAL_95 * std:.1g} %)"
    if force.term.kind == "quadratic drag":
        sentence = (
            f"The damping of mode {mode} depends on its speed, as drag in air does: its damping "
            f"ratio is {abs(size):.2g} (± {_NORMAL_95 * std:.1g}) "
            f"{'higher' if size > 0 else 'lower'} at the highest speed than at rest."
        )
    elif force.term.kind == "cubic stiffness":
        sentence = (
            f"The beam is not linear: the stiffness of mode {mode} "
            f"{'rises' if size > 0 else 'falls'} by {percent} up to its largest deflection (a "
            "cubic force). It is neither a mode nor an order of the damping, and was fitted beside "
            "the beam."
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
        interval=(size - _NORMAL_95 * std, size + _NORMAL_95 * std),
        unit="1",
        remedy="Repeat the sweep at half the amplitude: what is not linear all but vanishes.",
    )


def _harmonics(multiples: tuple[Harmonic, ...]) -> Iterator[Finding]:
    for harmonic in multiples:
        if harmonic.present:
            parity = "odd" if harmonic.multiple % 2 else "even"
            yield Finding(
                kind="harmonics",
                sentence=(
                    f"What remains follows the sweep at {harmonic.multiple} times its frequency, "
                    f"most with the drive at {harmonic.drive_hz:.1f} Hz: an {parity} harmonic, "
                    "which nothing linear makes."
                ),
                value=harmonic.deviate,
                interval=None,
                unit="standard deviations",
                remedy="Repeat the sweep at half the amplitude; look for play in the clamp.",
            )


def unexplained(
    white: Whiteness, related: InputRelation, modes: tuple[ModeEstimate, ...]
) -> Finding:
    """Describe what remains and has no name."""
    low, high = white.loudest_hz
    at_mode = [mode.number for mode in modes if low <= mode.frequency_hz <= high]
    if related.related:
        where = f"near {related.at_hz:.1f} Hz" if related.local else "all through the band"
        what = (
            f"Part of the torque follows the motor, {where}, in a way that no uniform or nearly "
            "uniform beam does: something else moves along."
        )
        remedy = (
            "Fasten clamp, motor mount and sensor cable, and sweep again; then without the beam: "
            "what stays belongs to the rig."
        )
    elif white.loud and at_mode:
        what = (
            f"What remains is {white.loudest_ratio:.1f} times as loud as the noise at mode "
            f"{at_mode[0]} ({low:.2f} to {high:.2f} Hz): steps of the encoder, which the resonance "
            "magnifies, or something of that mode that the model lacks."
        )
        remedy = "Sweep again at twice the amplitude: steps of the encoder then weigh half as much."
    elif white.loud and high < _SLOW_HZ:
        what = (
            f"What remains below {high:.2f} Hz is {white.loudest_ratio:.1f} times as loud as the "
            "noise and does not follow the motor: drift of the torque sensor's zero."
        )
        remedy = ""
    else:
        near = mains((low + high) / 2)
        what = (
            f"What remains is {white.loudest_ratio:.1f} times as loud as the noise from "
            f"{low:.2f} to {high:.2f} Hz, and does not follow the motor: a disturbance"
            f"{', as of the mains that come and go' if near else ''}."
            if white.loud
            else "What remains is not spread over the frequencies as the noise is (most from "
            f"{low:.2f} to {high:.2f} Hz), and does not follow the motor."
        )
        remedy = (
            "Record for as long with the motor held (rigd run hold): if it is there as well, look "
            "for what else runs near by, and at the sensor's shield and earth."
        )
    return Finding(
        kind="unexplained",
        sentence=f"{what} Until it is known, take intervals and orders with care.",
        value=white.loudest_ratio,
        interval=None,
        unit="1",
        remedy=remedy,
    )
