"""Findings on the rig beside a uniform beam, a rigid clamp and ideal channels, in words."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from analysis.identify._candidate import MODES_FREE, Candidate
from analysis.identify._finding import Finding
from analysis.identify._verdict import STRONG
from analysis.statistics import NORMAL_95

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from analysis.identify._candidates import CandidateSet


def of_rig(field: CandidateSet) -> Iterator[Finding]:
    """Find what shifts the modes, or the torque against the angle, as nothing uniform does.

    Kinds of rig are compared as `CandidateSet.freest` does it: with every order free. What explains
    the record equally well is named in one sentence, without intervals.
    """
    freest = field.freest
    others = field.other_kinds(STRONG)
    if not _beside(freest):
        yield from _beside_a_uniform_beam(others)
        return
    if not others:
        yield _alone(freest)
        return
    yield Finding(
        kind="rival explanations",
        sentence=(
            "The record is not that of a uniform beam on a rigid clamp with ideal channels; it is "
            f"fitted equally well by {' or by '.join(map(_about, (freest, *others)))}."
        ),
        remedy=(
            "Check clamp, tip and signal conditioning for these; a sweep that reaches one more "
            "mode distinguishes them."
        ),
    )


def _beside(candidate: Candidate) -> str:
    """One of the extras, "modes free", or "" for a uniform beam and nothing beside it."""
    return "".join(candidate.extras) or ("" if candidate.uniform else MODES_FREE)


def _beside_a_uniform_beam(others: tuple[Candidate, ...]) -> Iterator[Finding]:
    """Name what explains the record as well as a uniform beam with its orders free does."""
    if not others:
        return
    named = [f"{_about(each)} (type {each.structure.name})" for each in others]
    yield Finding(
        kind="rival explanations",
        sentence=(
            "A uniform beam with free orders fits the record, and equally well one with "
            f"{' or with '.join(named)}. Numbers in which they differ are flagged."
        ),
        remedy="A sweep that reaches one more mode distinguishes them.",
    )


def _alone(candidate: Candidate) -> Finding:
    """Name what alone explains the record."""
    kind = _beside(candidate)
    if kind == MODES_FREE:
        return _not_uniform(candidate)
    value = candidate.fit.parameters[kind]
    interval = candidate.fit.interval[kind] or (value, value)
    return _SAY[kind](value, interval)


def _about(candidate: Candidate) -> str:
    """Name one of several explanations, with its size."""
    kind = _beside(candidate)
    if kind == MODES_FREE:
        return "a stiffness correction per mode"
    value = candidate.fit.parameters[kind]
    return {
        "root_compliance_rad_per_nm": f"an elastic clamp of {_reciprocal(value):.3g} N·m/rad",
        "tip_mass_kg": f"a tip mass of {1e3 * value:.3g} g",
        "filter_time_constant_s": (
            f"a first-order low-pass filter of {_corner_hz(value):.3g} Hz in the torque channel"
        ),
        "second_order_filter_time_constant_s": (
            f"a second-order low-pass filter of {_corner_hz(value):.3g} Hz in the torque channel"
        ),
        "clock_rate_difference": f"clocks that differ in rate by {1e6 * value:+.3g} ppm",
    }[kind]


def _not_uniform(candidate: Candidate) -> Finding:
    fit = candidate.fit
    offsets = [
        f"mode {name.rsplit('_', 1)[1]} {100 * fit.parameters[name]:+.2f} %"
        f" (± {100 * NORMAL_95 * (fit.std[name] or 0.0):.1g} %)"
        for name in fit.interval
        if name.startswith("stiffness_offset")
    ]
    return Finding(
        kind="not uniform",
        sentence=(
            "The modes are not those of a uniform beam; stiffness relative to mode 1: "
            f"{', '.join(offsets)}."
        ),
        remedy="Look for an added mass or a section that varies along the link.",
    )


def _elastic_clamp(value: float, interval: tuple[float, float]) -> Finding:
    stiffness = _reciprocal(value)
    low, high = (_reciprocal(end) for end in reversed(interval))
    return Finding(
        kind="elastic clamp",
        sentence=(
            f"The clamp is elastic: {stiffness:.3g} N·m/rad "
            f"({low:.3g} to {high:.3g} N·m/rad; 95 %). It was fitted too."
        ),
        value=stiffness,
        interval=(low, high),
        unit="N·m/rad",
        remedy="Tighten or stiffen the clamp, and sweep again.",
    )


def _tip_mass(value: float, interval: tuple[float, float]) -> Finding:
    low, high = interval
    return Finding(
        kind="tip mass",
        sentence=(
            f"The beam carries a mass at its tip: {1e3 * value:.3g} g ({1e3 * low:.3g} to "
            f"{1e3 * high:.3g} g; 95 %). It was fitted too."
        ),
        value=value,
        interval=interval,
        unit="kg",
        remedy="Weigh what is attached to the tip, or remove it.",
    )


def _filter(order: int) -> Callable[[float, tuple[float, float]], Finding]:
    words = "first" if order == 1 else "second"

    def say(value: float, interval: tuple[float, float]) -> Finding:
        corner_hz = _corner_hz(value)
        low, high = (_corner_hz(end) for end in reversed(interval))
        return Finding(
            kind="torque filter",
            sentence=(
                f"The torque channel has a low-pass filter of {words} order with its corner at "
                f"{corner_hz:.3g} Hz ({low:.3g} to {high:.3g} Hz; 95 %) that the file does not "
                "state. It was fitted, and is not damping."
            ),
            value=corner_hz,
            interval=(low, high),
            unit="Hz",
            remedy=(
                f"Switch the sensor's filter off, or state it in the file: torque_filter_hz = "
                f"{corner_hz:.4g}, torque_filter_order = {order}."
            ),
        )

    return say


def _clocks(value: float, interval: tuple[float, float]) -> Finding:
    low, high = interval
    return Finding(
        kind="clock rate difference",
        sentence=(
            "Angle and torque were sampled by clocks of different rates: the torque's samples are "
            f"{abs(1e6 * value):.3g} ppm {'farther apart' if value > 0 else 'closer'} than the "
            f"angle's ({1e6 * low:+.3g} to {1e6 * high:+.3g} ppm; 95 %), so the delay between the "
            "channels changes along the record. It was fitted, and is not damping."
        ),
        value=value,
        interval=interval,
        remedy="Sample both channels by one clock, or correct the torque's time base.",
    )


_SAY: Final[dict[str, Callable[[float, tuple[float, float]], Finding]]] = {
    "root_compliance_rad_per_nm": _elastic_clamp,
    "tip_mass_kg": _tip_mass,
    "filter_time_constant_s": _filter(1),
    "second_order_filter_time_constant_s": _filter(2),
    "clock_rate_difference": _clocks,
}


def _reciprocal(value: float) -> float:
    return 1 / value if value > 0 else math.inf


def _corner_hz(time_constant_s: float) -> float:
    return _reciprocal(2 * math.pi * time_constant_s)
