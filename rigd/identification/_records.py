"""Windows of motion from recorded sessions, as input of the estimate."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rigd.identification.estimate import MotorEstimateError, PassReadings, Timing
from rigd.identification.experiments import MULTISINE, SPEEDS, TOP_HZ, lay_out_passes, read_layout
from rigd.session import Session, read_session, sample_digests
from rigd.session.layout import Status

_USELESS = int(
    Status.ANGLE_STALE | Status.WRENCH_STALE | Status.WRENCH_SATURATED | Status.TORQUE_OFF
)
"""Status bits of held or clipped readings, which do not belong to the torque of their tick."""


@dataclass(frozen=True, slots=True)
class Recording:
    """Data of some sessions of one rig for the estimate."""

    windows: list[PassReadings]
    timing: Timing
    tool_inertia_kg_m2: float
    unusable: int
    """Passes with gaps, or with readings that were held or clipped."""


def read_recording(paths: Sequence[Path], actuation_delay_s: float) -> Recording:
    """Read the passes of sessions that `rigd identify motor` ran.

    Parameters
    ----------
    paths
        Session files of one rig, in any order.
    actuation_delay_s
        Start value of the search for the command's delay.

    Raises
    ------
    SessionError
        If a file cannot be read.
    MotorEstimateError
        If a file is of another excitation, its rate or delays are not those of the first, or two
        files have samples in common.
    """
    windows: list[PassReadings] = []
    unusable = 0
    first: tuple[Timing, float] | None = None
    digests: dict[Path, frozenset[bytes]] = {}
    for number, path in enumerate(paths):
        session = read_session(path)
        samples = session.samples
        own = sample_digests(samples["angle_rad"], samples["coupling_torque_nm"])
        for other, theirs in digests.items():
            if own & theirs:
                raise MotorEstimateError(
                    f"{path}: it has samples of {other}, noise included, which would count twice; "
                    "give each session once."
                )
        digests[path] = own
        found = (
            Timing(
                session.number("rate_hz"),
                session.number("angle_delay_s", 0.0),
                session.number("torque_delay_s", 0.0),
                actuation_delay_s,
            ),
            session.number("tool_inertia_kg_m2", 0.0),
        )
        if first is None:
            first = found
        if found != first:
            raise MotorEstimateError(
                f"{path}: its rate, delays or tool inertia are not those of {paths[0]}; give "
                "sessions of one rig."
            )
        usable, expected = _passes(session, number, found[0].rate_hz)
        windows += usable
        unusable += expected - len(usable)
    if first is None:
        raise MotorEstimateError("No session file is given.")
    if all(window.top_hz == TOP_HZ[SPEEDS] for window in windows):
        raise MotorEstimateError(
            "Constant speeds alone do not determine inertia, delay and torque scale; give the "
            f"session {MULTISINE} of the same rig, too."
        )
    return Recording(windows, *first, unusable)


def _passes(session: Session, number: int, rate_hz: float) -> tuple[list[PassReadings], int]:
    """Return the usable windows of a session, and how many there should be."""
    layout = read_layout(session.metadata)
    if layout is None:
        raise MotorEstimateError(
            f"{session.path}: was not recorded by rigd identify motor, so its passes are unknown; "
            "give the files that it wrote."
        )
    kind = session.metadata["excitation"]
    samples = session.samples
    ticks = samples["tick"].astype(np.int64)
    useless = (samples["status"] & _USELESS) != 0
    passes = lay_out_passes(layout, rate_hz)
    windows = []
    for run in passes:
        first, end = np.searchsorted(ticks, (run.first, run.end)).tolist()
        if end - first < run.end - run.first or useless[first:end].any():
            continue
        part = samples[first:end]
        windows.append(
            PassReadings(
                angle_rad=part["angle_rad"],
                torque_command_nm=part["torque_command_nm"],
                coupling_torque_nm=part["coupling_torque_nm"],
                speed_rad_s=run.speed_rad_s,
                top_hz=TOP_HZ[kind],
                session=number,
                key=(number, run.speed_rad_s),
            )
        )
    return windows, len(passes)
