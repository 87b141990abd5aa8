"""What the devices themselves say: connected, asked and polled, but never enabled."""

from collections.abc import Iterable, Iterator
from contextlib import ExitStack

from rigd.checks.drive import InspectableDrive, drive_rows
from rigd.checks.exchange import exchange_rows
from rigd.checks.rows import Row, Verdict
from rigd.checks.sensor import MEASURED_S, MeasurableSensor, calibration_rows, measured_rows
from rigd.devices.contracts import DeviceError, Devices
from rigd.devices.parameters import RigParameters
from rigd.devices.registry import Reality, open_devices, reality
from rigd.devices.simulator import find_simulator
from rigd.profile import Profile


def inspect_devices(profile: Profile) -> list[Row]:
    """Connect to the devices of a profile, ask them, run some ticks, and let go of them.

    No torque: the drive is never enabled. Whatever happens, both devices are closed.
    """
    rig = profile.rig
    moves = reality(rig)
    rows = list(_link_rows(rig, moves))
    try:
        devices = open_devices(rig)
        with ExitStack() as closing:
            closing.callback(devices.sensor.close)
            closing.callback(devices.drive.close)
            _ask(profile, devices, moves, rows)
    except (DeviceError, OSError) as error:
        rows.append(Row("devices", "open and close", str(error), "", Verdict.FAIL))
    return rows


def _ask(profile: Profile, devices: Devices, moves: Reality, rows: list[Row]) -> None:
    rig, drive, sensor = profile.rig, devices.drive, devices.sensor

    def about_drive() -> Iterator[Row]:
        drive.connect()
        yield Row("drive", "connection", _answer(moves), "an answer, no fault", Verdict.OK)
        if isinstance(drive, InspectableDrive):
            yield from drive_rows(drive, rig)

    def about_sensor() -> Iterator[Row]:
        sensor.connect()
        yield Row("sensor", "connection", _answer(moves), "an answer, no error", Verdict.OK)
        yield from calibration_rows(sensor.calibration(), rig)

    def rate() -> Iterator[Row]:
        if not isinstance(sensor, MeasurableSensor) or moves.any_clock:
            yield Row("sensor", "rate", f"not measured: {moves.value}", "", Verdict.SKIPPED)
        else:
            yield from measured_rows(sensor.measure(MEASURED_S), rig)

    # The drive last: once it is operational it expects a SYNC every period.
    sensor_answers = _try("sensor", about_sensor(), rows) and _try("sensor", rate(), rows)
    drive_answers = _try("drive", about_drive(), rows)
    if moves is Reality.SIMULATED:
        rows.append(Row("exchange", "ticks", "simulated in this process", "", Verdict.SKIPPED))
    elif drive_answers and sensor_answers:
        _try("exchange", exchange_rows(profile, devices, moves), rows)
    else:
        why = "not without drive and sensor"
        rows.append(Row("exchange", "ticks", why, "", Verdict.SKIPPED))


def _try(group: str, found: Iterable[Row], rows: list[Row]) -> bool:
    """Take in rows up to the first error, which becomes one too; say whether there was none."""
    try:
        rows.extend(found)
    except (DeviceError, OSError) as error:
        rows.append(Row(group, "error", str(error), "", Verdict.FAIL))
        return False
    return True


def _answer(moves: Reality) -> str:
    return "simulated in this process" if moves is Reality.SIMULATED else "it answers"


def _link_rows(rig: RigParameters, moves: Reality) -> Iterator[Row]:
    simulator = find_simulator(rig.name)
    if simulator is not None:
        where = f"{moves.value} (process {simulator.pid})"
        yield Row("link", "what moves", where, "", Verdict.OK)
        return
    yield Row("link", "what moves", moves.value, "", Verdict.OK)
    if rig.can is not None:
        bus = f"{rig.can.channel} ({rig.can.interface})"
        yield Row("link", "CAN", bus, "", Verdict.OK)
    if rig.ati_serial is not None:
        yield Row(
            "link", "serial", f"{rig.ati_serial.port}, {rig.ati_serial.baud} baud", "", Verdict.OK
        )
