"""The watch over a profile's limits."""

from rigd.profile import Profile
from rigd.safety import LimitWatch


def make_watch(profile: Profile) -> LimitWatch:
    """Return the watch for the rig of a profile; it stays for as long as the rig is connected.

    The motor is taken to be cold.
    """
    rig = profile.rig
    return LimitWatch(
        profile.limits,
        rig.sensor.range,
        rig.rate_hz,
        resolution_rad=rig.encoder.resolution_rad,
        peak_torque_nm=rig.motor.peak_torque_nm,
        continuous_torque_nm=rig.motor.continuous_torque_nm,
        thermal_time_constant_s=rig.motor.thermal_time_constant_s,
        tare_warning_nm=profile.session.tare_drift_nm,
    )
