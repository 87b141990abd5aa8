"""Preparation of a requested session: rig, session file, disk space and metadata.

`rigd run` and the daemon use it.
"""

import json
import os
import platform
import shlex
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cache
from pathlib import Path

from rigd import __version__
from rigd.checks import FailedCheck
from rigd.control.kinds import CONTROLLERS
from rigd.devices import (
    ActuationTarget,
    actuation_target,
    bus_conflicts,
    check_selection,
    describe_actuation_target,
    simulation_differences,
)
from rigd.devices.kinds import DEVICES
from rigd.devices.obstacles import with_obstacles
from rigd.devices.parameters import RigParameters
from rigd.devices.running_simulator import unreachable_simulator_sockets
from rigd.engine.messages import DevicesConnected, FileHeader, PostRecordPlan
from rigd.excitation import Excitation, PrecisionExcitation, PrecisionSearch, find_excitation
from rigd.plugins import plugin_errors
from rigd.printable import printable
from rigd.profile import Profile, load_profile
from rigd.runner._touch_search import TouchSearch
from rigd.runner.planning import RefusedError
from rigd.safety.limits import Limits
from rigd.session import PART_SUFFIX
from rigd.session.user_metadata import META_PREFIX, NOTES
from rigd.units import unit_of

_MAX_BYTES_PER_TICK = 260
"""Maximum number of uncompressed bytes that a tick adds to a session file: sample, ages of the
readings, controller terms and index."""
_MAX_BYTES_WITHOUT_TICKS = 1_000_000
"""Assumed maximum number of bytes of a session file without its ticks."""
_GIT_TIMEOUT_S = 2.0
"""Maximum time in seconds for the call of git that returns the commit."""


class NoRoomError(RefusedError):
    """Raised if a session file cannot be written to its folder, for example if the disk is full."""


@dataclass(frozen=True, slots=True)
class SessionOrder:
    """Data of a session to run, which was already checked against the limits of the profile."""

    profile: Profile
    """Profile of the rig."""
    excitation: Excitation
    """Excitation with its reference angle."""
    path: Path
    """Final path of the session file."""
    notes: tuple[tuple[str, str], ...] = ()
    """Metadata of the user (key, text), such as operator, specimen, note and number in a series."""
    predicted_metadata: tuple[tuple[str, str], ...] = ()
    """Metadata (key, text) with the predicted peaks and their limits."""
    ending: PostRecordPlan = field(default_factory=PostRecordPlan)
    """Motion after the record, such as the return to the start."""
    touch: TouchSearch | None = None
    """Settings of the search for an obstacle, or None for a session without a search."""
    watch_fit: bool = False
    """Whether the record is fitted repeatedly, even if the end of the session is planned."""
    seed: int | None = None
    """Seed of a simulated rig's noise, or None for a random seed."""
    accepted_checks: tuple[FailedCheck, ...] = ()
    """Failed checks of the profile that the operator accepted."""

    @property
    def search(self) -> PrecisionSearch | None:
        """Precision that ends the session when it is reached, or None if the end is planned."""
        excitation = self.excitation
        return excitation.search if isinstance(excitation, PrecisionExcitation) else None

    @property
    def makes_fits(self) -> bool:
        """Whether the record is fitted during the session."""
        return self.watch_fit or self.excitation.ends_itself


