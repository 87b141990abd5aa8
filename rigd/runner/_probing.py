"""Probing move before the first session: decision, execution and stored result.

A result is valid until the computer is restarted, as long as the verified values, the drive, the
sensor and a simulated rig do not change. It is stored in the user's runtime folder.
"""

import contextlib
import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

from rigd.devices import ActuationTarget, describe_actuation_target
from rigd.devices.running_simulator import described, find_simulator
from rigd.engine import probed_rig
from rigd.errors import FailureError
from rigd.profile import Profile
from rigd.runner._process_group import ProcessGroup
from rigd.runner._rig import Rig
from rigd.runner.request import load_rig
from rigd.runtime import RigLock, StopRequest
from rigd.runtime.addresses import runtime_folder
from rigd.safety.probe_estimate import ProbeEstimate, contradiction, doubts
from rigd.safety.probing_move import MEASURED, ProbeEnd, plan_probe

_VERIFIED: Final = (
    "rate_hz", "beam.", "damping.", "motor.", "encoder.", "actuation.", "sensor.projection",
    "sensor.tool_inertia_kg_m2", "sensor.delay_s", "cia402.direction", "cia402.gear_ratio",
)  # fmt: skip
"""Prefixes of the profile keys that a result depends on."""


class ProbeFailedError(FailureError):
    """The rig contradicts its profile; the message states the contradiction."""


@dataclass(frozen=True, slots=True)
class ProbeResult:
    """Result of a probing move."""

    end: ProbeEnd
    """Reason for the end of the move."""
    estimate: ProbeEstimate
    """Estimated scales and friction."""

    def contradiction(self, profile: Profile, *, motor: bool = True) -> str:
        """Return the contradiction to the profile, with or without the motor data; else empty."""
        return contradiction(probed_rig(profile), self.end, self.estimate, motor=motor)

    def as_metadata(self) -> dict[str, str]:
        """Return the result as metadata of a session file."""
        numbers = self.estimate.as_dict()
        return {f"probe_{key}": repr(numbers[key]) for key in numbers if numbers[key] is not None}

    def lines(self, profile: Profile) -> list[str]:
        """Return the result as lines of text."""
        estimate = self.estimate
        rows = (
            ("coupling torque over the beam's at the measured angle", estimate.coupling_ratio,
             estimate.coupling_std),
            ("torque of the motor over the torque commanded", estimate.torque_ratio,
             estimate.torque_std),
            ("inertia of the motor over motor.inertia_kg_m2", estimate.inertia_ratio,
             estimate.inertia_std),
        )  # fmt: skip
        lines = [
            f"{what}: not known" if ratio is None else f"{what}: {ratio:.2f} ± {std:.2f}"
            for what, ratio, std in rows
        ]
        if estimate.coulomb_nm is not None:
            stated = profile.rig.motor.coulomb_nm
            lines.append(
                f"Coulomb friction: {estimate.coulomb_nm:.3f} N·m (motor.coulomb_nm: {stated:g})"
            )
        travel = f"{estimate.travel_rad:.2g} rad, {estimate.speed_rad_s:.2g} rad/s"
        return [*lines, f"travel and speed, as measured: {travel}"]


def verify(
    profile: Profile,
    rig: Rig,
    stop: StopRequest,
    says: Callable[[Literal["info", "warning"], str], None],
    *,
    motor: bool = True,
) -> ProbeResult | None:
    """Make a probing move if it is needed; return its result, or None if none is needed.

    The move is needed if motor and encoder were not measured and no stored result is valid. With
    `motor`, torque and inertia of the motor are checked too.
    """
    if _is_identified(profile) or _is_simulated_alike(profile):
        return None
    result = stored_result(profile, rig)
    if result is None or result.contradiction(profile, motor=motor):
        says("info", announcement(profile))
        result = probe(profile, rig, stop)
        found = result.contradiction(profile, motor=motor)
        if found:
            raise ProbeFailedError(found)
        says("info", f"Probing move passed: {'; '.join(result.lines(profile))}.")
    for warning in doubts(result.estimate):
        says("warning", warning)
    return result


def _is_identified(profile: Profile) -> bool:
    """Whether a profile states that motor and encoder were measured."""
    return all(profile.sources.get(key) == "measured" for key in MEASURED)


