"""The closed loop on paper: stability, and how far it is from losing it.

What is asked for depends on what a margin stands for (see :mod:`rigd.control.margins`). At the
angle it is the rule of thumb for the gain of a feedback loop, a factor of 2. At torque command and
torque reading, where the beam is cancelled and a factor of 2 cannot be had, it is the tolerance of
a drive's torque constant and of a calibration, taken twice: 20 %. The phase has to bear what such
an error turns a signal by at most (an error of 20 % across it: 11.5°), together with one period of
delay at the second mode (16 Hz: 5.8°): 20°, rounded up. The delay has to bear one period more than
the profile states: a reading or a command that is a tick late.

A loop that misses this is a warning, not a failure: it is stable as described, and whether the
description is right is what such a session may be for.
"""

from collections.abc import Iterator
from math import degrees, inf, radians

from rigd.beam import RealisationError
from rigd.checks.rows import Row, Verdict, grade
from rigd.control import ControlDesignError, check_stability, close_loop
from rigd.control.margins import Margins, loop_margins
from rigd.profile import Profile

TOLERANCE = 1.2
"""Factor that the gains of command and torque reading may be wrong by, up and down."""
LEAST_ANGLE_GAIN = 2.0
LEAST_PHASE_RAD = radians(20.0)
LEAST_DELAY_PERIODS = 1.0


def loop_rows(profile: Profile) -> Iterator[Row]:
    """Judge the loop of a profile's rig."""
    try:
        loop = close_loop(profile.loop_model())
        warning = check_stability(loop)
    except (ControlDesignError, RealisationError) as error:
        yield Row("loop", "stability", str(error), "stable", Verdict.FAIL)
        yield Row("loop", "margins", "the loop is not stable", "", Verdict.SKIPPED)
        return
    if warning is not None:
        yield Row("loop", "stability", warning, "stable", Verdict.WARNING)
        yield Row("loop", "margins", "the loop is not stable", "", Verdict.SKIPPED)
        return
    yield Row(
        "loop",
        "stability",
        f"every mode decays, the slowest at {-loop.growth_per_s:.2g} /s",
        "stable",
        Verdict.OK,
    )
    period_s = 1.0 / profile.rig.rate_hz
    for margins in loop_margins(loop):
        least_gain = LEAST_ANGLE_GAIN if margins.cut == "angle reading" else TOLERANCE
        yield from _margin_rows(margins, least_gain, LEAST_DELAY_PERIODS * period_s)


def _margin_rows(margins: Margins, least_gain: float, least_delay_s: float) -> Iterator[Row]:
    group = f"loop, {margins.cut}"
    too_strong = (
        "any" if margins.gain_up == inf else _at(f"{margins.gain_up:.2f}", margins.gain_up_hz)
    )
    too_weak = (
        "0" if margins.gain_down == 0.0 else _at(f"{margins.gain_down:.2f}", margins.gain_down_hz)
    )
    yield Row(
        group,
        "gain margin",
        f"factor {too_weak} to {too_strong}",
        f"{1 / least_gain:.2f} to {least_gain:.2f}",
        grade(fail=False, warn=margins.gain_up < least_gain or margins.gain_down > 1 / least_gain),
    )
    yield Row(
        group,
        "phase margin",
        _at(f"{degrees(margins.phase_rad):.1f}°", margins.phase_hz),
        f"{degrees(LEAST_PHASE_RAD):.0f}°",
        grade(fail=False, warn=margins.phase_rad < LEAST_PHASE_RAD),
    )
    yield Row(
        group,
        "delay margin",
        "any"
        if margins.delay_s == inf
        else _at(f"{margins.delay_s * 1e3:.2f} ms", margins.delay_hz),
        f"{least_delay_s * 1e3:.2f} ms",
        grade(fail=False, warn=margins.delay_s < least_delay_s),
    )
    yield Row(
        group,
        "distance from -1",
        _at(f"{margins.modulus:.2f}", margins.modulus_hz),
        "",
        Verdict.OK,
    )


def _at(value: str, frequency_hz: float) -> str:
    return value if frequency_hz != frequency_hz else f"{value} ({frequency_hz:.1f} Hz)"
