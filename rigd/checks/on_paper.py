"""What a profile alone shows: assumed numbers, identifiers that meet, lines that are too slow."""

from collections.abc import Iterator

from rigd.checks.rows import Row, Verdict, grade
from rigd.devices.ati.stream import RECORD_BITS
from rigd.devices.canbus.identifiers import check_identifiers
from rigd.devices.canbus.load import MAX_LOAD, BusLoad, bus_load
from rigd.devices.parameters import AtiSerial, RigParameters
from rigd.profile import Profile

HIGH_LOAD = 0.7
"""Above, one more device does not fit, nor do repeated frames after a disturbance."""


def profile_rows(profile: Profile) -> Iterator[Row]:
    """Say which profile it is, and which of its numbers nobody has verified."""
    yield Row("profile", profile.name, str(profile.path), "", Verdict.OK)
    assumed = [key for key, source in profile.sources.items() if source == "assumed"]
    yield Row(
        "profile",
        "numbers assumed",
        f"{len(assumed)} of {len(profile.sources)}",
        "none",
        grade(fail=False, warn=bool(assumed)),
        f"Assumed: {', '.join(assumed)}." if assumed else "",
    )


def wiring_rows(rig: RigParameters) -> Iterator[Row]:
    """Judge identifiers and load of what the profile connects."""
    if rig.can is not None:
        collisions = check_identifiers(rig)
        for collision in collisions:
            yield Row("CAN bus", "identifiers", collision, "no collision", Verdict.FAIL)
        if not collisions:
            yield Row("CAN bus", "identifiers", "no collision", "no collision", Verdict.OK)
        yield _bus_row(bus_load(rig), rig.can.bitrate_bit_s)
    if rig.ati_serial is not None:
        yield _line_row(rig.ati_serial)


def _bus_row(load: BusLoad, bitrate_bit_s: int) -> Row:
    frames = ", ".join(
        f"{t.what} ({t.can_id:#05x}, {t.length} bytes, {t.rate_hz:g} Hz)" for t in load.traffic
    )
    return Row(
        "CAN bus",
        "load",
        f"{100 * load.worst:.1f} % at worst, {100 * load.plain:.1f} % without stuffing",
        f"at most {100 * MAX_LOAD:.0f} %",
        grade(fail=load.worst > MAX_LOAD, warn=load.worst > HIGH_LOAD),
        f"At {bitrate_bit_s / 1e3:g} kbit/s: {frames}.",
    )


def _line_row(serial: AtiSerial) -> Row:
    load = RECORD_BITS * serial.stream_hz / serial.baud
    return Row(
        "serial line",
        "load",
        f"{100 * load:.1f} % of {serial.baud} bit/s",
        f"at most {100 * MAX_LOAD:.0f} %",
        grade(fail=load > MAX_LOAD),
    )
