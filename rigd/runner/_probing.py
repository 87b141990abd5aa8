"""Probing move before the first session, which verifies the scales of motor and sensors.

The result is stored in the user's runtime folder. It is valid until the computer is restarted, as
long as verified values, drive, sensor and, if the rig is simulated, the simulation do not change.
"""

import contextlib
import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

from rigd.devices import ActuationTarget, describe_actuation_target, is_simulated_here
from rigd.devices.running_simulator import find_simulator, parameters_by_dotted_key
from rigd.engine import probed_rig
from rigd.errors import FailureError
from rigd.profile import Profile
from rigd.runner._process_group import ProcessGroup
from rigd.runner._rig import Rig
from rigd.runner.request import load_rig
from rigd.runtime import StopRequest
from rigd.runtime.addresses import runtime_folder
from rigd.runtime.locks import RigLock
from rigd.safety.probe_estimate import ProbeEstimate, contradiction, doubts
from rigd.safety.probing_move import PROBED_KEYS, ProbeEnd, plan_probe

_VERIFIED_KEY_PREFIXES: Final = (
    "rate_hz", "beam.", "damping.", "motor.", "encoder.", "actuation.", "sensor.projection",
    "sensor.tool_inertia_kg_m2", "sensor.delay_s", "cia402.direction", "cia402.gear_ratio",
)  # fmt: skip
"""Prefixes of the profile keys whose values a probing move verifies."""


class ProbeFailedError(FailureError):
    """Raised if a probing move shows that the rig contradicts its profile; it states how."""


@dataclass(frozen=True, slots=True)
class ProbeResult:
    """Result of a probing move."""

    end: ProbeEnd
    """Reason for which the move ended."""
    estimate: ProbeEstimate
    """Estimated friction, and ratios of measured to expected values."""

    def contradiction_text(self, profile: Profile, *, checks_motor: bool = True) -> str:
        """Return text that states how the result contradicts the profile, or "" if it does not.

        If `checks_motor` is False, torque and inertia of the motor are not compared.
        """
        return contradiction(probed_rig(profile), self.end, self.estimate, with_motor=checks_motor)

    def as_metadata(self) -> dict[str, str]:
        """Return the probing move's result as metadata of a session file."""
        estimate_values = self.estimate.as_dict()
        return {
            f"probe_{key}": repr(estimate_values[key])
            for key in estimate_values
            if estimate_values[key] is not None
        }

    def text_lines(self, profile: Profile) -> list[str]:
        """Return lines of text that report the probing move's result to the operator."""
        estimate = self.estimate
        ratio_rows = (
            ("coupling torque over the beam's at the measured angle", estimate.coupling_ratio,
             estimate.coupling_std),
            ("torque of the motor over the torque commanded", estimate.torque_ratio,
             estimate.torque_std),
            ("inertia of the motor over motor.inertia_kg_m2", estimate.inertia_ratio,
             estimate.inertia_std),
        )  # fmt: skip
        report_lines = [
            f"{ratio_title}: not known"
            if measured_ratio is None
            else f"{ratio_title}: {measured_ratio:.2f} ± {std:.2f}"
            for ratio_title, measured_ratio, std in ratio_rows
        ]
        if estimate.coulomb_nm is not None:
            stated_friction_nm = profile.rig.motor.coulomb_nm
            report_lines.append(
                f"Coulomb friction: {estimate.coulomb_nm:.3f} N·m (motor.coulomb_nm: "
                f"{stated_friction_nm:g})"
            )
        travel_text = f"{estimate.travel_rad:.2g} rad, {estimate.speed_rad_s:.2g} rad/s"
        return [*report_lines, f"travel and speed, as measured: {travel_text}"]


def verify_by_probing(
    profile: Profile,
    rig: Rig,
    stop: StopRequest,
    report: Callable[[Literal["info", "warning"], str], None],
    *,
    checks_motor: bool = True,
) -> ProbeResult | None:
    """Make a probing move if it is needed, and return its result, or None if it is not.

    It is needed unless the profile states that motor and encoder were measured. A valid stored
    result is used instead of a new move. Raises ProbeFailedError if the result contradicts the
    profile. If `checks_motor` is False, torque and inertia of the motor are not compared.
    """
    if _are_scales_measured(profile) or _is_simulated_with_profile(profile):
        return None
    probe_result = read_stored_result(profile, rig)
    if probe_result is None or probe_result.contradiction_text(profile, checks_motor=checks_motor):
        report("info", probing_announcement(profile))
        probe_result = run_probing_move(profile, rig, stop)
        contradiction_text = probe_result.contradiction_text(profile, checks_motor=checks_motor)
        if contradiction_text:
            raise ProbeFailedError(contradiction_text)
        report("info", f"Probing move passed: {'; '.join(probe_result.text_lines(profile))}.")
    for warning_text in doubts(probe_result.estimate):
        report("warning", warning_text)
    return probe_result


def _are_scales_measured(profile: Profile) -> bool:
    """Return whether a profile states that motor and encoder were measured."""
    return all(profile.sources.get(key) == "measured" for key in PROBED_KEYS)