def _is_simulated_alike(profile: Profile) -> bool:
    """Whether the rig is simulated with the values of its profile, so that a probe is useless."""
    if profile.rig.devices.drive == "sim":
        return True
    simulator = find_simulator(profile.rig.name)
    if simulator is None:
        return False
    ours = _verified(described(profile.rig))
    return all(simulator.rig.get(key) == value for key, value in ours.items())


def announcement(profile: Profile) -> str:
    """Return a sentence that announces the motion of the shaft."""
    plan = plan_probe(probed_rig(profile))
    return (
        "Probing move, which verifies the scales of motor, encoder and sensor: strokes of up to "
        f"{plan.travel_rad:.2g} rad to one side and back at {plan.speed_rad_s:.2g} and "
        f"{plan.fast_rad_s:.2g} rad/s, at most {plan.torque_limit_nm:.2g} N·m."
    )


def probe(profile: Profile, rig: Rig, stop: StopRequest) -> ProbeResult:
    """Make a probing move on a connected rig, and store its result."""
    result = _result(rig.probe(profile, stop))
    document = {"key": _key(profile, rig), "boot": _boot(), "end": result.end.name}
    path = _file(profile)
    with contextlib.suppress(OSError):
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        fresh = path.with_suffix(".new")
        fresh.write_text(json.dumps(document | result.estimate.as_dict()), encoding="utf-8")
        fresh.replace(path)
    return result


def probe_in_foreground(
    group: ProcessGroup,
    stop: StopRequest,
    *,
    profile_name: str,
    fast: bool,
    hardware: bool,
    says: Callable[[str], None],
) -> tuple[Profile, ProbeResult]:
    """Make a single probing move, whatever the profile states.

    Parameters
    ----------
    group
        The started processes. They are ended when this function returns.
    stop
        Stop request of the operator.
    profile_name
        Name or path of the profile.
    fast, hardware
        As on the command line.
    says
        Receives messages for the operator before the move begins.

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
    with contextlib.ExitStack() as reserved, group:
        profile, moving = load_rig(profile_name, fast=fast, hardware=hardware)
        says(describe_actuation_target(profile.rig, moving))
        alone = not (fast and moving is ActuationTarget.SIMULATED)
        shared = moving is ActuationTarget.HARDWARE
        reserved.enter_context(RigLock(profile.name, "rigd probe", hardware=shared, alone=alone))
        rig = Rig(profile, fast=fast, group=group)
        rig.connect(moving)
        says(announcement(profile))
        return profile, probe(profile, rig, stop)


def stored_result(profile: Profile, rig: Rig) -> ProbeResult | None:
    """Return the valid stored result of the last probing move, or None."""
    try:
        document = json.loads(_file(profile).read_text("utf-8"))
        if document.pop("key") != _key(profile, rig) or document.pop("boot") != _boot():
            return None
        return _result(document)
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None


def _result(document: Mapping[str, Any]) -> ProbeResult:
    numbers = {key: value for key, value in document.items() if key != "end"}
    return ProbeResult(ProbeEnd[document["end"]], ProbeEstimate(**numbers))


def _verified(values: Mapping[str, object]) -> dict[str, object]:
    return {key: value for key, value in values.items() if key.startswith(_VERIFIED)}


def _key(profile: Profile, rig: Rig) -> str:
    """Return the key of a result: hash of values, drive, sensor and process of a simulated rig."""
    simulator = find_simulator(profile.rig.name)
    limits = profile.limits
    belongs = (
        _verified(described(profile.rig)),
        (limits.angle_rad, limits.velocity_rad_s),
        dict(rig.drive_statement),
        dict(rig.calibration or {}),
        None if simulator is None else simulator.pid,
    )
    return hashlib.sha256(json.dumps(belongs, sort_keys=True, default=str).encode()).hexdigest()


def _boot() -> str:
    """Return the boot id of the computer; empty if there is none."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text("utf-8").strip()
    except OSError:
        return ""


def _file(profile: Profile) -> Path:
    plain = "".join(c if c.isalnum() else "-" for c in profile.name).strip("-")
    return runtime_folder() / f"probed-{plain}.json"