def load_rig(
    profile_name: str,
    *,
    uses_virtual_clock: bool = False,
    seed: int | None = None,
    force_hardware: bool = False,
    obstacles: Sequence[str] = (),
) -> tuple[Profile, ActuationTarget]:
    """Return a profile, and whether its sessions move the hardware or a simulated rig.

    Parameters
    ----------
    profile_name
        Name of the profile, or path of its file.
    uses_virtual_clock
        Whether the session runs under the virtual clock, faster than real time.
    seed
        Seed of a simulated rig's noise, or None for the profile's seed, if it states one.
    force_hardware
        Whether the operator explicitly requests that the hardware moves.
    obstacles
        Obstacles of a simulated beam, in addition to the obstacles of the profile.

    Raises
    ------
    ObstacleError
        If an obstacle has a wrong syntax, or cannot be simulated on this rig.
    ProfileError, UnknownDeviceError
        If the profile is invalid, or names an unknown device.
    RefusedError
        If the devices cannot be on one bus, if an option does not fit the actuation target, or if a
        simulated rig is running that this process cannot reach, so that the hardware would move
        instead.
    """
    software_commit()  # called early, because it is slow and the motor is held during the header
    profile = load_profile(profile_name)
    check_selection(profile.rig.devices, profile.path)
    bus_conflict_texts = bus_conflicts(profile.rig)
    if bus_conflict_texts:
        raise RefusedError(
            "\n".join(f"{profile.path}: {refusal}" for refusal in bus_conflict_texts)
        )
    target = actuation_target(profile.rig)
    if force_hardware and target is not ActuationTarget.HARDWARE:
        raise RefusedError(
            f"--hardware: {describe_actuation_target(profile.rig, target)} Omit the option, or end "
            "the simulated rig."
        )
    if target is ActuationTarget.HARDWARE and not force_hardware:
        _refuse_unreachable_simulators(profile)
    is_given_by_option = {
        "--fast": uses_virtual_clock,
        "--seed": seed is not None,
        "--obstacle": bool(obstacles),
    }
    simulation_options = [option for option, is_given in is_given_by_option.items() if is_given]
    if target is ActuationTarget.HARDWARE and simulation_options:
        raise RefusedError(
            f"{simulation_options[0]}: {profile.path} is a profile of hardware, and the option is "
            "for simulated rigs only. Without it, the session would move the motor. To simulate "
            f"the session, first start rigd simulate --profile {shlex.quote(profile_name)}"
            f"{' --lock-step' if uses_virtual_clock else ''} in another terminal."
        )
    if uses_virtual_clock and not target.allows_virtual_clock:
        raise RefusedError(
            f"--fast: {target.value} of {profile.path} moves in real time, which cannot be "
            "skipped; omit the option. Or start rigd simulate with --lock-step."
        )
    if seed is not None:
        if profile.rig.simulation is None:
            raise RefusedError(
                f"--seed: {profile.path} has no section [simulation]; copy it from that of rigd "
                "profiles show sim, or omit the option."
            )
        simulation_settings = replace(profile.rig.simulation, seed=seed)
        profile = replace(profile, rig=replace(profile.rig, simulation=simulation_settings))
    if obstacles:
        if target is not ActuationTarget.SIMULATED:
            raise RefusedError(
                f"--obstacle: {target.value} of {profile.path} is not simulated here; omit the "
                "option. Or inject the obstacle into the simulated rig (rigd inject obstacle,x=…)."
            )
        profile = replace(profile, rig=with_obstacles(profile.rig, obstacles))
    return profile, target


def _refuse_unreachable_simulators(profile: Profile) -> None:
    """Raise if a simulated rig of a profile is running but this process cannot reach it."""
    for simulator_path in unreachable_simulator_sockets(profile.rig.name):
        remedy, owner_name = "run this command as its user to use it", "by another user"
        with suppress(OSError, ValueError):
            uid = simulator_path.stat().st_uid
            owner_name = f"by user {uid}"
            if uid == os.getuid():
                owner_name = "in another environment"
                remedy = (
                    f"set XDG_RUNTIME_DIR={shlex.quote(str(simulator_path.parent.parent))} "
                    "to use it"
                )
        shown_path = printable(str(simulator_path))  # another user may have chosen any name
        raise RefusedError(
            f"A simulated rig of {profile.name} is run {owner_name} ({shown_path}), which this "
            f"command does not reach, and the hardware would move instead. Either {remedy}, or end "
            "it, or give --hardware if the hardware is meant."
        )


