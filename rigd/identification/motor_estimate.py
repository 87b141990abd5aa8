"""Inertia, friction, torque scale and delay of a motor from windows of its motion.

The equation they are fitted to stands in :mod:`rigd.identification.motor_moments`, the fit in
:mod:`rigd.identification.motor_fit`. Windows of one key are repeats of the same motion.
"""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np

from rigd.identification.motor_fit import fit
from rigd.identification.motor_moments import (
    COULOMB,
    DELAY,
    INERTIA,
    SCALE,
    VISCOUS,
    Real,
    Stack,
    Timing,
)

LEAST_REPEATS = 4
"""Fewer tell too little of the scatter."""

_LEAST_SPEED_PART = 0.1
"""Of the nominal speed: below, a window may contain a standstill."""
_SPEED_S = 0.01
"""Half the time over which that speed is taken."""
_MAX_SCALE_STD = 0.05
"""What a torque constant from a datasheet is good for."""
_SCALES = (0.5, 2.0)
"""Without a beam the equation is solved by no torque and no motor too: a scale beyond these is no
torque constant."""


class EstimateError(ValueError):
    """The windows do not tell the motor's data; the message says why."""


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """Readings during one pass at constant nominal speed, each of shape (n,)."""

    angle_rad: Real
    torque_command_nm: Real
    coupling_torque_nm: Real
    speed_rad_s: float
    """Nominal, signed."""
    top_hz: float
    """Up to where there is something to see."""
    session: int
    """Each session has its own zero of the torque."""
    key: Hashable
    """Repeats of the same motion have equal keys."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """An estimate and its standard deviation; None: it was not estimated."""

    value: float
    std: float | None


@dataclass(frozen=True, slots=True)
class MotorEstimate:
    """What the windows tell of the motor, at its output shaft."""

    inertia_kg_m2: Quantity
    viscous_nm_s_per_rad: Quantity
    coulomb_nm: Quantity
    torque_scale: Quantity
    """True torque over commanded torque; without a standard deviation it is held at 1, and the
    other quantities count in the drive's own torque."""
    actuation_delay_s: Quantity
    windows: int
    dropped: int
    """Windows in which the shaft may have stood still."""
    misfit: float
    """Mean square of what the equation leaves, over what scatter explains: 1 if it holds."""
    friction_departure_nm: float
    """Largest departure of a pass's mean torque from viscous and Coulomb friction."""


def estimate_motor(
    windows: Sequence[Window], timing: Timing, *, tool_inertia_kg_m2: float = 0.0
) -> MotorEstimate:
    """Fit the motor's equation to windows in which its speed keeps its sign.

    Parameters
    ----------
    windows
        Of equal length; at least `LEAST_REPEATS` of each key, and both directions.
    timing
        Of the readings. Only the delay from command to angle shows in them: that of the angle is
        taken off it.
    tool_inertia_kg_m2
        Between sensor and beam: it makes the coupling torque jump with each command, and where
        within a period the sensor sees that is not known; the delay's deviation allows for it.

    Returns
    -------
    MotorEstimate
        Standard deviations hold the scatter between repeats, widened for their finite number so
        that three of them cover 99.7 %, for what the equation does not explain, and by a margin.

    Raises
    ------
    EstimateError
        If there are too few windows, or the fit does not settle.
    """
    moving = [window for window in windows if _keeps_moving(window, timing.rate_hz)]
    stacks = _stack(moving, len(windows))
    found = fit(stacks, timing, hold_scale=False)
    scale_known = (
        found is not None
        and found.stds[SCALE] < _MAX_SCALE_STD
        and _SCALES[0] < found.values[SCALE] < _SCALES[1]
    )
    if not scale_known:
        found = fit(stacks, timing, hold_scale=True)
    if found is None:
        raise EstimateError(
            "The motor's data cannot be told from the record: the fit does not settle. Look at "
            "actuation.delay_s of the profile, from which the search begins, and at the record."
        )
    values, stds = found.values, found.stds
    inertia = float(values[INERTIA])
    if inertia <= 0.0:
        raise EstimateError(
            f"The fit ends at an inertia of {inertia:.3g} kg·m²: the record does not show the "
            "motor's own motion. Look at sensor.projection, encoder.delay_s and sensor.delay_s."
        )
    jump = tool_inertia_kg_m2 / (inertia + tool_inertia_kg_m2)
    sampled_s = jump / timing.rate_hz / sqrt(12.0)
    return MotorEstimate(
        inertia_kg_m2=Quantity(inertia, float(stds[INERTIA])),
        viscous_nm_s_per_rad=Quantity(float(values[VISCOUS]), float(stds[VISCOUS])),
        coulomb_nm=Quantity(float(values[COULOMB]), float(stds[COULOMB])),
        torque_scale=Quantity(float(values[SCALE]), float(stds[SCALE]) if scale_known else None),
        actuation_delay_s=Quantity(
            float(values[DELAY]) - timing.angle_delay_s,
            sqrt(float(stds[DELAY]) ** 2 + sampled_s**2),
        ),
        windows=len(moving),
        dropped=len(windows) - len(moving),
        misfit=found.misfit,
        friction_departure_nm=found.friction_departure_nm,
    )


def _keeps_moving(window: Window, rate_hz: float) -> bool:
    half = max(1, round(_SPEED_S * rate_hz))
    angle = window.angle_rad
    speed = (angle[2 * half :] - angle[: -2 * half]) * rate_hz / (2 * half)
    along = speed * np.sign(window.speed_rad_s)
    return bool(np.min(along) > _LEAST_SPEED_PART * abs(window.speed_rad_s))


def _stack(windows: Sequence[Window], given: int) -> list[Stack]:
    groups: dict[Hashable, list[Window]] = {}
    for window in windows:
        groups.setdefault(window.key, []).append(window)
    full = [group for group in groups.values() if len(group) >= LEAST_REPEATS]
    if {np.sign(group[0].speed_rad_s) for group in full} != {1.0, -1.0}:
        raise EstimateError(
            f"Of {given} passes {len(windows)} can be used, and that is too few: it takes at least "
            f"{LEAST_REPEATS} of the same kind in both directions, without gaps and without a "
            "standstill."
        )
    sessions = {number: place for place, number in enumerate(sorted({g[0].session for g in full}))}
    return [
        Stack(
            np.array([window.angle_rad for window in group]),
            np.array([window.torque_command_nm for window in group]),
            np.array([window.coupling_torque_nm for window in group]),
            float(np.sign(group[0].speed_rad_s)),
            group[0].top_hz,
            sessions[group[0].session],
        )
        for group in full
    ]
