"""Loops to measure: sessions of the real processes on a simulated rig."""

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

from rigd.bench.measure import LoopMeasurement, UsageMeter, measurement
from rigd.devices import unknown_values
from rigd.devices.parameters import DeviceSelection
from rigd.engine.messages import Finished, SessionJob
from rigd.engine.reference import put_reference
from rigd.engine.shared_state import Phase, StateField, Stop
from rigd.errors import FailureError
from rigd.excitation import Excitation, hold
from rigd.profile import Profile, load_profile
from rigd.runner import ProcessGroup, Rig
from rigd.runner.request import Order
from rigd.runner.session import SessionProgress
from rigd.runtime import StopRequest
from rigd.session import read_session
from rigd.session.layout import decode_samples

_POLL_S = 0.1
AROUND_S = 3.5
"""Duration of a measurement in addition to its record."""
_BLOCK = 10_000
_TARE_S = 0.2
_NO_LIMIT = 1_000_000_000

OnPoll = Callable[[], None]


class LoopError(FailureError):
    """The loop could not be measured; the message states the reason."""


def rig_for(profile: Profile, rate_hz: float, spin_us: float) -> Profile:
    """Return a profile without hardware, with the rate and spin time to measure.

    Everything is simulated in the control process. Late ticks are measured and do not end the
    session. Only the real-time settings of the given profile are used.
    """
    rig = profile.rig
    if unknown_values(rig):  # these values are irrelevant here
        sim = load_profile("sim").rig
        rig = replace(rig, motor=sim.motor, encoder=sim.encoder)
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
            missed_ticks_in_a_row=_NO_LIMIT,
            missed_percent=100.0,
            stale_percent=100.0,
            saturated_ticks_in_a_row=_NO_LIMIT,
            tare_drift_nm=inf,
        ),
        session=replace(
            profile.session,
            tare_s=_TARE_S,
            rest_velocity_rad_s=inf,
            rest_torque_nm=inf,
            tare_drift_nm=inf,
            return_s=_TARE_S,
        ),
        realtime=replace(profile.realtime, spin_us=spin_us),
    )


@contextmanager
def connected(profile: Profile, *, live: bool = False) -> Iterator[tuple[Rig, ProcessGroup]]:
    """Start the processes of a rig; leaving the context ends them."""
    try:
        with ProcessGroup(live=live) as group, ExitStack() as connection:
            rig = Rig(profile, group=group)
            rig.connect()
            # This also releases the priority and cores of the supervisor, which the next
            # measurement, such as cyclictest, would inherit.
            connection.callback(rig.disconnect)
            yield rig, group
    except (FailureError, OSError) as error:
        raise LoopError(str(error)) from error


def run_alone(name: str, profile: Profile, seconds: float, on_poll: OnPoll) -> LoopMeasurement:
    """Measure the loop alone, with only a reader that empties the ring; raise LoopError."""
    rate_hz, excitation = profile.rig.rate_hz, _excitation(profile, seconds)
    with connected(profile) as (_, group):
        channels, shared_state = group.channels, group.channels.shared_state
        meter = UsageMeter(group.control.pid)
        shared_state[StateField.STOP] = Stop.NO
        shared_state[StateField.GO] = 1
        reference = put_reference(channels.reference_fd, excitation.reference_rad)
        group.control.send(SessionJob(profile, reference))
        blocks = []
        finished = None
        while not isinstance(finished, Finished):
            finished = group.control.poll(_POLL_S)
            shared_state.beat(StateField.SUPERVISOR_BEAT)
            meter.sample(Phase(shared_state[StateField.PHASE]))
            while block := channels.samples.take(_BLOCK):
                blocks.append(block)
            channels.controls.discard()
            channels.timings.discard()
            on_poll()
    _require(finished.outcome, finished.reason)
    return measurement(
        name,
        rate_hz,
        np.concatenate([decode_samples(block) for block in blocks]),
        scheduled=excitation.reference_rad.size,
        cpu_percent=meter.cpu_percent,
        page_faults=meter.page_faults,
    )


def run_session(
    name: str, profile: Profile, seconds: float, on_poll: OnPoll, *, live: bool = False
) -> LoopMeasurement:
    """Measure a whole session, as ``rigd run``, with a temporary file; raise LoopError."""
    excitation = _excitation(profile, seconds)
    with (
        tempfile.TemporaryDirectory(prefix="rigd-bench-") as folder,
        connected(profile, live=live) as (rig, group),
    ):
        order = Order(profile, excitation, Path(folder) / "bench.mcap")
        meter = UsageMeter(group.control.pid)
        stop = StopRequest()
        if live:
            rig.show(order, stop)

        def watch(progress: SessionProgress, _: object) -> None:
            meter.sample(progress.phase)
            on_poll()

        result = rig.run(order, stop, watch)
        _require(result.outcome, result.reason)
        assert result.path is not None
        samples = read_session(result.path).samples
    return measurement(
        name,
        profile.rig.rate_hz,
        samples,
        scheduled=excitation.reference_rad.size,
        cpu_percent=meter.cpu_percent,
        page_faults=meter.page_faults,
    )


@contextmanager
def busy_program(cores: set[int]) -> Iterator[int]:
    """Run a busy program on some cores; yield its process id."""
    with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as stranger:
        try:
            os.sched_setaffinity(stranger.pid, cores)
            yield stranger.pid
        finally:
            stranger.kill()


def _excitation(profile: Profile, seconds: float) -> Excitation:
    return hold(rate_hz=profile.rig.rate_hz, duration_s=seconds, rest_s=0.0)


def _require(outcome: str, reason: str) -> None:
    if outcome != "complete":
        raise LoopError(reason)
