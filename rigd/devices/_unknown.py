"""Values that a profile declares as unknown, and how the operator can find them.

A profile writes such a value as ``{ source = "unknown" }``; the parameter is then NaN. Nothing
may be computed from it, and no device is opened with it.
"""

from math import isnan
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from rigd.devices.parameters import RigParameters

MAY_BE_UNKNOWN: Final = {
    "motor.inertia_kg_m2": (
        "data sheets: inertia of the rotor times the square of the gear ratio, plus that of the "
        "gear at its output; rigd identify motor measures it afterwards"
    ),
    "motor.viscous_nm_s_per_rad": (
        "data sheet of the gear: slope of its running torque over the speed; rigd identify motor "
        "measures it afterwards"
    ),
    "motor.coulomb_nm": (
        "data sheet of the gear: no-load running torque; rigd identify motor measures it afterwards"
    ),
    "motor.rated_torque_nm": (
        "data sheet of the motor: rated torque (torque constant times rated current, object 6076 "
        "of the drive), times the gear ratio"
    ),
    "motor.peak_torque_nm": (
        "data sheets: peak torque of the motor times the gear ratio, or that of the gear if it is "
        "less"
    ),
    "motor.continuous_torque_nm": (
        "data sheet of the motor: continuous torque rating, times the gear ratio"
    ),
    "motor.thermal_time_constant_s": "data sheet of the motor: time constant of its winding",
    "encoder.resolution_rad": (
        "data sheet of the encoder: 2 pi over its counts per turn (times the gear ratio if it is "
        "on the motor's shaft)"
    ),
    "cia402.gear_ratio": "name plate or data sheet of the gear",
    "cia402.rated_torque_unit_nm": (
        "manual of the drive, object 6076: one count in N·m (mN·m: 1e-3, µN·m: 1e-6)"
    ),
}
"""Keys of a profile whose value may be unknown, each with advice where to find the value."""


def unknown_values(rig: "RigParameters") -> tuple[str, ...]:
    """Return the keys of a profile whose values are unknown.

    Parameters
    ----------
    rig
        Parameters of a profile.

    Returns
    -------
    tuple of str
        Keys of `MAY_BE_UNKNOWN`, in its order.
    """

    def is_value_unknown(profile_key: str) -> bool:
        section, _, key_name = profile_key.partition(".")
        section_parameters = getattr(rig, section)
        return section_parameters is not None and isnan(getattr(section_parameters, key_name))

    return tuple(key for key in MAY_BE_UNKNOWN if is_value_unknown(key))


def describe_unknown_values(rig: "RigParameters") -> str:
    """Return one line per unknown value of a profile, with advice where to find the value.

    The text is empty if no value is unknown.

    Parameters
    ----------
    rig
        Parameters of a profile.
    """
    return "\n".join(
        f"{key} is unknown; enter its value in the profile ({MAY_BE_UNKNOWN[key]})."
        for key in unknown_values(rig)
    )
