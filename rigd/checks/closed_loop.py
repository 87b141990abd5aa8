"""Checks of the closed loop on paper: its stability and its margins.

The required value depends on what a margin protects against (see :mod:`rigd.control._margins`). The
gain margin at the angle must be a factor of 2, the rule of thumb for a feedback loop. At torque
command and torque reading, where the cancelled beam makes a factor of 2 impossible, the gain margin
must be 20 %: twice the tolerance of a drive's torque constant or of a calibration. The phase margin
must be 20°: the largest rotation of the open loop's gain by an error of 20 % (11.5°), plus one
period of delay at the second mode (16 Hz: 5.8°), rounded up. The delay margin must be one period,
for a reading or a command that is a tick late. A smaller margin is a warning, not a failure: the
loop is stable with the values of the profile, and a session may be needed to find out whether they
are right.
"""

from collections.abc import Iterator
from math import degrees, inf, log10, radians
from typing import TYPE_CHECKING

from rigd.beam.realisation import RealisationError
from rigd.check_rows import CheckResult, CheckRow, grade
from rigd.control import ControlDesignError, stable_loop
from rigd.plugins import PluginError
from rigd.profile import Profile

# Modules of devices that a rig does not have are not loaded: these checks precede every session.
if TYPE_CHECKING:
    from rigd.control import Margins

MIN_TORQUE_GAIN_FACTOR = 1.2
"""Smallest gain margin at torque command and torque reading, as a factor up and down."""
MIN_ANGLE_GAIN_FACTOR = 2.0
"""Smallest gain margin at the angle reading, as a factor up and down."""
MIN_PHASE_MARGIN_RAD = radians(20.0)
"""Smallest phase margin in rad without a warning."""
MIN_DELAY_MARGIN_PERIODS = 1.0
"""Smallest delay margin without a warning, in periods of the loop."""


STABILITY_ROW = "loop_stability"
"""Name of the row on the loop's stability."""


def stability_rows(profile: Profile) -> Iterator[CheckRow]:
    """Yield the check result on whether the closed loop of a profile's rig is stable."""
    try:
        if not profile.is_loop_modelled:
            yield CheckRow(
                "loop",
                "stability",
                f'not checked: controller "{profile.control.controller}" states no matrices',
                "stable",
                CheckResult.WARNING,
                "Loop: neither stability nor margins are known, and sessions are predicted with "
                "the PID of [control]. Start with a small amplitude.",
                STABILITY_ROW,
            )
            return
        closed_loop, warning_text = stable_loop(profile.loop_model())
    except (ControlDesignError, RealisationError, PluginError) as error:
        yield CheckRow(
            "loop", "stability", str(error), "stable", CheckResult.FAIL, name=STABILITY_ROW
        )
        return
    found_text = f"closed loop stable, slowest pole {closed_loop.growth_per_s:.2g} 1/s"
    yield CheckRow(
        "loop",
        "stability",
        warning_text or found_text,
        "stable",
        grade(fail=False, warn=warning_text is not None),
        name=STABILITY_ROW,
    )


def margin_rows(profile: Profile) -> Iterator[CheckRow]:
    """Yield results on the stability margins of the closed loop; skipped if it is unstable."""
    from rigd.control import loop_margins

    skip_reason = ""
    try:
        if profile.is_loop_modelled:
            closed_loop, warning_text = stable_loop(profile.loop_model())
            if warning_text is not None:
                skip_reason = "the loop is not stable"
        else:
            skip_reason = "the controller states no matrices"
    except (ControlDesignError, RealisationError, PluginError):
        skip_reason = "the loop is not stable"
    if skip_reason:
        yield CheckRow("loop", "margins", skip_reason, "", CheckResult.SKIPPED)
        return
    period_s = 1.0 / profile.rig.rate_hz
    for opening_margins in loop_margins(closed_loop):
        min_gain_factor = (
            MIN_ANGLE_GAIN_FACTOR
            if opening_margins.opening == "angle reading"
            else MIN_TORQUE_GAIN_FACTOR
        )
        yield from _margin_rows(
            opening_margins, min_gain_factor, MIN_DELAY_MARGIN_PERIODS * period_s
        )


def _margin_rows(
    margins: "Margins", min_gain_factor: float, min_delay_s: float
) -> Iterator[CheckRow]:
    """Yield check results on the stability margins at one signal of the loop."""
    row_group = f"loop, {margins.opening}"
    gain_up_text = (
        "any"
        if margins.gain_up == inf
        else _with_frequency(_decibels(margins.gain_up), margins.gain_up_hz)
    )
    gain_down_text = (
        "any"
        if margins.gain_down == 0.0
        else _with_frequency(_decibels(margins.gain_down), margins.gain_down_hz)
    )
    yield CheckRow(
        row_group,
        "gain margin",
        f"{gain_down_text} / {gain_up_text}",
        f"{_decibels(1 / min_gain_factor)} / {_decibels(min_gain_factor)}",
        grade(
            fail=False,
            warn=margins.gain_up < min_gain_factor or margins.gain_down > 1 / min_gain_factor,
        ),
    )
    yield CheckRow(
        row_group,
        "phase margin",
        _with_frequency(f"{degrees(margins.phase_rad):.1f}°", margins.phase_hz),
        f"{degrees(MIN_PHASE_MARGIN_RAD):.0f}°",
        grade(fail=False, warn=margins.phase_rad < MIN_PHASE_MARGIN_RAD),
    )
    yield CheckRow(
        row_group,
        "delay margin",
        "any"
        if margins.delay_s == inf
        else _with_frequency(f"{margins.delay_s * 1e3:.2f} ms", margins.delay_hz),
        f"{min_delay_s * 1e3:.2f} ms",
        grade(fail=False, warn=margins.delay_s < min_delay_s),
    )
    yield CheckRow(
        row_group,
        "modulus margin",
        _with_frequency(f"{margins.modulus:.2f}", margins.modulus_hz),
        "",
        CheckResult.OK,
    )


def _decibels(gain: float) -> str:
    """Format a gain factor of the loop in decibels with its sign."""
    return f"{20 * log10(gain):+.1f} dB"


def _with_frequency(value_text: str, frequency_hz: float) -> str:
    """Append a frequency in Hz in brackets to a value's text, unless the frequency is NaN."""
    return value_text if frequency_hz != frequency_hz else f"{value_text} ({frequency_hz:.1f} Hz)"
