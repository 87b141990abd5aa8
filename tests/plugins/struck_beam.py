"""Obstacles that tests of `rigd.touch` let the antenna strike, and how their records are cut."""

from touch_records import Obstacle, Slew

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

MISTAKEN = {
    "gives way": (Obstacle(0.863, 0.3956, 1280.0, mobility_m_per_n_s=0.27), Slew(0.79, 30.0)),
    "gives way slowly": (Obstacle(0.697, 0.354, 7500.0, mobility_m_per_n_s=0.12), Slew(0.71, 30.0)),
    "flees": (Obstacle(0.278, 0.178, 5000.0, rate_rad_s=0.356), Slew(0.71, 30.0)),
    "two": ((Obstacle(0.492, 0.296, 1870.0), Obstacle(0.207, 0.324, 1880.0)), Slew(0.65, 30.0)),
    "two at once": (
        (Obstacle(0.208, 0.33, 350.0), Obstacle(0.577, 0.33, 1500.0)),
        Slew(0.7, 30.0),
    ),
}
"""Obstacles that could be taken for one at rest, or elsewhere, and how the antenna comes to them;
of two, the first is met first."""

ALIKE = {
    "two alike": (
        (Obstacle(0.062, 0.441, 466.0), Obstacle(0.195, 0.4345, 540.0)),
        Slew(0.87, 30.0),
    ),
    "one alike": (Obstacle(0.11, 0.44, 580.0), Slew(0.87, 30.0)),
}
"""Two soft obstacles near the axis, met 6 ms after each other at 0.87 rad/s, and what they are
like."""


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
    """Time of the first sample that `cut` returns."""
    return (int(struck.touch_s * 1000) + noticed - HISTORY) / 1000
