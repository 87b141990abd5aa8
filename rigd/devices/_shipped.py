"""Declarations of the devices that come with rigd; a driver is imported when it is opened."""

import importlib
from collections.abc import Iterator, Mapping
from dataclasses import fields
from typing import Any, Final

from rigd.devices.contracts import Devices, WrenchSensor
from rigd.devices.declaration import DeviceKind, OpenedDrive
from rigd.devices.parameters import AtiCan, AtiSerial, RigParameters, ServoDrive

_MAX_RATIO_TO_RATED_TORQUE = 32.767
"""Largest ratio of torque to rated torque that the 16 bits of object 6071 can hold."""
_MAX_DELAY_ROUNDING_S = 1e-9
"""Largest rounding error in seconds of a delay in a profile."""


# Simulation in this process


def _open_simulated_drive(rig: RigParameters) -> OpenedDrive:
    """Create the simulated rig, and return its drive."""
    # Only the name of a profile leads to the simulation.
    devices: Devices = importlib.import_module("rigd.sim._devices").open_simulated_rig(rig)
    return OpenedDrive(
        rig,
        devices.drive,
        simulated=True,
        renew_noise=devices.renew_noise,
        simulated_sensor=devices.sensor,
    )


def _simulated_sensor(_rig: RigParameters, opened_drive: OpenedDrive) -> WrenchSensor:
    """Return the sensor of the simulated rig."""
    assert opened_drive.simulated_sensor is not None
    return opened_drive.simulated_sensor


# CiA 402 drive, and ATI sensors with it


def _open_wired_drive(rig: RigParameters) -> OpenedDrive:
    """Create the CiA 402 drive."""
    from rigd.devices._wired_drive import open_wired_drive

    return open_wired_drive(rig)


def _open_can_sensor(rig: RigParameters, opened_drive: OpenedDrive) -> WrenchSensor:
    """Create the ATI sensor on the bus of the drive."""
    from rigd.devices.ati import AtiCanSensor

    return AtiCanSensor(rig, opened_drive.line.can_link)


def _open_serial_sensor(rig: RigParameters, opened_drive: OpenedDrive) -> WrenchSensor:
    """Create the ATI sensor on the rig's serial line, or on that of the drive's simulator."""
    from rigd.devices.ati import AtiSerialSensor

    return AtiSerialSensor(rig, opened_drive.line.simulator)


def _drive_address(rig: RigParameters) -> str:
    """Return bus and node of the CiA 402 drive."""
    assert rig.can is not None
    assert rig.cia402 is not None
    return f"{rig.can.interface} {rig.can.channel}, node {rig.cia402.node_id}"


def _serial_address(rig: RigParameters) -> str:
    """Return serial port and bit rate of the ATI sensor."""
    assert rig.ati_serial is not None
    return f"{rig.ati_serial.port}, {rig.ati_serial.baud} baud"


def _serial_stream_hz(rig: RigParameters) -> float:
    """Return the number of records per second that the sensor sends on the serial line."""
    assert rig.ati_serial is not None
    return rig.ati_serial.stream_hz


def _serial_metadata(rig: RigParameters) -> dict[str, str]:
    """Return session metadata: the filter by which the sensor's records are decimated."""
    assert rig.ati_serial is not None
    return {
        "sensor_filter": rig.ati_serial.filter,
        "sensor_filter_delay_s": repr(rig.ati_serial.filter_delay_s(rig.rate_hz)),
    }


