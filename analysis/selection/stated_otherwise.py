"""Where beam and instruments are not as the file states them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from analysis.selection.chance import SURE, of_chi_square
from analysis.selection.finding import Finding
from analysis.selection.orders import EVEN, rivals

if TYPE_CHECKING:
    from collections.abc import Iterator

    from analysis.selection.candidates import Field

_NORMAL_95: Final = 1.959963984540054
_BEAM_OFF: Final = 0.003
"""Deviation of stiffness or density, relative to the file's, worth a word."""


def at_edges(field: Field) -> Iterator[Finding]:
    """Find settings that the search took as far as it goes; no rig is so far from its file."""
    fit = field.best.fit
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
                    f"{words} would have to be {factor * value:.4g} {unit} or go farther, which is "
                    "the edge of what is searched: the record and its file do not fit each other. "
                    "No number here is the antenna's."
                ),
                value=value,
                interval=None,
                unit=unit if factor == 1 else "s",
                remedy=(
                    "Check the signs and the units of angle and torque, and the beam's length, "
                    "density and stiffness in the file."
                ),
            )


def of_instruments(field: Field) -> Iterator[Finding]:
    """Find a delay and an inertia that the file does not state."""
    measurement, fit = field.comparison.measurement, field.best.fit
    late = _difference(field, "delay_s", measurement.delay_s)
    if late is not None:
        value, low, high = late
        yield Finding(
            kind="delay",
            sentence=(
                f"The torque comes {1e3 * abs(value):.3f} ms "
                f"{'later' if value > 0 else 'earlier'} than the file says "
                f"({1e3 * low:.3f} to {1e3 * high:.3f} ms; 95 %): a delay between the channels "
                "that nobody declared. It was fitted, and is not damping."
            ),
            value=value,
            interval=(low, high),
            unit="s",
            remedy=(
                "Declare the delay between the channels as "
                f"{1e3 * fit.parameters['delay_s']:.3f} ms."
            ),
        )
    tool = _difference(field, "tool_inertia_kg_m2", measurement.tool_inertia_kg_m2)
    if tool is not None:
        value, low, high = tool
        yield Finding(
            kind="tool inertia",
            sentence=(
                f"Between torque sensor and beam turns {value:.3g} kg·m² more than the file says "
                f"({low:.3g} to {high:.3g}; 95 %): clamp or flange."
            ),
            value=value,
            interval=(low, high),
            unit="kg·m²",
            remedy="A run without the beam measures it; declare it as tool inertia.",
        )


def of_beam(field: Field) -> Iterator[Finding]:
    """Find density and stiffness that are not the file's, and modes that lie elsewhere."""
    measurement, fit = field.comparison.measurement, field.best.fit
    for name, stated, words in (
        (
            "density_over_stiffness",
            measurement.beam.density_over_stiffness,
            "Mass per length over bending stiffness (rho/EI)",
        ),
        (
            "bending_stiffness_n_m2",
            measurement.beam.bending_stiffness_n_m2,
            "The bending stiffness (EI)",
        ),
    ):
        off = _difference(field, name, stated)
        if off is None or abs(off[0]) < _BEAM_OFF * stated:
            continue
        share, low, high = (100 * part / stated for part in off)
        yield Finding(
            kind="beam data",
            sentence=(
                f"{words} is {abs(share):.2f} % {'higher' if share > 0 else 'lower'} than the "
                f"file says ({low:+.2f} to {high:+.2f} %; 95 %)."
            ),
            value=share / 100,
            interval=(low / 100, high / 100),
            unit="1",
            remedy="Weigh and measure the link again, or take the value found.",
        )
    if not field.best.uniform:
        offsets = [
            f"mode {name.rsplit('_', 1)[1]} {100 * fit.parameters[name]:+.2f} %"
            f" (± {100 * _NORMAL_95 * (fit.std[name] or 0.0):.1g} %)"
            for name in fit.interval
            if name.startswith("stiffness_offset")
        ]
        yield Finding(
            kind="not uniform",
            sentence=(
                "The modes do not lie where those of a uniform beam do; in stiffness, relative to "
                f"mode 1: {', '.join(offsets)}."
            ),
            value=None,
            interval=None,
            unit="1",
            remedy="Look for an added mass, a soft clamp or a section that varies along the link.",
        )


def of_start(field: Field) -> Iterator[Finding]:
    """Find that the beam rang when the record began."""
    ringing = field.best.fit.ringing
    loudest = max(ringing.amplitude_nm, default=0.0)
    # A hum begins and ends with the record, which looks a little like a decay.
    hum = max((line.amplitude_nm for line in field.noise.lines), default=0.0)
    heard = all(
        of_chi_square(ringing.chi_square, ringing.degrees_of_freedom) > SURE
        for ringing in (c.fit.ringing for c in (field.best, *rivals(field, EVEN)))
        if ringing.degrees_of_freedom
    )
    if heard and loudest > hum:
        yield Finding(
            kind="ringing start",
            sentence=(
                f"The beam already rang when the record began ({1e3 * loudest:.3g} mN·m); its free "
                "decay was fitted beside the response and spoils nothing."
            ),
            value=loudest,
            interval=None,
            unit="N·m",
            remedy="Wait longer at rest before the sweep.",
        )


def _difference(field: Field, name: str, stated: float) -> tuple[float, float, float] | None:
    """By how much a setting differs from what the file states, with ends.

    None if that may be chance, or if a structure that the data cannot tell from the best denies it.
    """
    for candidate in (field.best, *rivals(field, EVEN)):
        fit = candidate.fit
        std, value = fit.std.get(name), fit.parameters[name] - stated
        if not std or fit.interval.get(name) is None or abs(value) < SURE * std:
            return None
    best = field.best.fit
    low, high = best.interval[name] or (stated, stated)
    return best.parameters[name] - stated, low - stated, high - stated
