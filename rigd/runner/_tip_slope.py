"""Slope of the antenna's tip: its limit in identifications, and its description in plans.

The exact model (`rigd.beam`) is valid for small slopes. `limits.tip_slope_rad` of the profile or
`--tip-slope` of the session limits the slope.
"""

import math
from dataclasses import asdict, replace
from typing import Any, Final

from rigd.beam import Beam
from rigd.beam.tip import SMALL_SLOPE_RAD, TipMotion, linear_model_error
from rigd.errors import UserError
from rigd.excitation import KINDS, Excitation
from rigd.profile import Profile

PAPER_AMPLITUDE_RAD: Final = 0.025
"""Amplitude of the reference paper's chirp, up to which chirps are exempt from the limit."""

NOT_IDENTIFYING: Final = ("move", "touch")
"""Excitations with a target angle: they depend on the start angle and have no amplitude."""

_MEANING: Final = {
    "move": ", so that more vibration may be left than predicted",
    "touch": ", so that position and force of a touch are less accurate",
}


class TipSlopeError(UserError):
    """The operator's limit of the tip slope cannot be used."""


def with_tip_slope(profile: Profile, tip_slope_rad: float | None) -> Profile:
    """Return a profile with the operator's limit of the tip's slope.

    Parameters
    ----------
    profile
        Profile of the rig.
    tip_slope_rad
        Limit for one session; None: that of the profile.

    Raises
    ------
    TipSlopeError
        If it is not a finite number above 0.
    """
    if tip_slope_rad is None:
        return profile
    if not 0.0 < tip_slope_rad < math.inf:
        raise TipSlopeError(
            f"--tip-slope {tip_slope_rad:g}: tip_slope_rad must be a finite number above 0 rad."
        )
    return replace(profile, limits=replace(profile.limits, tip_slope_rad=tip_slope_rad))


def is_limited(excitation: Excitation) -> bool:
    """Return whether the slope limit applies: the session identifies the antenna."""
    if excitation.kind == "chirp":
        return not is_exempt(excitation)
    # Sessions that identify the motor have other kinds: they do not depend on a beam model.
    return excitation.kind in KINDS and excitation.kind not in NOT_IDENTIFYING


def is_exempt(excitation: Excitation) -> bool:
    """Return whether the excitation is a chirp of at most the reference paper's amplitude."""
    return (
        excitation.kind == "chirp"
        and abs(float(excitation.parameters["amplitude_rad"])) <= PAPER_AMPLITUDE_RAD
    )


def is_physical(tip: TipMotion, beam: Beam) -> bool:
    """Return whether the motion is possible: deflection up to the length, error below 100 %."""
    return tip.deflection_m <= beam.length_m and linear_model_error(tip.slope_rad) < 1.0


def tip_document(tip: TipMotion | None, beam: Beam) -> dict[str, Any] | None:
    """Return the predicted motion of the tip for JSON."""
    if tip is None:
        return None
    return {
        **asdict(tip),
        "linear_model_error": linear_model_error(tip.slope_rad),
        "physical": is_physical(tip, beam),
    }


def slope_remedy(excitation: Excitation, slope_rad: float, limit_rad: float) -> str:
    """Return how a session beyond the limit can be changed or allowed."""
    lower = ""
    if excitation.kind == "file":
        factor = _rounded_down(limit_rad / slope_rad)
        lower = f" to {factor:g} of it" if factor > 0 else ""
    exempt = (
        f" (chirps of up to {PAPER_AMPLITUDE_RAD:g} rad, as in the reference paper, are exempt)"
        if excitation.kind == "chirp"
        else ""
    )
    allowed_rad = math.ceil(100 * slope_rad) / 100
    return f"{lower}{exempt}, or allow it with --tip-slope {allowed_rad:g} (rad)"


def tip_in_words(tip: TipMotion | None, beam: Beam, excitation: Excitation) -> str:
    """Describe the tip motion and the error of the linear model; empty without a beam."""
    if tip is None:
        return ""
    error = linear_model_error(tip.slope_rad)
    if not is_physical(tip, beam):
        size = f"up to {100 * error:.2g}" if error < 1.0 else "above 100"
        motion = (
            f"Predicted tip slope: {tip.slope_rad:.2g} rad. The linear model does not hold there "
            f"(error {size} %): the predicted deflection is larger than the beam allows, and "
            "deflection and speed of the tip are not known"
        )
    else:
        fraction = tip.deflection_m / beam.length_m
        motion = (
            f"Predicted tip deflection: {tip.deflection_m:.3g} m ({100 * fraction:.2g} % of the "
            f"length), tip speed {tip.speed_m_s:.3g} m/s, slope {tip.slope_rad:.2g} rad."
        )
        if not tip.slope_rad > SMALL_SLOPE_RAD:
            return motion
        motion += (
            f" At slopes above {SMALL_SLOPE_RAD:g} rad the linear model is not exact (error at "
            f"most {100 * error:.2g} %), and air drag may limit the motion"
        )
    if excitation.kind in NOT_IDENTIFYING:
        return f"{motion}{_MEANING[excitation.kind]}."
    if excitation.kind not in KINDS:
        return f"{motion}; the identification of the motor does not rest on it."
    lower = _rounded_down(SMALL_SLOPE_RAD / tip.slope_rad)
    within = f"; {lower:g} times the amplitude stays within" if lower > 0 else ""
    exempt = (
        f" A chirp of up to {PAPER_AMPLITUDE_RAD:g} rad, as in the reference paper, is not refused "
        "for it."
        if is_exempt(excitation)
        else ""
    )
    return f"{motion}{within}.{exempt}"


def _rounded_down(factor: float) -> float:
    """Round a factor down to two decimals."""
    return math.floor(100.0 * factor) / 100.0
