"""Findings on the rig beside a uniform beam, a rigid clamp and ideal channels, in words."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from analysis.identify._candidate import MODES_FREE, Candidate
from analysis.identify._finding import Finding
from analysis.identify._verdict import STRONG
from analysis.statistics import NORMAL_95
from rigd.units import interval_text, to_uncertainty

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from analysis.identify._candidates import CandidateSet

_ORDER_OF_FILTER: Final = {
    "filter_time_constant_s": "first", "second_order_filter_time_constant_s": "second",
}  # fmt: skip
"""Order of the low-pass filter that each time constant belongs to."""


def of_rig(field: CandidateSet) -> Iterator[Finding]:
    """Find what shifts the modes, or the torque against the angle, as nothing uniform does.

    Kinds of rig are compared as `CandidateSet.freest` does it: with every order free. What explains
    the record equally well is named in one sentence, without intervals.
    """
    freest = field.freest
    others = field.other_kinds(STRONG)
    if not _beside(freest):
        yield from _beside_a_uniform_beam(others, field)
        return
    if not others:
        yield _alone(freest, field)
        return
    explanations = [_about(each, field) for each in (freest, *others)]
    yield Finding(
        kind="rival explanations",
        sentence=(
            "The record is not that of a uniform beam on a rigid clamp with ideal channels; it is "
            f"fitted equally well by {' or by '.join(explanations)}."
        ),
        remedy=(
            "Check clamp, tip and signal conditioning for these; a sweep that reaches one more "
            "mode distinguishes them."
        ),
    )


def _beside(candidate: Candidate) -> str:
    """One of the extras, "modes free", or "" for a uniform beam and nothing beside it."""
    return "".join(candidate.extras) or ("" if candidate.uniform else MODES_FREE)


def _beside_a_uniform_beam(others: tuple[Candidate, ...], field: CandidateSet) -> Iterator[Finding]:
    """Name what explains the record as well as a uniform beam with its orders free does."""
    if not others:
        return
    named = [f"{_about(each, field)} (type {each.structure.name})" for each in others]
    yield Finding(
        kind="rival explanations",
        sentence=(
            "A uniform beam with free orders fits the record, and equally well one with "
            f"{' or with '.join(named)}. Numbers in which they differ are flagged."
        ),
        remedy="A sweep that reaches one more mode distinguishes them.",
    )


def _alone(candidate: Candidate, field: CandidateSet) -> Finding:
    """Name what alone explains the record."""
    kind = _beside(candidate)
    if kind == MODES_FREE:
        return _not_uniform(candidate)
    value = candidate.fit.parameters[kind]
    interval = candidate.fit.interval[kind] or (value, value)
    found = _SAY[kind](value, interval, _stated_filter(kind, field))
    return replace(found, parameters=(kind,))


def _about(candidate: Candidate, field: CandidateSet) -> str:
    """Name one of several explanations, with its size."""
    kind = _beside(candidate)
    if kind == MODES_FREE:
        return "a stiffness correction per mode"
    value = candidate.fit.parameters[kind]
    stated = _stated_filter(kind, field)
    beside = f" ({stated})" if stated else ""
    return {
        "root_compliance_rad_per_nm": f"an elastic clamp of {_reciprocal(value):.3g} N·m/rad",
        "tip_mass_kg": f"a tip mass of {1e3 * value:.3g} g",
        "filter_time_constant_s": (
            f"a first-order low-pass filter of {_corner_hz(value):.3g} Hz in the torque channel"
            f"{beside}"
        ),
        "second_order_filter_time_constant_s": (
            f"a second-order low-pass filter of {_corner_hz(value):.3g} Hz in the torque channel"
            f"{beside}"
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
        parameters=tuple(name for name in fit.interval if name.startswith("stiffness_offset")),
    )


def _elastic_clamp(value: float, interval: tuple[float, float], _: str) -> Finding:
    low, high = (_reciprocal(end) for end in reversed(interval))
    stiffness = _reciprocal(value)
    (size,) = to_uncertainty((stiffness,), (high - low) / 2)
    return Finding(
        kind="elastic clamp",
        sentence=(
            f"The clamp is elastic: {size} N·m/rad "
            f"({interval_text((low, high))} N·m/rad; 95 %). It was fitted too."
        ),
        value=stiffness,
        interval=(low, high),
        unit="N·m/rad",
        remedy="Tighten or stiffen the clamp, and sweep again.",
    )


def _tip_mass(value: float, interval: tuple[float, float], _: str) -> Finding:
    low, high = interval
    (size,) = to_uncertainty((value,), (high - low) / 2, 1e3)
    return Finding(
        kind="tip mass",
        sentence=(
            f"The beam carries a mass at its tip: {size} g ({interval_text(interval, 1e3)} g; "
            "95 %). It was fitted too."
        ),
        value=value,
        interval=interval,
        unit="kg",
        remedy="Weigh what is attached to the tip, or remove it.",
    )


def _stated_filter(kind: str, field: CandidateSet) -> str:
    """Say which low-pass filter the file states, if `kind` is one and it states any."""
    if kind not in _ORDER_OF_FILTER:
        return ""
    for name, words in _ORDER_OF_FILTER.items():
        constant_s = getattr(field.comparison.measurement, name)
        if constant_s:
            return f"the file states one of {words} order at {_corner_hz(constant_s):.4g} Hz"
    return ""


def _filter(order: int) -> Callable[[float, tuple[float, float], str], Finding]:
    words = "first" if order == 1 else "second"

    def say(value: float, interval: tuple[float, float], stated: str) -> Finding:
        low, high = (_corner_hz(end) for end in reversed(interval))
        corner_hz = _corner_hz(value)
        (size,) = to_uncertainty((corner_hz,), (high - low) / 2)
        file = f"; {stated}" if stated else " that the file does not state"
        return Finding(
            kind="torque filter",
            sentence=(
                f"The torque channel has a low-pass filter of {words} order with its corner at "
                f"{size} Hz ({interval_text((low, high))} Hz; 95 %){file}. It was fitted, and is "
                "not damping."
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


def _clocks(value: float, interval: tuple[float, float], _: str) -> Finding:
    low, high = interval
    (size,) = to_uncertainty((abs(value),), (high - low) / 2, 1e6)
    return Finding(
        kind="clock rate difference",
        sentence=(
            "Angle and torque were sampled by clocks of different rates: the torque's samples are "
            f"{size} ppm {'farther apart' if value > 0 else 'closer'} than the "
            f"angle's ({interval_text(interval, 1e6, '+')} ppm; 95 %), so the delay between the "
            "channels changes along the record. It was fitted, and is not damping."
        ),
        value=value,
        interval=interval,
        remedy="Sample both channels by one clock, or correct the torque's time base.",
    )


_SAY: Final[dict[str, Callable[[float, tuple[float, float], str], Finding]]] = {
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
