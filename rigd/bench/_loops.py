"""Measurement of the loop in sessions of the real processes on a simulated rig."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from math import inf
from pathlib import Path

import numpy as np

from rigd.bench.measure import LoopMeasurement, UsageMeter, measurement_from_samples
from rigd.devices import unknown_values
from rigd.devices.parameters import DeviceSelection
from rigd.engine.messages import SessionFinished, SessionJob
from rigd.engine.reference import write_reference
from rigd.engine.shared_state import Phase, StateField, StopReason
from rigd.errors import FailureError
from rigd.excitation import Excitation, hold
from rigd.profile import Profile, load_profile
from rigd.runner import ProcessGroup, Rig
from rigd.runner.request import SessionOrder
from rigd.runner.session import SessionProgress
from rigd.runtime import StopRequest
from rigd.session import read_session
from rigd.session.layout import decode_samples

_POLL_TIMEOUT_S = 0.1
"""Longest wait in seconds for a message of the control process."""
MEASUREMENT_OVERHEAD_S = 3.5
"""Duration of a measurement in seconds in addition to its record."""
_MAX_RECORDS_PER_READ = 10_000
"""Largest number of records that are read at once."""
_SHORT_TARE_S = 0.2
"""Duration in seconds of the tare, and of the return, in a measured session."""
_UNREACHABLE_TICK_COUNT = 1_000_000_000
"""Number of ticks that no session reaches, for limits that shall have no effect."""

PollCallback = Callable[[], None]
"""Type of a function that is called about ten times a second during a measurement."""


class LoopError(FailureError):
    """Raised with the reason if a session that measures the timing of the loop fails."""


def simulated_profile(profile: Profile, rate_hz: float, spin_us: float) -> Profile:
    """Return a profile of a simulated rig with the given loop rate and spin time.

    Everything is simulated in the control process. Late ticks are measured and do not end the
    session. Only the real-time settings of the given profile are used.
    """
    rig = profile.rig
    if unknown_values(rig):  # these values are irrelevant here
        simulated_rig = load_profile("sim").rig
        rig = replace(rig, motor=simulated_rig.motor, encoder=simulated_rig.encoder)
    return replace(
        profile,
        rig=replace(
            rig,
            rate_hz=rate_hz,
            actuation=replace(rig.actuation, delay_s=1.0 / rate_hz),
            devices=DeviceSelection("sim", "sim"),
            simulation=rig.simulation or load_profile("sim").rig.simulation,
            can=None,
            acquisition=None,
            cia402=None,
            ati_can=None,
            ati_serial=None,
        ),
        limits=replace(
            profile.limits,
            missed_ticks_in_a_row=_UNREACHABLE_TICK_COUNT,
            missed_percent=100.0,
            stale_percent=100.0,
            saturated_ticks_in_a_row=_UNREACHABLE_TICK_COUNT,
            tare_drift_nm=inf,
        ),
        session=replace(
            profile.session,
            tare_s=_SHORT_TARE_S,
            rest_velocity_rad_s=inf,
            rest_torque_nm=inf,
            tare_drift_nm=inf,
            return_s=_SHORT_TARE_S,
        ),
        realtime=replace(profile.realtime, spin_us=spin_us),
    )


@contextmanager
def connected_rig(
    profile: Profile, *, with_live_view: bool = False
) -> Iterator[tuple[Rig, ProcessGroup]]:
    """Start and connect the processes of a rig; they end when the context is left."""
    try:
        with (
            ProcessGroup(with_live_view=with_live_view) as process_group,
            ExitStack() as connection,
        ):
            rig = Rig(profile, group=process_group)
            rig.connect()
            # This also releases the priority and cores of the supervisor, which the next
            # measurement, such as cyclictest, would inherit.
            connection.callback(rig.disconnect)
            yield rig, process_group
    except (FailureError, OSError) as error:
        raise LoopError(str(error)) from error


def run_without_recorder(
    measurement_name: str, profile: Profile, record_duration_s: float, on_poll: PollCallback
) -> LoopMeasurement:
    """Measure the loop without a recorder, or raise LoopError.

    This process only reads the samples from the ring buffer.
    """
    rate_hz, excitation = profile.rig.rate_hz, _hold_excitation(profile, record_duration_s)
    with connected_rig(profile) as (_, process_group):
        channels, shared_state = process_group.channels, process_group.channels.shared_state
        usage_meter = UsageMeter(process_group.control.pid)
        shared_state[StateField.STOP_REASON] = StopReason.NONE
        shared_state[StateField.RECORD_MAY_START] = 1
        reference_record = write_reference(channels.reference_fd, excitation.reference_rad)
        process_group.control.send(SessionJob(profile, reference_record))
        sample_blocks = []
        finished_message = None
        while not isinstance(finished_message, SessionFinished):
            finished_message = process_group.control.poll(_POLL_TIMEOUT_S)
            shared_state.beat(StateField.SUPERVISOR_BEAT)
            usage_meter.sample_usage(Phase(shared_state[StateField.PHASE]))
            while sample_block := channels.samples.take(_MAX_RECORDS_PER_READ):
                sample_blocks.append(sample_block)
            channels.controls.discard_records()
            channels.timings.discard_records()
            on_poll()
    _require_complete_session(finished_message.outcome, finished_message.reason)
    return measurement_from_samples(
        measurement_name,
        rate_hz,
        np.concatenate([decode_samples(sample_block) for sample_block in sample_blocks]),
        scheduled_ticks=excitation.reference_rad.size,
        cpu_percent=usage_meter.cpu_percent,
        page_faults=usage_meter.page_faults,
    )


def run_session(
    measurement_name: str,
    profile: Profile,
    record_duration_s: float,
    on_poll: PollCallback,
    *,
    with_live_view: bool = False,
) -> LoopMeasurement:
    """Measure a complete session like that of ``rigd run``, or raise LoopError.

    The session file is temporary.
    """
    excitation = _hold_excitation(profile, record_duration_s)
    with (
        tempfile.TemporaryDirectory(prefix="rigd-bench-") as temporary_folder,
        connected_rig(profile, with_live_view=with_live_view) as (rig, process_group),
    ):
        session_order = SessionOrder(profile, excitation, Path(temporary_folder) / "bench.mcap")
        usage_meter = UsageMeter(process_group.control.pid)
        stop_request = StopRequest()
        if with_live_view:
            rig.show_session(session_order, stop_request)

        def on_progress(progress: SessionProgress, _: object) -> None:
            usage_meter.sample_usage(progress.phase)
            on_poll()

        session_result = rig.run(session_order, stop_request, on_progress)
        _require_complete_session(session_result.outcome, session_result.reason)
        assert session_result.path is not None
        samples = read_session(session_result.path).samples
    return measurement_from_samples(
        measurement_name,
        profile.rig.rate_hz,
        samples,
        scheduled_ticks=excitation.reference_rad.size,
        cpu_percent=usage_meter.cpu_percent,
        page_faults=usage_meter.page_faults,
    )


@contextmanager
def busy_program(cores: set[int]) -> Iterator[int]:
    """Run a program that uses the given cores fully while the context lasts; yield its pid."""
    with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as busy_process:
        try:
            os.sched_setaffinity(busy_process.pid, cores)
            yield busy_process.pid
        finally:
            busy_process.kill()


def _hold_excitation(profile: Profile, hold_duration_s: float) -> Excitation:
    """Return an excitation whose reference angle is constant for some seconds."""
    return hold(rate_hz=profile.rig.rate_hz, duration_s=hold_duration_s, rest_s=0.0)


def _require_complete_session(outcome: str, reason: str) -> None:
    """Raise LoopError unless the session is complete."""
    if outcome != "complete":
        raise LoopError(reason)
