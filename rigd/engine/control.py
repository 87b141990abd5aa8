"""The control process: it alone talks to the devices, and it never leaves the torque on."""

from dataclasses import asdict

from rigd.control import PidController, design_pid
from rigd.devices.contracts import DeviceError, Devices
from rigd.devices.registry import open_devices
from rigd.engine.board import Phase, Word
from rigd.engine.channels import Channels, attach_channels
from rigd.engine.clocks import Clock, RealClock, VirtualClock
from rigd.engine.cycle import Cycle
from rigd.engine.events import Event, write_event
from rigd.engine.jobs import ControlJob
from rigd.engine.procedure import Procedure, SessionEnd
from rigd.engine.process import Parent
from rigd.engine.realtime import REFUSED, collect_no_garbage, obtain
from rigd.engine.signals import StopRequest
from rigd.profile import Profile
from rigd.safety import LimitWatch


def main() -> None:
    """Run as ``python -m rigd.engine.control``."""
    stop = StopRequest()
    stop.catch()
    parent = Parent()
    job: ControlJob = parent.receive_job()
    channels = attach_channels(job.channels)
    realtime = job.profile.realtime
    if job.fast:
        obtained = {"clock": "virtual", "garbage_collector": collect_no_garbage()}
    else:
        obtained = {"clock": "real"} | obtain(priority=realtime.priority, cpu=realtime.cpu)
    try:
        devices = open_devices(job.profile.rig)
    except DeviceError as error:
        parent.send(finished="fault", reason=str(error), counts={}, results={})
        return
    clock: Clock = VirtualClock() if job.fast else RealClock(int(realtime.spin_us * 1000))
    conduct(job, devices, clock, channels, parent, stop, obtained)


def conduct(
    job: ControlJob,
    devices: Devices,
    clock: Clock,
    channels: Channels,
    parent: Parent,
    stop: StopRequest,
    obtained: dict[str, str],
) -> None:
    """Run one session on `devices`, whatever happens, to a disabled drive and a final message.

    Parameters
    ----------
    job
        What to run.
    devices
        Not yet connected.
    clock, channels, parent, stop
        As for :class:`rigd.engine.procedure.Procedure`.
    obtained
        The real-time settings that were granted, for the file.
    """
    rig = job.profile.rig
    cycle = Cycle(
        devices,
        rig.sensor.projection,
        _controller(job.profile),
        LimitWatch(job.profile.limits, rig.sensor.range, rig.rate_hz),
    )
    _warn_of_refusals(channels, obtained)
    outcome, reason = "complete", ""
    recorded = False
    procedure: Procedure | None = None
    try:
        # The drive last: once it is operational it expects a SYNC every period.
        devices.sensor.connect()
        devices.drive.connect()
        calibration = devices.sensor.calibration()
        procedure = Procedure(job.profile, job.excitation, cycle, clock, channels, parent, stop)
        tare = procedure.tare()
        devices.drive.enable()
        procedure.hold()
        parent.send(
            ready=tare,
            calibration=calibration,
            realtime=obtained,
            simulated=devices.simulated,
        )
        procedure.wait_for_go()
        procedure.record()
        recorded = True
        procedure.go_back()
        cycle.torque_off()
        procedure.check_tare()
    except SessionEnd as end:
        outcome, reason = end.outcome, end.reason
    except (DeviceError, OSError) as error:
        outcome, reason = "fault", str(error)
    finally:
        devices.drive.disable()
        channels.board[Word.PHASE] = Phase.OFF
        devices.drive.close()
        devices.sensor.close()
    doubt = devices.drive.off_doubt
    if doubt:
        outcome, reason = "fault", f"{reason} {doubt}".strip()
    if recorded and reason:
        # What happens after the last tick does not make the record any less complete.
        outcome, reason = "complete", f"After the record: {reason}"
    counts = asdict(procedure.counts) if procedure is not None else {}
    results = procedure.results if procedure is not None else {}
    parent.send(finished=outcome, reason=reason, counts=counts, results=results)


def _warn_of_refusals(channels: Channels, obtained: dict[str, str]) -> None:
    refused = [f"{name} ({text})" for name, text in obtained.items() if text.startswith(REFUSED)]
    if refused:
        message = f"The system did not grant {', '.join(refused)}: more ticks will be late."
        write_event(channels.events, Event(0, "warning", message))


def _controller(profile: Profile) -> PidController:
    motor = profile.control_motor
    gains = design_pid(motor.inertia_kg_m2, motor.viscous_nm_s_per_rad, profile.control.pole_rad_s)
    return PidController(gains, profile.control, profile.rig.rate_hz, motor.peak_torque_nm)


if __name__ == "__main__":
    main()
