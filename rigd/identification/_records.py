"""Reader of the recorded windows of motion from which a motor is estimated."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rigd.identification.estimate import MotorEstimateError, PassReadings, Timing
from rigd.identification.experiments import (
    HIGHEST_FREQUENCY_HZ,
    MULTISINE_EXCITATION,
    SPEEDS_EXCITATION,
    passes_of_schedule,
    read_schedule,
)
from rigd.session import Session, read_session, sample_digests
from rigd.session.layout import Status

_UNUSABLE_STATUS = int(
    Status.ANGLE_STALE | Status.WRENCH_STALE | Status.WRENCH_SATURATED | Status.TORQUE_OFF
)
"""Status bits of samples that cannot be used.

Such a sample has old or clipped readings, or the torque was off, so that its readings are not the
response to the commanded torque."""


@dataclass(frozen=True, slots=True)
class Recording:
    """Windows of motion from sessions of one rig, for the estimate of its motor."""

    windows: list[PassReadings]
    """Usable windows of all sessions."""
    timing: Timing
    """Rate and delays of the readings."""
    tool_inertia_kg_m2: float
    """Inertia between sensor and beam."""
    unusable_pass_count: int
    """Number of passes that were left out for missing, old or clipped readings."""


def read_recording(paths: Sequence[Path], actuation_delay_s: float) -> Recording:
    """Read the windows of motion from sessions that `rigd identify motor` recorded.

    Parameters
    ----------
    paths
        Session files of one rig, in any order.
    actuation_delay_s
        Start value in s of the search for the delay from a command to its torque.

    Returns
    -------
    Recording
        Windows, and timing of their readings.

    Raises
    ------
    SessionError
        If a file cannot be read.
    MotorEstimateError
        If a file is of another excitation, its rate or delays are not those of the first, or two
        files have samples in common.
    """
    pass_readings: list[PassReadings] = []
    unusable_pass_count = 0
    first_rig_data: tuple[Timing, float] | None = None
    digests_by_path: dict[Path, frozenset[bytes]] = {}
    for session_number, session_path in enumerate(paths):
        session = read_session(session_path)
        sample_records = session.samples
        tick_digests = sample_digests(
            sample_records["angle_rad"], sample_records["coupling_torque_nm"]
        )
        for other_path, other_digest in digests_by_path.items():
            if tick_digests & other_digest:
                raise MotorEstimateError(
                    f"{session_path}: it has samples of {other_path}, noise included, which would "
                    "count twice; give each session once."
                )
        digests_by_path[session_path] = tick_digests
        rig_data = (
            Timing(
                session.number("rate_hz"),
                session.number("angle_delay_s", 0.0),
                session.number("torque_delay_s", 0.0),
                actuation_delay_s,
            ),
            session.number("tool_inertia_kg_m2", 0.0),
        )
        if first_rig_data is None:
            first_rig_data = rig_data
        if rig_data != first_rig_data:
            raise MotorEstimateError(
                f"{session_path}: its rate, delays or tool inertia are not those of {paths[0]}; "
                "give sessions of one rig."
            )
        usable_passes, pass_count = _read_passes(session, session_number, rig_data[0].rate_hz)
        pass_readings += usable_passes
        unusable_pass_count += pass_count - len(usable_passes)
    if first_rig_data is None:
        raise MotorEstimateError("No session file is given.")
    if {pass_window.highest_frequency_hz for pass_window in pass_readings} == {
        HIGHEST_FREQUENCY_HZ[SPEEDS_EXCITATION]
    }:
        raise MotorEstimateError(
            "Constant speeds alone do not determine inertia, delay and torque scale; give the "
            f"session {MULTISINE_EXCITATION} of the same rig, too."
        )
    return Recording(pass_readings, *first_rig_data, unusable_pass_count)


def _read_passes(
    session: Session, session_number: int, rate_hz: float
) -> tuple[list[PassReadings], int]:
    """Return the usable windows of a session, and the number of all its passes."""
    schedule = read_schedule(session.metadata)
    if schedule is None:
        raise MotorEstimateError(
            f"{session.path}: was not recorded by rigd identify motor, so its passes are unknown; "
            "give the files that it wrote."
        )
    excitation_name = session.metadata["excitation"]
    sample_records = session.samples
    tick_numbers = sample_records["tick"].astype(np.int64)
    is_unusable = (sample_records["status"] & _UNUSABLE_STATUS) != 0
    speed_passes = passes_of_schedule(schedule, rate_hz)
    pass_readings = []
    for speed_pass in speed_passes:
        first_index, end_index = np.searchsorted(
            tick_numbers, (speed_pass.first_tick, speed_pass.end_tick)
        ).tolist()
        if (
            end_index - first_index < speed_pass.end_tick - speed_pass.first_tick
            or is_unusable[first_index:end_index].any()
        ):
            continue
        window_samples = sample_records[first_index:end_index]
        pass_readings.append(
            PassReadings(
                angle_rad=window_samples["angle_rad"],
                torque_command_nm=window_samples["torque_command_nm"],
                coupling_torque_nm=window_samples["coupling_torque_nm"],
                speed_rad_s=speed_pass.speed_rad_s,
                highest_frequency_hz=HIGHEST_FREQUENCY_HZ[excitation_name],
                session=session_number,
                motion_key=(session_number, speed_pass.speed_rad_s),
            )
        )
    return pass_readings, len(speed_passes)
