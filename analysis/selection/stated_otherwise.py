"""Where beam and instruments are not as the file states them."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from analysis.selection.chance import SURE, of_chi_square
from analysis.selection.finding import Finding
from analysis.selection.orders import EVEN, STRONG, rivals
from analysis.selection.restart import vector
from analysis.selection.rig_findings import of_rig

if TYPE_CHECKING:
    from collections.abc import Iterator

    from analysis.selection.candidates import Field
    from analysis.whole_record import Setting

_MANY: Final = 40
"""Evaluations of a descent that is to end."""

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


def of_settings(field: Field) -> Iterator[Finding]:
    """Find what of delay, inertia, beam and start is not as the file states it."""
    differing = {name for name in field.free if _apart(field, name) and not _as_stated(field, name)}
    yield from _of_instruments(field, differing)
    yield from _of_beam(field, differing)
    yield from of_rig(field)
    if _rings(field):
        yield from _of_start(field)


def _of_instruments(field: Field, differing: set[Setting]) -> Iterator[Finding]:
    """Find a delay and an inertia that the file does not state."""
    fit = field.best.fit
    if "delay_s" in differing:
        value, low, high = _difference(field, "delay_s")
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
    if "tool_inertia_kg_m2" in differing:
        value, low, high = _difference(field, "tool_inertia_kg_m2")
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


def _of_beam(field: Field, differing: set[Setting]) -> Iterator[Finding]:
    """Find density and stiffness that are not the file's."""
    beam: tuple[tuple[Setting, str], ...] = (
        ("density_over_stiffness", "Mass per length over bending stiffness (rho/EI)"),
        ("bending_stiffness_n_m2", "The bending stiffness (EI)"),
    )
    for name, words in beam:
        stated = _stated(field, name)
        off = _difference(field, name)
        if name not in differing or abs(off[0]) < _BEAM_OFF * stated:
            continue
        share, low, high = (100 * part / stated for part in off)
        yield Finding(
            kind="beam data",
            sentence=(
                f"{words} is {abs(share):.2f} % {'higher' if share > 0 else 'lower'} than the "
                f"file says ({low:+.2f} to {high:+.2f} %; 95 %){_or_else(field, name)}."
            ),
            value=share / 100,
            interval=(low / 100, high / 100),
            unit="1",
            remedy="Weigh and measure the link again, or take the value found.",
        )


def _or_else(field: Field, name: Setting) -> str:
    """Name what does to the torque just what such a deviation does; the sentence's end."""
    if name == "bending_stiffness_n_m2":
        return ", or the torque's gain is"
    fit, beam = field.best.fit, field.comparison.measurement.beam
    share = math.log(fit.plant.beam.density_over_stiffness / beam.density_over_stiffness) / 4
    stiffness = fit.plant.beam.bending_stiffness_n_m2
    std = fit.std["bending_stiffness_n_m2"] or 0.0
    # A small mass at the tip moves all modes alike, and the torque by a quarter of that.
    missing = math.log(stiffness / beam.bending_stiffness_n_m2) + share
    if fit.plant.tip_mass_kg or share <= 0 or abs(missing) > SURE * std / stiffness:
        return ""
    mass_g = 1e3 * share * beam.density_kg_per_m * beam.length_m
    return f", or the beam carries {mass_g:.2g} g at its tip"


def _of_start(field: Field) -> Iterator[Finding]:
    """Say that the beam rang when the record began."""
    loudest = max(field.best.fit.ringing.amplitude_nm)
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


def _rings(field: Field) -> bool:
    """Whether the beam rang at the start, whatever structure it has."""
    loudest = max(field.best.fit.ringing.amplitude_nm, default=0.0)
    # A hum begins and ends with the record, which looks a little like a decay.
    hum = max((line.amplitude_nm for line in field.noise.lines), default=0.0)
    return loudest > hum and all(
        of_chi_square(ringing.chi_square, ringing.degrees_of_freedom) > SURE
        for ringing in (c.fit.ringing for c in (field.best, *rivals(field, EVEN)))
        if ringing.degrees_of_freedom
    )


def _stated(field: Field, name: Setting) -> float:
    """Give the value of a setting in the file."""
    measurement = field.comparison.measurement
    return {
        "density_over_stiffness": measurement.beam.density_over_stiffness,
        "bending_stiffness_n_m2": measurement.beam.bending_stiffness_n_m2,
        "delay_s": measurement.delay_s,
        "tool_inertia_kg_m2": measurement.tool_inertia_kg_m2,
    }[name]


def _apart(field: Field, name: Setting) -> bool:
    """Whether a setting differs from what the file states by more than chance allows.

    So it must in every structure that the data cannot tell from the best.
    """
    stated = _stated(field, name)
    for candidate in (field.best, *rivals(field, EVEN)):
        fit = candidate.fit
        std = fit.std.get(name)
        if not std or fit.interval.get(name) is None:
            return False
        if abs(fit.parameters[name] - stated) < SURE * std:
            return False
    return True


def _as_stated(field: Field, name: Setting) -> bool:
    """Whether any structure explains the record about as well with a setting as the file has it.

    A standard deviation tells what is close to the minimum. This tells whether all else, other
    kinds of damping included, can make up for the setting farther away.
    """
    held = replace(field, free=tuple(other for other in field.free if other != name))
    for candidate in field.candidates:
        structure, uniform, values = candidate.structure, candidate.uniform, candidate.values
        unknowns = held.unknowns(structure, uniform, candidate.extras)
        start = vector(unknowns, candidate.fit.plant)
        saved = field.best.bic + STRONG - (candidate.parameters - 1) * math.log(values)
        enough = values * math.exp(saved / values)
        if (
            held.descent(unknowns, start, 1).promised_cost < enough
            and held.descent(unknowns, start, _MANY).cost < enough
        ):
            return True
    return False


def _difference(field: Field, name: Setting) -> tuple[float, float, float]:
    """By how much a setting differs from what the file states, with the ends of its interval."""
    best, stated = field.best.fit, _stated(field, name)
    low, high = best.interval[name] or (stated, stated)
    return best.parameters[name] - stated, low - stated, high - stated