def require_metadata(profile: Profile, notes: Mapping[str, str]) -> None:
    """Raise if a session lacks metadata that its profile requires.

    Parameters
    ----------
    profile
        Profile of the rig.
    notes
        Metadata of the user: key in the session file → text.

    Raises
    ------
    RefusedError
        If metadata are missing. The message states their names and options.
    """
    missing_names = [
        metadata_name
        for metadata_name in profile.metadata.required
        if not notes.get(metadata_name if metadata_name in NOTES else META_PREFIX + metadata_name)
    ]
    if missing_names:
        option_texts = (
            f"--{metadata_name} …"
            if metadata_name in NOTES
            else f"--meta {metadata_name}=…{_unit_in_parentheses(metadata_name)}"
            for metadata_name in missing_names
        )
        raise RefusedError(
            f"{profile.path}: metadata.required asks each session for "
            f"{', '.join(missing_names)}; add {' '.join(option_texts)}."
        )


def _unit_in_parentheses(metadata_name: str) -> str:
    """Return the unit of a metadata name in parentheses, or "" if the name ends in no unit."""
    return f" ({unit_of(metadata_name)})" if unit_of(metadata_name) else ""


def make_folder(folder: Path) -> None:
    """Create the folder of the session files if it does not exist.

    Raises
    ------
    NoRoomError
        If the folder cannot be created or is not writable.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise NoRoomError(
            f"{folder} cannot be created ({error.strerror}); choose another (--output)."
        ) from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise NoRoomError(
            f"{folder}: no write permission; ask its owner, or choose another folder (--output)."
        )


def require_disk_space(folder: Path, excitation: Excitation, limits: Limits) -> None:
    """Create the folder of the session files, and raise if its disk lacks space for a session.

    Parameters
    ----------
    folder
        Folder of the session files.
    excitation
        Excitation of the session, whose length determines the size of the file.
    limits
        Limits of the profile, including the disk space that must remain free.

    Raises
    ------
    NoRoomError
        If the folder cannot be created or is not writable, or the disk is too full.
    """
    make_folder(folder)
    try:
        free_bytes = shutil.disk_usage(folder).free
    except OSError as error:
        raise NoRoomError(
            f"{folder}: free disk space is unknown ({error.strerror}); check that the "
            "disk is mounted."
        ) from error
    needed_bytes = excitation.reference_rad.size * _MAX_BYTES_PER_TICK + _MAX_BYTES_WITHOUT_TICKS
    if free_bytes - needed_bytes < limits.disk_free_mb * 1e6:
        raise NoRoomError(
            f"{folder}: {free_bytes / 1e6:.1f} MB free, of which the session may need "
            f"{needed_bytes / 1e6:.1f} MB, and limits.disk_free_mb = {limits.disk_free_mb:g} MB "
            "must remain free; free up space or choose another folder (--output)."
        )


def choose_session_path(
    folder: Path, excitation_kind: str, session_number: int | None = None
) -> Path:
    """Return an unused path for a session file, made from time, excitation and number.

    The file is not created. The recorder later refuses the path if a file exists there by then.

    Parameters
    ----------
    folder
        Folder of the session files.
    excitation_kind
        Name of the excitation.
    session_number
        Number of the session in its series, or None for a single session.
    """
    file_stem = f"{datetime.now(UTC):%Y%m%d-%H%M%S}-{excitation_kind}"
    if session_number is not None:
        file_stem += f"-{session_number:02d}"
    session_path = folder / f"{file_stem}.mcap"
    return _unused_path(session_path)


def part_path(path: Path) -> Path:
    """Return the path that a session file has until it is complete: X.mcap.part for X.mcap."""
    return path.with_name(path.name + PART_SUFFIX)


def _unused_path(session_path: Path) -> Path:
    """Return a path at which no session file exists, with a number appended if necessary."""
    while session_path.exists() or part_path(session_path).exists():
        session_path = next_free_path(session_path)
    return session_path


def next_free_path(session_path: Path) -> Path:
    """Return the next path for a session file if its path is used: X.mcap → X_2.mcap → X_3.mcap."""
    base_stem, _, number_text = session_path.stem.rpartition("_")
    if base_stem and number_text.isdecimal():
        return session_path.with_name(f"{base_stem}_{int(number_text) + 1}{session_path.suffix}")
    return session_path.with_name(f"{session_path.stem}_2{session_path.suffix}")


def remaining_file_text(session_path: Path | None) -> str:
    """Return a sentence that states what a failed session recorded, and how to recover it.

    Call this after the processes of the session have ended.

    Parameters
    ----------
    session_path
        Path of the session file, or None if no file was begun.
    """
    from rigd.session import may_contain_samples

    if session_path is None:
        return "It has no file."
    part_file_path = part_path(session_path)
    try:
        part_exists, file_exists = part_file_path.exists(), session_path.exists()
    except OSError as error:
        return f"Its folder {session_path.parent} cannot be read ({error.strerror})."
    if not part_exists:
        return (
            f"Its file is {session_path}."
            if file_exists
            else f"There is no {session_path.name} in {session_path.parent}."
        )
    if not may_contain_samples(part_file_path):
        return f"Nothing was recorded; {part_file_path} holds no sample and can be removed."
    old_path_text, new_path_text = (
        shlex.quote(str(part_path(file_path)))
        for file_path in (session_path, _unused_path(session_path))
    )
    if not file_exists:
        return (
            f"What was recorded is in {part_file_path}; rigd recover {old_path_text} makes a "
            "clean file of it."
        )
    return (
        f"What was recorded is in {part_file_path}, whose name without {PART_SUFFIX} is taken: "
        f"after mv {old_path_text} {new_path_text} rigd recover {new_path_text} makes a clean file "
        "of it."
    )


def file_header(
    session_order: SessionOrder, connection: DevicesConnected, tare_metadata: Mapping[str, str]
) -> FileHeader:
    """Return the metadata, segments and attachments with which a session file begins.

    Parameters
    ----------
    session_order
        The session.
    connection
        Devices and real-time settings that the control process has reported.
    tare_metadata
        Metadata of the tare, and the seed of a simulated rig's noise.
    """
    specimen = session_order.profile.specimen
    return FileHeader(
        metadata=_session_metadata(session_order, connection, tare_metadata),
        segments=dict(session_order.excitation.segments),
        attachments={
            "profile.toml": session_order.profile.text,
            **({} if specimen is None else {"specimen.toml": specimen.text}),
            "calibration.json": json.dumps(connection.calibration, indent=1),
        },
    )


def _session_metadata(
    session_order: SessionOrder, connection: DevicesConnected, tare_metadata: Mapping[str, str]
) -> dict[str, str]:
    """Return the record ``session`` of a session file: key → text."""
    rig = session_order.profile.rig
    metadata = {
        "id": session_order.path.stem,
        "rate_hz": repr(rig.rate_hz),
        "excitation": session_order.excitation.kind,
        "uniformity_percent": repr(session_order.profile.uncertainty.uniformity_percent),
        # The parameters of a session may override the uniformity.
        **{
            parameter_name: _parameter_text(parameter_value)
            for parameter_name, parameter_value in session_order.excitation.parameters.items()
        },
        "beam_length_m": repr(rig.beam.length_m),
        "beam_density_kg_per_m": repr(rig.beam.density_kg_per_m),
        "beam_bending_stiffness_n_m2": repr(rig.beam.bending_stiffness_n_m2),
        "tool_inertia_kg_m2": repr(rig.sensor.tool_inertia_kg_m2),
        "angle_delay_s": repr(rig.encoder.delay_s),
        "torque_delay_s": repr(rig.sensor.delay_s),
        "actuation_delay_s": repr(rig.actuation.delay_s),
        **{
            f"uncertainty_{k}": repr(v)
            for k, v in session_order.profile.uncertainty.nonzero_percent_by_field.items()
        },
        "sensor_projection": ",".join(map(repr, rig.sensor.projection)),
        "drive": rig.devices.drive,
        "sensor": rig.devices.sensor,
        "simulated": str(connection.simulated).lower(),
        "profile": session_order.profile.name,
        "software": f"rigd {__version__}",
        **software_commit(),
        "host": platform.node(),
        **{
            f"realtime_{setting_name}": setting_text
            for setting_name, setting_text in connection.realtime.items()
        },
        **connection.drive,
        **tare_metadata,
        **dict(session_order.predicted_metadata),
        **dict(session_order.notes),
    }
    if session_order.accepted_checks:
        metadata["accepted_checks"] = ", ".join(
            accepted_check.name for accepted_check in session_order.accepted_checks
        )
    serial_number = connection.calibration.get("serial_number")
    if isinstance(serial_number, str):
        metadata["sensor_serial_number"] = serial_number
    differences_from_simulator = simulation_differences(rig)
    if differences_from_simulator:
        metadata["simulated_differently"] = "; ".join(differences_from_simulator)
    if rig.acquisition is not None:
        metadata["acquisition_mode"] = rig.acquisition.mode
        metadata["acquisition_deadline_s"] = repr(rig.acquisition.deadline_us * 1e-6)
    metadata = (
        _device_metadata(rig)
        | _controller_metadata(session_order.profile)
        | _excitation_metadata(session_order.excitation.kind)
        | metadata
    )
    if session_order.profile.tip_mass_kg is not None:
        metadata["tip_mass_kg"] = repr(session_order.profile.tip_mass_kg)
    if session_order.profile.axis_tilt_deg is not None:
        metadata["axis_tilt_deg"] = repr(session_order.profile.axis_tilt_deg)
    if any(rig.sensor.shear_projection):
        metadata["shear_projection"] = ",".join(map(repr, rig.sensor.shear_projection))
    if rig.sensor.filter_hz > 0:
        metadata["torque_filter_hz"] = repr(rig.sensor.filter_hz)
        metadata["torque_filter_order"] = repr(rig.sensor.filter_order)
    if rig.devices.drive == "sim" and rig.simulation is not None and rig.simulation.obstacles:
        metadata["simulation_obstacles"] = "; ".join(rig.simulation.obstacles)
    return metadata


def _excitation_metadata(excitation_kind: str) -> dict[str, str]:
    """Return metadata of an excitation that a package adds; empty for a built-in one.

    They state the package, and why the Welch method does not suit the excitation.
    """
    declaration_and_owner = find_excitation(excitation_kind)
    if declaration_and_owner is None:
        return {}
    declaration, owner = declaration_and_owner
    metadata = {"excitation_package": owner.label}
    if declaration.welch_exclusion:
        metadata["welch_exclusion"] = declaration.welch_exclusion
    return metadata


def _controller_metadata(profile: Profile) -> dict[str, str]:
    """Return metadata of a controller that a package adds; empty for the built-in one."""
    plugin_owner = CONTROLLERS.owner(profile.control.controller)
    return (
        {}
        if plugin_owner is None
        else {"controller": plugin_owner.name, "controller_package": plugin_owner.label}
    )


def _device_metadata(rig: RigParameters) -> dict[str, str]:
    """Return metadata of the devices: the packages that add them, and what their kinds declare."""
    metadata: dict[str, str] = {}
    for role, name in (("drive", rig.devices.drive), ("sensor", rig.devices.sensor)):
        kind, owner = DEVICES.get(name), DEVICES.owner(name)
        if owner is not None:
            metadata[f"{role}_package"] = owner.label
        if kind is not None and kind.metadata is not None:
            with plugin_errors(owner):
                metadata |= kind.metadata(rig)
    return metadata


@cache
def software_commit() -> dict[str, str]:
    """Return metadata with the git commit of this program; empty without a git checkout.

    The result of the first call is cached, because the running code does not change.
    """
    checkout_folder = Path(__file__).resolve().parents[2]
    if not (checkout_folder / ".git").exists():
        return {}
    git_command = ["git", "--no-optional-locks", "-C", str(checkout_folder), "describe"]
    git_command += ["--always", "--dirty", "--abbrev=12"]
    try:
        git_result = subprocess.run(
            git_command, capture_output=True, text=True, timeout=_GIT_TIMEOUT_S, check=True
        )
    except (OSError, subprocess.SubprocessError, UnicodeDecodeError):
        return {}
    commit_name = git_result.stdout.strip()
    return {"software_commit": commit_name} if commit_name.isprintable() and commit_name else {}


def _parameter_text(parameter_value: float | str) -> str:
    """Return the text of an excitation parameter for the metadata."""
    # A file name may contain invalid characters; the session file must be written nevertheless.
    return (
        parameter_value.encode(errors="backslashreplace").decode()
        if isinstance(parameter_value, str)
        else repr(parameter_value)
    )
