"""Data of a profile that a probing move needs; quick to import for the supervisor's sake."""

from rigd.profile import Profile
from rigd.safety.probing_move import ProbedRig


def probed_rig(profile: Profile) -> ProbedRig:
    """Return the data of a profile that a probing move needs: beam, motor, delays and limits.

    Parameters
    ----------
    profile
        Profile of the rig.
    """
    rig = profile.rig
    return ProbedRig(
        rate_hz=rig.rate_hz,
        beam=rig.beam,
        damping=rig.damping,
        tool_inertia_kg_m2=rig.sensor.tool_inertia_kg_m2,
        inertia_kg_m2=rig.motor.inertia_kg_m2,
        rated_torque_nm=rig.motor.rated_torque_nm,
        peak_torque_nm=rig.motor.peak_torque_nm,
        resolution_rad=rig.encoder.resolution_rad,
        command_delay_s=rig.actuation.delay_s + rig.encoder.delay_s,
        angle_limit_rad=profile.limits.angle_rad,
        velocity_limit_rad_s=profile.limits.velocity_rad_s,
    )
