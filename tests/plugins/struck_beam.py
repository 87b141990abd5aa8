"""Obstacles that tests of `rigd.touch` let the antenna strike, and how their records are cut."""

from touch_records import Obstacle

from rigd.touch import TouchRecord

NOTICED = 5
"""Samples from the touch to its detection."""
HISTORY = 400

OBSTACLES = {
    "soft": Obstacle(x_m=0.35, stiffness_n_per_m=300),
    "middle": Obstacle(x_m=0.62, stiffness_n_per_m=3000),
    "hard": Obstacle(x_m=0.5, stiffness_n_per_m=30000),
    "fleeing": Obstacle(x_m=0.6, angle_rad=0.25, rate_rad_s=0.5),
    "knock": Obstacle(x_m=0.5, knock_n=2.0, knock_s=0.008),
}


def cut(struck, after, *, shear=True, noticed=NOTICED):
    """Return the record around a touch, `after` samples from its detection."""
    detected = int(struck.touch_s * 1000) + noticed
    part = slice(detected - HISTORY, detected + after)
    return TouchRecord(
        1000.0,
        struck.angle_rad[part],
        struck.torque_nm[part],
        struck.shear_n[part] if shear else None,
        HISTORY,
    )


def begin_s(struck, noticed=NOTICED):
    """Time of the first sample of what `cut` returns."""
    return (int(struck.touch_s * 1000) + noticed - HISTORY) / 1000