def _drive_contradictions(profile_values: Mapping[str, Any]) -> Iterator[str]:
    """Yield messages for contradictions in the settings of a CiA 402 drive."""
    from rigd.devices.cia402 import parse_assignment
    from rigd.devices.cia402.requirements import ACCEPTABLE_MISSING_FUNCTIONS

    if profile_values["cia402.direction"] == 0:
        yield "cia402.direction = 0 must be 1, or -1 where the drive turns the other way round."
    if profile_values["cia402.host_node_id"] == profile_values["cia402.node_id"]:
        yield (
            f"cia402.host_node_id = {profile_values['cia402.host_node_id']} is the drive's own "
            "cia402.node_id; choose another."
        )
    max_speed_rad_s, speed_limit_rad_s = (
        profile_values["cia402.max_speed_rad_s"],
        profile_values["limits.velocity_rad_s"],
    )
    if 0 < max_speed_rad_s < speed_limit_rad_s:
        yield (
            f"cia402.max_speed_rad_s = {max_speed_rad_s:g} rad/s is below limits.velocity_rad_s = "
            f"{speed_limit_rad_s:g} rad/s; the drive would limit torques that a session may need. "
            "Choose a quarter more than the limit, or 0 to leave the drive's own value."
        )
    peak_to_rated_torque = (
        profile_values["motor.peak_torque_nm"] / profile_values["motor.rated_torque_nm"]
    )
    if peak_to_rated_torque > _MAX_RATIO_TO_RATED_TORQUE:
        yield (
            f"motor.peak_torque_nm is {peak_to_rated_torque:g} times motor.rated_torque_nm; the "
            f"drive's target torque reaches {_MAX_RATIO_TO_RATED_TORQUE:g} times."
        )
    for key_prefix in ("", "drive_"):
        period_text, timeout_text = (
            f"cia402.{key_prefix}heartbeat_period_s",
            f"cia402.{key_prefix}heartbeat_timeout_s",
        )
        for key in (period_text, timeout_text):
            if (
                abs(profile_values[key] * 1000 - round(profile_values[key] * 1000)) > 1e-6
                or profile_values[key] < 1e-3
            ):
                yield f"{key} = {profile_values[key]:g} s must be a whole number of milliseconds."
        if profile_values[timeout_text] < 2 * profile_values[period_text]:
            yield (
                f"{timeout_text} = {profile_values[timeout_text]:g} s is below twice {period_text} "
                f"= {profile_values[period_text]:g} s; a single late heartbeat would end a session."
            )

    for entry_number, entry_text in enumerate(profile_values["cia402.set_objects"]):
        try:
            parse_assignment(entry_text)
        except ValueError as error:
            yield f'cia402.set_objects[{entry_number}] = "{entry_text}" {error}.'
    for entry_number, key_name in enumerate(profile_values["cia402.accept_without"]):
        if key_name not in ACCEPTABLE_MISSING_FUNCTIONS:
            yield (
                f'cia402.accept_without[{entry_number}] = "{key_name}" is not a '
                "feature whose absence a profile can accept; "
                f"choose {', '.join(ACCEPTABLE_MISSING_FUNCTIONS)}."
            )


def _serial_contradictions(profile_values: Mapping[str, Any]) -> Iterator[str]:
    """Yield messages for contradictions in the settings of a sensor on a serial line."""
    from rigd.devices.ati import RECORD_BITS

    if profile_values["acquisition.mode"] != "same_tick":
        yield (
            'acquisition.mode = "previous_tick" cannot be used with [ati_serial]: a sensor that '
            "streams gets no requests, so there is no reply to the previous tick; choose "
            '"same_tick".'
        )
    baud, stream_hz = profile_values["ati_serial.baud"], profile_values["ati_serial.stream_hz"]
    max_records_hz = baud / RECORD_BITS
    if stream_hz > max_records_hz:
        yield (
            f"ati_serial.stream_hz = {stream_hz:g} Hz does not fit ati_serial.baud = {baud}, which "
            f"carries {max_records_hz:.0f} records a second; choose 1250000."
        )
    if stream_hz < profile_values["rig.rate_hz"]:
        yield (
            f"ati_serial.stream_hz = {stream_hz:g} Hz is below rig.rate_hz = "
            f"{profile_values['rig.rate_hz']:g} Hz; some ticks would have no record."
        )
    settings = AtiSerial(
        **{each.name: profile_values[f"ati_serial.{each.name}"] for each in fields(AtiSerial)}
    )
    delay_s = profile_values["sensor.delay_s"]
    min_delay_s = settings.filter_delay_s(profile_values["rig.rate_hz"])
    if delay_s < min_delay_s - _MAX_DELAY_ROUNDING_S:
        yield (
            f"sensor.delay_s = {delay_s:g} s is less than the filter of the sensor's records "
            f"alone: at least {min_delay_s:.6g} s."
        )


SHIPPED: Final = {
    kind.name: kind
    for kind in (
        DeviceKind(
            "sim",
            "rig simulated in the process",
            open_drive=_open_simulated_drive,
            open_sensor=_simulated_sensor,
            sections=("simulation",),
            drives=("sim",),
            in_process=True,
        ),
        DeviceKind(
            "cia402",
            "drive on CANopen in cyclic synchronous torque mode",
            open_drive=_open_wired_drive,
            settings=ServoDrive,
            sections=("can", "acquisition"),
            address=_drive_address,
            contradictions=_drive_contradictions,
        ),
        DeviceKind(
            "ati_can",
            "ATI sensor with a NETCANOEM box on the drive's bus",
            open_sensor=_open_can_sensor,
            settings=AtiCan,
            sections=("can", "acquisition"),
            drives=("cia402",),
        ),
        DeviceKind(
            "ati_serial",
            "ATI Digital F/T sensor on a serial line",
            open_sensor=_open_serial_sensor,
            settings=AtiSerial,
            sections=("acquisition",),
            drives=("cia402",),
            address=_serial_address,
            stream_hz=_serial_stream_hz,
            contradictions=_serial_contradictions,
            metadata=_serial_metadata,
        ),
    )
}
"""Devices that come with rigd, by their names in a profile."""
