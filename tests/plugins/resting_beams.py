"""A beam at rest that leans on an obstacle, as statics has it."""

from math import inf


def pressing_force_n(beam, obstacle_at_m, angle_rad, stiffness_n_per_m=inf):
    """Force on an obstacle that is first touched at the angle 0; at rest it does not pull."""
    compliance_m_per_n = obstacle_at_m**3 / (3 * beam.bending_stiffness_n_m2)
    return max(0.0, obstacle_at_m * angle_rad / (compliance_m_per_n + 1 / stiffness_n_per_m))
