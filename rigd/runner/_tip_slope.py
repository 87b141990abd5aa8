"""Slope of the antenna's tip: its limit in sessions that identify the antenna, and text in plans.

The exact beam model (`rigd.beam`) is valid for small slopes only. The profile limits the slope by
`limits.tip_slope_rad`, and a session by `--tip-slope`.
"""

import math
from dataclasses import asdict, replace
from typing import Any, Final

from rigd.beam import Beam
from rigd.beam.tip import SMALL_TIP_SLOPE_RAD, TipMotion, linear_model_error
from rigd.errors import UserError
from rigd.excitation import KINDS, Excitation
from rigd.profile import Profile

PAPER_AMPLITUDE_RAD: Final = 0.025
"""Amplitude in rad of the reference paper's chirp, up to which chirps are exempt from the limit."""

KINDS_WITH_TARGET_ANGLE: Final = ("move", "touch")
"""Kinds of excitation with a target angle, which do not identify the antenna and have no amplitude.
"""

_STEEP_SLOPE_EFFECTS: Final = {
    "move": ", so that more vibration may be left than predicted",
    "touch": ", so that position and force of a touch are less accurate",
}


class TipSlopeError(UserError):
    """Raised if the operator states an invalid limit of the tip slope."""


def with_tip_slope(profile: Profile, tip_slope_rad: float | None) -> Profile:
    """Return a copy of a profile with another limit of the tip slope.

    Parameters
    ----------
    profile
        Profile of the rig.
    tip_slope_rad
        Limit that the operator states, or None to retain the limit of the profile.

    Raises
    ------
    TipSlopeError
        If the limit is not a finite number above 0.
    """
    if tip_slope_rad is None:
        return profile
    if not 0.0 < tip_slope_rad < math.inf:
        raise TipSlopeError(
            f"--tip-slope {tip_slope_rad:g}: tip_slope_rad must be a finite number above 0 rad."
        )
    return replace(profile, limits=replace(profile.limits, tip_slope_rad=tip_slope_rad))


def has_slope_limit(excitation: Excitation) -> bool:
    """Return whether the limit of the tip slope applies to an excitation.

    The limit applies to excitations that identify the antenna, except chirps of small amplitude.
    """
    if excitation.kind == "chirp":
        return not is_exempt_chirp(excitation)
    # Sessions that identify the motor have other kinds, since they do not depend on a beam model.
    return excitation.kind in KINDS and excitation.kind not in KINDS_WITH_TARGET_ANGLE


def is_exempt_chirp(excitation: Excitation) -> bool:
    """Return whether the excitation is a chirp of at most the reference paper's amplitude."""
    return (
        excitation.kind == "chirp"
        and abs(float(excitation.parameters["amplitude_rad"])) <= PAPER_AMPLITUDE_RAD
    )


def is_tip_motion_physical(predicted_tip_motion: TipMotion, beam: Beam) -> bool:
    """Return whether a predicted tip motion is physically possible.

    The motion is possible if the deflection is at most the beam's length, and the error of the
    linear model is below 100 %.
    """
    return (
        predicted_tip_motion.deflection_m <= beam.length_m
        and linear_model_error(predicted_tip_motion.slope_rad) < 1.0
    )


def tip_document(predicted_tip_motion: TipMotion | None, beam: Beam) -> dict[str, Any] | None:
    """Return the predicted motion of the tip as a dictionary for JSON, or None if unknown."""
    if predicted_tip_motion is None:
        return None
    return {
        **asdict(predicted_tip_motion),
        "linear_model_error": linear_model_error(predicted_tip_motion.slope_rad),
        "physical": is_tip_motion_physical(predicted_tip_motion, beam),
    }


def slope_remedy(excitation: Excitation, slope_rad: float, limit_rad: float) -> str:
    """Return text on how to change or allow a session that exceeds the limit of the tip slope."""
    amplitude_text = ""
    if excitation.kind == "file":
        amplitude_factor = _rounded_down(limit_rad / slope_rad)
        amplitude_text = f" to {amplitude_factor:g} of it" if amplitude_factor > 0 else ""
    exemption_text = (
        f" (chirps of up to {PAPER_AMPLITUDE_RAD:g} rad, as in the reference paper, are exempt)"
        if excitation.kind == "chirp"
        else ""
    )
    suggested_limit_rad = math.ceil(100 * slope_rad) / 100
    return (
        f"{amplitude_text}{exemption_text}, or allow it with --tip-slope "
        f"{suggested_limit_rad:g} (rad)"
    )


def tip_in_words(predicted_tip_motion: TipMotion | None, beam: Beam, excitation: Excitation) -> str:
    """Return text on the predicted tip motion and the linear model's error; "" if unknown."""
    if predicted_tip_motion is None:
        return ""
    relative_model_error = linear_model_error(predicted_tip_motion.slope_rad)
    if not is_tip_motion_physical(predicted_tip_motion, beam):
        error_percent_text = (
            f"up to {100 * relative_model_error:.2g}" if relative_model_error < 1.0 else "above 100"
        )
        motion_text = (
            f"Predicted tip slope: {predicted_tip_motion.slope_rad:.2g} rad. The linear model does "
            f"not hold there (error {error_percent_text} %): the predicted deflection is larger "
            "than the beam allows, and deflection and speed of the tip are not known"
        )
    else:
        deflection_fraction = predicted_tip_motion.deflection_m / beam.length_m
        motion_text = (
            f"Predicted tip deflection: {predicted_tip_motion.deflection_m:.3g} m "
            f"({100 * deflection_fraction:.2g} % of "
            f"the length), tip speed {predicted_tip_motion.speed_m_s:.3g} m/s, slope "
            f"{predicted_tip_motion.slope_rad:.2g} rad."
        )
        if not predicted_tip_motion.slope_rad > SMALL_TIP_SLOPE_RAD:
            return motion_text
        motion_text += (
            f" At slopes above {SMALL_TIP_SLOPE_RAD:g} rad the linear model is not exact (error at "
            f"most {100 * relative_model_error:.2g} %), and air drag may limit the motion"
        )
    if excitation.kind in KINDS_WITH_TARGET_ANGLE:
        return f"{motion_text}{_STEEP_SLOPE_EFFECTS[excitation.kind]}."
    if excitation.kind not in KINDS:
        return f"{motion_text}; the identification of the motor does not depend on it."
    amplitude_factor = _rounded_down(SMALL_TIP_SLOPE_RAD / predicted_tip_motion.slope_rad)
    amplitude_advice = (
        f"; {amplitude_factor:g} times the amplitude stays within" if amplitude_factor > 0 else ""
    )
    exemption_text = (
        f" A chirp of up to {PAPER_AMPLITUDE_RAD:g} rad, as in the reference paper, is not refused "
        "for it."
        if is_exempt_chirp(excitation)
        else ""
    )
    return f"{motion_text}{amplitude_advice}.{exemption_text}"


def _rounded_down(amplitude_factor: float) -> float:
    """Return a factor rounded down to two decimals."""
    return math.floor(100.0 * amplitude_factor) / 100.0