def _is_simulated_with_profile(profile: Profile) -> bool:
    """Return whether the rig is simulated with the values that probing would verify."""
    if is_simulated_here(profile.rig):
        return True
    simulator = find_simulator(profile.rig.name)
    if simulator is None:
        return False
    profile_values = _verified_values(parameters_by_dotted_key(profile.rig))
    return all(
        simulator.rig.get(key) == profile_value for key, profile_value in profile_values.items()
    )


def probing_announcement(profile: Profile) -> str:
    """Return a sentence for the operator that announces the motion of a probing move."""
    probe_plan = plan_probe(probed_rig(profile))
    return (
        "Probing move, which verifies the scales of motor, encoder and sensor: strokes of up to "
        f"{probe_plan.travel_rad:.2g} rad to one side and back at {probe_plan.speed_rad_s:.2g} and "
        f"{probe_plan.fast_speed_rad_s:.2g} rad/s, at most {probe_plan.torque_limit_nm:.2g} N·m."
    )


def run_probing_move(profile: Profile, rig: Rig, stop: StopRequest) -> ProbeResult:
    """Make a probing move on a connected rig, and store its result."""
    probe_result = _result_of_document(rig.probe(profile, stop))
    result_document = {
        "key": _validity_key(profile, rig),
        "boot": _boot_id(),
        "end": probe_result.end.name,
    }
    result_path = _result_path(profile)
    with contextlib.suppress(OSError):
        result_path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        temporary_path = result_path.with_suffix(".new")
        temporary_path.write_text(
            json.dumps(result_document | probe_result.estimate.as_dict()), encoding="utf-8"
        )
        temporary_path.replace(result_path)
    return probe_result


def probe_in_foreground(
    group: ProcessGroup,
    stop: StopRequest,
    *,
    profile_name: str,
    uses_virtual_clock: bool,
    force_hardware: bool,
    report_line: Callable[[str], None],
) -> tuple[Profile, ProbeResult]:
    """Make a probing move for `rigd probe`, even if the profile needs no verification.

    Parameters
    ----------
    group
        Started processes of the rig. They are ended when this function returns.
    stop
        Stop request of the operator.
    profile_name
        Name or path of the profile.
    uses_virtual_clock, force_hardware
        Options of the command line.
    report_line
        Function that gets messages for the operator before the move begins.

    Returns
    -------
    profile, result
        The profile, and the result of the move.

    Raises
    ------
    UserError
        If the move is refused.
    RigError
        If the rig cannot be connected, or the move is stopped or ended by an interlock.
    """
    with contextlib.ExitStack() as locks, group:
        profile, actuation_target = load_rig(
            profile_name, uses_virtual_clock=uses_virtual_clock, force_hardware=force_hardware
        )
        report_line(describe_actuation_target(profile.rig, actuation_target))
        is_exclusive = not (uses_virtual_clock and actuation_target is ActuationTarget.SIMULATED)
        is_hardware = actuation_target is ActuationTarget.HARDWARE
        locks.enter_context(
            RigLock(profile.name, "rigd probe", hardware=is_hardware, exclusive=is_exclusive)
        )
        rig = Rig(profile, uses_virtual_clock=uses_virtual_clock, group=group)
        rig.connect(actuation_target)
        report_line(probing_announcement(profile))
        return profile, run_probing_move(profile, rig, stop)


def read_stored_result(profile: Profile, rig: Rig) -> ProbeResult | None:
    """Return the stored result of the last probing move, or None if there is no valid one."""
    try:
        stored_document = json.loads(_result_path(profile).read_text("utf-8"))
        if (
            stored_document.pop("key") != _validity_key(profile, rig)
            or stored_document.pop("boot") != _boot_id()
        ):
            return None
        return _result_of_document(stored_document)
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None


def _result_of_document(document: Mapping[str, Any]) -> ProbeResult:
    """Return the result of a probing move from the document that states it."""
    estimate_fields = {key: field_value for key, field_value in document.items() if key != "end"}
    return ProbeResult(ProbeEnd[document["end"]], ProbeEstimate(**estimate_fields))


def _verified_values(profile_values: Mapping[str, object]) -> dict[str, object]:
    """Return the values of a profile that a probing move verifies."""
    return {
        key: profile_value
        for key, profile_value in profile_values.items()
        if key.startswith(_VERIFIED_KEY_PREFIXES)
    }


def _validity_key(profile: Profile, rig: Rig) -> str:
    """Return a hash that changes when the stored result of a probing move becomes invalid.

    It depends on the verified values, the limits of angle and speed, the drive, the sensor, and the
    process of a simulated rig.
    """
    simulator = find_simulator(profile.rig.name)
    limits = profile.limits
    hashed_values = (
        _verified_values(parameters_by_dotted_key(profile.rig)),
        (limits.angle_rad, limits.velocity_rad_s),
        dict(rig.drive_statement),
        dict(rig.calibration or {}),
        None if simulator is None else simulator.pid,
    )
    return hashlib.sha256(
        json.dumps(hashed_values, sort_keys=True, default=str).encode()
    ).hexdigest()


def _boot_id() -> str:
    """Return an identifier that changes when the computer is restarted, or "" if unavailable."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text("utf-8").strip()
    except OSError:
        return ""


def _result_path(profile: Profile) -> Path:
    """Return the path of the file with the stored result for a profile."""
    file_name_part = "".join(c if c.isalnum() else "-" for c in profile.name).strip("-")
    return runtime_folder() / f"probed-{file_name_part}.json"
