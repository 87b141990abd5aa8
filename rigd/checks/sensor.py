"""What the sensor says of itself, and how quickly it answers."""

from collections.abc import Iterator, Mapping
from typing import Protocol, runtime_checkable

from rigd.checks.rows import Row, Verdict, grade
from rigd.checks.text import name_of, value_of
from rigd.devices.parameters import RigParameters

MEASURED_S = 1.0
_ROUNDING = 1.001
# Of a stream's rate: beyond what clocks differ by, and beyond what the filter's weights stand for.
_RATE_OFF, _RATE_WRONG = 0.01, 0.05

_UNSTATED = "not stated by the sensor"
_RANGES = ("range_n_nm", "range")
_SHOWN = ("sensor", "device", "serial_number", "part_number", "calibration")
_ALWAYS_SHOWN = ("firmware", "calibration_date")
_STATUS = "status"
_ASSUMED = "assumed"


@runtime_checkable
class MeasurableSensor(Protocol):
    """A sensor whose rate can be measured; simulated ones in this process have none."""

    def measure(self, duration_s: float) -> Mapping[str, float]:
        """Poll it, or watch its stream, for a while; the keys of the result end in their units."""


def calibration_rows(found: Mapping[str, object], rig: RigParameters) -> Iterator[Row]:
    """Show identity and calibration, and compare ranges with the profile's."""
    for key in _SHOWN:
        if key in found:
            yield Row("sensor", name_of(key), _value(key, found), _wanted(key, rig), Verdict.OK)
    for key in _ALWAYS_SHOWN:
        yield Row("sensor", name_of(key), _value(key, found), "", Verdict.OK)
    yield _range_row(found, rig.sensor.range)
    if found.get(_ASSUMED):
        yield Row(
            "sensor",
            "counts and units",
            "assumed, below",
            "told by the sensor",
            Verdict.WARNING,
            f"Sensor: assumed are {found[_ASSUMED]}; compare with its calibration certificate.",
        )
    status = found.get(_STATUS)
    if status is not None:
        yield Row(
            "sensor",
            "status",
            value_of(_STATUS, status),
            "none",
            grade(fail=False, warn=bool(status)),
        )
    more = [
        f"{name_of(key)} {value_of(key, value)}"
        for key, value in found.items()
        if key not in (*_SHOWN, *_ALWAYS_SHOWN, *_RANGES, _STATUS, _ASSUMED, "matrix")
        and value != ""
    ]
    if more:
        detail = f"Sensor: {'; '.join(more)}."
        yield Row("sensor", "more", f"{len(more)} values, below", "", Verdict.OK, detail)


def measured_rows(measured: Mapping[str, float], rig: RigParameters) -> Iterator[Row]:
    """Judge rate and turn-round of the sensor."""
    for key, value in measured.items():
        wanted, verdict = _judge(key, value, rig)
        yield Row("sensor", name_of(key), value_of(key, value), wanted, verdict)


def _value(key: str, found: Mapping[str, object]) -> str:
    value = found.get(key)
    return _UNSTATED if value in (None, "") else value_of(key, value)


def _wanted(key: str, rig: RigParameters) -> str:
    if key != "serial_number":
        return ""
    asked = rig.ati_can.serial_number if rig.ati_can else ""
    return asked or (rig.ati_serial.serial_number if rig.ati_serial else "") or "any"


def _range_row(found: Mapping[str, object], wanted: tuple[float, ...]) -> Row:
    limits = "profile: " + value_of("range_n_nm", wanted)
    key = next((key for key in _RANGES if key in found), "")
    rated = found.get(key)
    if not isinstance(rated, list | tuple):
        # Over CAN there is no request for it.
        return Row("sensor", "range", _UNSTATED, limits, Verdict.OK)
    beyond = any(ours > _ROUNDING * float(its) for ours, its in zip(wanted, rated, strict=True))
    return Row("sensor", "range", value_of("range_n_nm", rated), limits, grade(fail=beyond))


def _judge(key: str, value: float, rig: RigParameters) -> tuple[str, Verdict]:
    """Return what a measured value should be, and whether it is."""
    period_s = 1.0 / rig.rate_hz
    acquisition = rig.acquisition
    same_tick = acquisition is not None and acquisition.mode == "same_tick"
    patience_s = acquisition.deadline_us * 1e-6 if acquisition and same_tick else period_s
    patience = f"at most {patience_s * 1e3:.4g} ms"
    if key == "polls_hz":
        return f"at least {rig.rate_hz:g} Hz", grade(fail=not value >= rig.rate_hz)
    if key == "records_hz" and rig.ati_serial is not None:
        stated = rig.ati_serial.stream_hz
        off = abs(value / stated - 1.0)
        return f"{stated:g} Hz", grade(fail=not off <= _RATE_WRONG, warn=off > _RATE_OFF)
    if key == "turnaround_median_s":
        return patience, grade(fail=not value <= patience_s)
    if key == "turnaround_p99_s":
        return patience, grade(fail=False, warn=not value <= patience_s)
    if key == "longest_gap_s":
        return f"at most {period_s * 1e3:.4g} ms", grade(fail=False, warn=value > period_s)
    # Everything else is a count of what should not happen.
    return "0", grade(fail=False, warn=value > 0)
