"""What is wrong between the devices a profile names and the sections that describe them."""

from collections.abc import Iterator, Mapping
from typing import Any

from rigd.devices.ati.stream import RECORD_BITS
from rigd.devices.cia402.assignments import parse_assignment
from rigd.devices.cia402.requirements import ACCEPTABLE
from rigd.devices.parameters import AtiSerial
from rigd.profile.settings import WIRING, fields_of

_PER_MILLE_LIMIT = 32.767
"""Largest torque over rated torque that fits the 16 bits of object 6071."""
_ROUNDING = 1e-9


def contradictions(values: Mapping[str, Any]) -> Iterator[str]:
    """Yield what is wrong between values that are each in range."""
    absent = list(_sections(values))
    yield from absent
    if absent:
        return
    if "acquisition.mode" in values:
        yield from _acquisition(values)
    if "cia402.node_id" in values:
        yield from _drive(values)
    if "ati_serial.port" in values:
        yield from _serial(values)
    yield from _delays(values)


def _sections(values: Mapping[str, Any]) -> Iterator[str]:
    """Yield sections that the chosen devices lack, and those that nobody reads."""
    drive, sensor = values["devices.drive"], values["devices.sensor"]
    needed = {*WIRING.get(drive, ()), *WIRING.get(sensor, ())}
    present = {
        section
        for section in {name for names in WIRING.values() for name in names}
        if any(key in values for key, _ in fields_of(section))
    }
    for section in sorted(needed - present):
        yield (
            f'section [{section}] is missing, which devices.drive = "{drive}" with '
            f'devices.sensor = "{sensor}" needs.'
        )
    # Noise and offset of a rig that can also be simulated are welcome in any profile.
    for section in sorted(present - needed - {"simulation"}):
        yield (
            f'section [{section}] belongs to none of devices.drive = "{drive}" and '
            f'devices.sensor = "{sensor}"; remove it.'
        )


def _acquisition(values: Mapping[str, Any]) -> Iterator[str]:
    period_us = 1e6 / values["rig.rate_hz"]
    deadline_us = values["acquisition.deadline_us"]
    if deadline_us >= period_us:
        yield (
            f"acquisition.deadline_us = {deadline_us:g} µs is not below the period of "
            f"{period_us:g} µs; choose a half of it or less."
        )


def _drive(values: Mapping[str, Any]) -> Iterator[str]:
    if values["cia402.direction"] == 0:
        yield "cia402.direction = 0 must be 1, or -1 where the drive turns the other way round."
    if values["cia402.host_node_id"] == values["cia402.node_id"]:
        yield (
            f"cia402.host_node_id = {values['cia402.host_node_id']} is the drive's own "
            "cia402.node_id; choose another."
        )
    speed, limit = values["cia402.max_speed_rad_s"], values["limits.velocity_rad_s"]
    if 0 < speed < limit:
        yield (
            f"cia402.max_speed_rad_s = {speed:g} rad/s is below limits.velocity_rad_s = {limit:g} "
            "rad/s; the drive would hold back torques that a session may ask for. Choose a quarter "
            "more than the limit, or 0 to leave what the drive has."
        )
    ratio = values["motor.peak_torque_nm"] / values["motor.rated_torque_nm"]
    if ratio > _PER_MILLE_LIMIT:
        yield (
            f"motor.peak_torque_nm is {ratio:g} times motor.rated_torque_nm; the drive's target "
            f"torque reaches {_PER_MILLE_LIMIT:g} times."
        )
    for whose in ("", "drive_"):
        period, timeout = f"cia402.{whose}heartbeat_period_s", f"cia402.{whose}heartbeat_timeout_s"
        for key in (period, timeout):
            if abs(values[key] * 1000 - round(values[key] * 1000)) > 1e-6 or values[key] < 1e-3:
                yield f"{key} = {values[key]:g} s must be a whole number of milliseconds."
        if values[timeout] < 2 * values[period]:
            yield (
                f"{timeout} = {values[timeout]:g} s is below twice {period} = "
                f"{values[period]:g} s; a single late heartbeat would end a session."
            )

    for number, text in enumerate(values["cia402.set_objects"]):
        try:
            parse_assignment(text)
        except ValueError as error:
            yield f'cia402.set_objects[{number}] = "{text}" {error}.'
    for number, name in enumerate(values["cia402.accept_without"]):
        if name not in ACCEPTABLE:
            yield (
                f'cia402.accept_without[{number}] = "{name}" is nothing that a profile can accept '
                f"the absence of; choose {', '.join(ACCEPTABLE)}."
            )


def _serial(values: Mapping[str, Any]) -> Iterator[str]:
    if values["acquisition.mode"] != "same_tick":
        yield (
            'acquisition.mode = "previous_tick" does not go with [ati_serial]: a sensor that '
            'streams is not asked, so there is no reply of the tick before; choose "same_tick".'
        )
    baud, stream_hz = values["ati_serial.baud"], values["ati_serial.stream_hz"]
    most_hz = baud / RECORD_BITS
    if stream_hz > most_hz:
        yield (
            f"ati_serial.stream_hz = {stream_hz:g} Hz does not fit ati_serial.baud = {baud}, which "
            f"carries {most_hz:.0f} records a second; choose 1250000."
        )
    if stream_hz < values["rig.rate_hz"]:
        yield (
            f"ati_serial.stream_hz = {stream_hz:g} Hz is below rig.rate_hz = "
            f"{values['rig.rate_hz']:g} Hz; there would be ticks without a record."
        )


def _delays(values: Mapping[str, Any]) -> Iterator[str]:
    """Yield delays that are shorter than what the protocol alone costs."""
    period_s = 1 / values["rig.rate_hz"]
    reply_s = period_s if values.get("acquisition.mode") == "previous_tick" else 0.0
    wrench_s, wrench_cause = reply_s, "the reply of the previous tick"
    if "ati_serial.port" in values:
        serial = AtiSerial(**{field: values[key] for key, field in fields_of("ati_serial")})
        wrench_s = serial.filter_delay_s(values["rig.rate_hz"])
        wrench_cause = "the filter of the sensor's records"
    delivery_s = period_s if values.get("cia402.torque_delivery") == "at_sync" else 0.0
    causes = (
        ("encoder.delay_s", reply_s, "the reply of the previous tick"),
        ("sensor.delay_s", wrench_s, wrench_cause),
        ("actuation.delay_s", delivery_s, "a torque that takes effect at the next SYNC"),
    )
    for key, least_s, cause in causes:
        if values[key] < least_s - _ROUNDING:
            yield (
                f"{key} = {values[key]:g} s is less than {cause} alone: at least {least_s:.6g} s."
            )
