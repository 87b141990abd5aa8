"""Touches of a recorded session: position, time and force of contacts of the antenna.

Detections of the control loop are marked in the samples. Without marks, the loop's own test runs
over the record: a session that was no search may have had contacts as well. Each touch is then
estimated as during a session (`rigd.touch`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf, pi, sqrt
from operator import itemgetter
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.record_checks import (
    RecordError,
    check_finite,
    check_sensor,
    check_span,
    stated_beam,
    stated_delay_s,
    stated_rate_hz,
    stated_tool_inertia_kg_m2,
    stated_torque_filter_s,
)
from analysis.validity import record_validity
from rigd.beam import Damping
from rigd.session import Session, SessionError, Validity, read_session, readable_texts
from rigd.session.layout import Status
from rigd.touch import (
    ChannelNoise,
    DetectorSettings,
    FreeBeam,
    SensorFilter,
    TouchDetector,
    TouchEstimator,
    TouchModel,
    TouchRecord,
    watched_beam,
)
from rigd.touch.samples import (
    CONTACT_S,
    FINAL_S,
    HISTORY_S,
    around_touch,
    base_shear_n,
    touch_record,
)
from rigd.view import nominal_damping

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path
    from typing import Any

    from numpy.typing import NDArray

    from rigd.touch import TouchEstimate

    Real = NDArray[np.float64]

_LEAST_BEFORE_S: Final = 0.3
_LEAST_AFTER_S: Final = 0.02
"""Least record around a detection for an estimate."""
_LEAST_REST_S: Final = 0.5
"""Beginning from which the test estimates the noise, if the file states no longer rest."""
_QUIET_S: Final = 0.5
"""Time without a detection after which the next one is another touch: the beam bounces."""
_MOST_OF_TICK: Final = 0.99
"""Filters of more than a hundred records a tick are treated as that."""
_MOST_FOUND: Final = 20
"""With more touches in a record that was no search the model does not fit."""
_MOST_OF_MODEL: Final = 5.0
"""Sum of squared residuals per degree of freedom from which the model is doubtful."""
_LEAST_NOISE: Final = 1e-9
_LEAST_QUIET: Final = 100
"""Number of samples for the fit of the vibration before a touch."""
_POINTS: Final = 41
"""Number of points along the antenna."""
_DESCRIPTIONS: Final = ("specimen.toml", "profile.toml")
"""Attachments with the damping; the first one that has it is used."""


@dataclass(frozen=True, slots=True)
class Touch:
    """Touch of a session with its estimate.

    Attributes
    ----------
    number
        From 1 on, in the order of time.
    tick
        Tick of the detection.
    noticed_s
        Its time, from the beginning of the estimate's record.
    angle_rad
        Angle of the motor at the touch.
    start_s
        Time of the estimate's record in the session.
    estimate
        Estimate; None, like the following ones, if the record around it is too short.
    antenna_m
        The bent antenna at the touch, seen from above with the motor's axis in (0, 0), shape
        (points, 2).
    point_m
        The point of contact there, shape (2,); None if it is not known.
    ends_m
        The ends of its 95 % interval, shape (2, 2); None likewise.
    """

    number: int
    tick: int
    noticed_s: float
    angle_rad: float
    start_s: float
    estimate: TouchEstimate | None = None
    antenna_m: Real | None = None
    point_m: Real | None = None
    ends_m: Real | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return the touch as a document of JSON types."""
        estimate = self.estimate
        point = None if self.point_m is None else self.point_m.tolist()
        return {
            "number": self.number,
            "tick": self.tick,
            "angle_rad": self.angle_rad,
            **({} if estimate is None else estimate.as_dict(self.start_s)),
            "point_m": point,
            "chi2_per_degree": None if estimate is None else estimate.chi2_per_degree,
        }


@dataclass(frozen=True, slots=True)
class TouchedSession:
    """A session with its touches.

    Attributes
    ----------
    path
        The file.
    touches
        In the order of time.
    found
        Source of the detections: ``loop``, during the session; ``record``, this analysis.
    model
        Beam of the estimates.
    rate_hz
        Ticks a second.
    has_shear
        Whether the file has the base shear.
    warnings
        Remarks on the result, in sentences.
    validity
        How exact the linear model is for the session.
    """

    path: Path
    touches: tuple[Touch, ...]
    found: str
    model: TouchModel
    rate_hz: float
    has_shear: bool
    warnings: tuple[str, ...]
    validity: Validity = field(default_factory=Validity)


class TouchAnalysis:
    """Detection and estimates of touches; one model serves several sessions.

    Parameters
    ----------
    model
        JSON document of ``analyze … --json`` with the beam to assume; None: the nominal beam of
        the profile that each file has attached.
    """

    def __init__(self, model: Path | None = None) -> None:
        self._model = model
        self._prepared: dict[tuple[object, ...], _Prepared] = {}

    def session(
        self, path: Path, on_step: Callable[[str], None] = lambda _: None
    ) -> TouchedSession:
        """Return the touches of a session.

        Parameters
        ----------
        path
            A session file.
        on_step
            Called with a few words when something begins that takes a second or more.

        Raises
        ------
        SessionError
            The file cannot be read, or lacks a key.
        RecordError
            Its samples cannot be analysed.
        IdentifiedBeamError
            The file of the model cannot be read, or holds none.
        """
        on_step("reading")
        session = read_session(path)
        samples = session.samples
        rate_hz = _checked_rate_hz(session)
        model = _model(session, rate_hz, self._model)
        shear = _shear_projection(session)
        warnings = []
        if shear is None:
            warnings.append(
                "The file states no shear_projection: the touches are estimated by the torque "
                "alone, which tells little of the instant and the point."
            )
        marked = samples["tick"][(samples["status"] & Status.TOUCHED) != 0].tolist()
        contact = round(CONTACT_S * rate_hz)
        free_from = [0, *(tick + contact for tick in marked)]
        found, detected = "loop", list(zip(marked, free_from, strict=False))
        if not marked:
            on_step("looking for touches")
            found, detected = "record", _detections(session, model, rate_hz, shear)
            if len(detected) > _MOST_FOUND:
                warnings.append(
                    f"More than {_MOST_FOUND} touches were found, of which the first are shown: "
                    "the model does not fit the record. Take an identified one (--model)."
                )
                detected = detected[:_MOST_FOUND]
        touches = []
        for number, (tick, free_from) in enumerate(detected, start=1):
            on_step(f"touch {number} of {len(detected)}")
            part = around_touch(samples, tick, rate_hz, free_from)
            touches.append(self._touch(part, number, tick, model, rate_hz, shear))
        warnings += _doubts(touches)
        validity = record_validity(
            readable_texts(session.metadata, "keys of the metadata")[0],
            samples["angle_rad"], rate_hz, (model.beam, model.damping),
        )  # fmt: skip
        return TouchedSession(
            path, tuple(touches), found, model, rate_hz, shear is not None, tuple(warnings),
            validity,
        )  # fmt: skip

    def _touch(
        self,
        part: NDArray[np.void],
        number: int,
        tick: int,
        model: TouchModel,
        rate_hz: float,
        shear: Sequence[float] | None,
    ) -> Touch:
        """Estimate a touch from the samples around it."""
        start_s = int(part["tick"][0]) / rate_hz
        record = touch_record(part, tick, rate_hz, shear)
        time_s = record.detected / rate_hz
        after_s = (record.angle_rad.size - 1 - record.detected) / rate_hz
        angles_rad = record.angle_rad
        if time_s < _LEAST_BEFORE_S or after_s < _LEAST_AFTER_S:
            return Touch(number, tick, time_s, float(angles_rad[record.detected]), start_s)
        prepared = self._prepared_for(model, rate_hz)
        estimate = prepared.estimator.estimate(record)
        if estimate.time_s is not None:
            time_s = estimate.time_s.value
        angle_rad = float(np.interp(time_s, np.arange(angles_rad.size) / rate_hz, angles_rad))
        x_m = prepared.free.x_m
        deflection_m = _deflection_m(prepared.free, record, time_s)
        point = ends = None
        if estimate.x_m is not None:
            along = np.array([estimate.x_m.value, *estimate.x_m.interval_95])
            there = _from_above(angle_rad, along, np.interp(along, x_m, deflection_m))
            point, ends = there[0], there[1:]
        return Touch(
            number,
            tick,
            record.detected / rate_hz,
            angle_rad,
            start_s,
            estimate,
            _from_above(angle_rad, x_m, deflection_m),
            point,
            ends,
        )

    def _prepared_for(self, model: TouchModel, rate_hz: float) -> _Prepared:
        key = (
            model.beam, model.damping, model.tool_inertia_kg_m2, model.angle_delay_s,
            model.torque_delay_s, model.sensor_filter, rate_hz,
        )  # fmt: skip
        if key not in self._prepared:
            x_m = np.linspace(0.0, model.beam.length_m, _POINTS)
            samples = round((HISTORY_S + FINAL_S) * rate_hz) + 1
            self._prepared[key] = _Prepared(
                TouchEstimator(model, rate_hz), FreeBeam(model, x_m, rate_hz, samples)
            )
        return self._prepared[key]


@dataclass(frozen=True, slots=True)
class _Prepared:
    """Prepared data for all touches of one model."""

    estimator: TouchEstimator
    free: FreeBeam


# What the file states


def _checked_rate_hz(session: Session) -> float:
    path, samples = session.path, session.samples
    if len(samples) == 0:
        raise RecordError(f"{path}: the session holds no samples, so there is nothing to analyse.")
    rate_hz = stated_rate_hz(session)
    ticks = samples["tick"].astype(np.int64)
    check_span(path, ticks)
    for name in ("angle_rad", "coupling_torque_nm"):
        check_finite(path, name, samples[name], ticks)
    check_sensor(path, samples["coupling_torque_nm"])
    return rate_hz


def _model(session: Session, rate_hz: float, path: Path | None) -> TouchModel:
    """Return the identified model, or the one in the file's attachments."""
    ticks = session.samples["tick"]
    beam = stated_beam(session, rate_hz, int(ticks[-1]) - int(ticks[0]) + 1)
    stated: dict[str, Any] = {
        key: stated_delay_s(session, key) for key in ("angle_delay_s", "torque_delay_s")
    }
    stated["sensor_filter"] = _sensor_filter(session, rate_hz)
    stated["tool_inertia_kg_m2"] = stated_tool_inertia_kg_m2(session)
    if path is not None:
        return TouchModel.from_analysis(path, length_m=beam.length_m, **stated)
    attached = (session.attachments.get(name, b"") for name in _DESCRIPTIONS)
    damping: Damping | None = next(filter(None, map(nominal_damping, attached)), None)
    if damping is None:
        raise SessionError(
            f"{session.path}: no profile.toml with [beam.damping] is attached, so the damping is "
            "not known. Identify the beam (analyze SESSION --json FILE), and give --model FILE."
        )
    return TouchModel.assumed(beam, damping, **stated)


def _sensor_filter(session: Session, rate_hz: float) -> SensorFilter:
    """Return the sensor's low-pass filter, and the one that forms samples of its records."""
    order, constant_s = max(enumerate(stated_torque_filter_s(session), start=1), key=itemgetter(1))
    corner_hz = 1 / (2 * pi * constant_s) if constant_s else 0.0
    kind = session.metadata.get("sensor_filter", "")
    if not kind:
        return SensorFilter(corner_hz, order)
    delay_s = session.number("sensor_filter_delay_s", 0.0)
    # A mean of n records of a tick is (n - 1) / 2n of a tick old, the triangle twice as much.
    fraction = delay_s * rate_hz * {"mean": 2.0, "triangle": 1.0}.get(kind, inf)
    if not 0.0 <= fraction < _MOST_OF_TICK:
        raise RecordError(
            f"{session.path}: sensor_filter is {kind[:100]!r} with sensor_filter_delay_s = "
            f"{delay_s:g} s, but must be a mean (shorter than half a period, {0.5 / rate_hz:g} s) "
            f"or a triangle (shorter than a period); correct the file's metadata."
        )
    records = round(1 / (1 - fraction))
    spacing_s = fraction / rate_hz / max(records - 1, 1)
    return SensorFilter.of_records(corner_hz, order, kind, records, spacing_s)


def _shear_projection(session: Session) -> tuple[float, ...] | None:
    text = session.metadata.get("shear_projection", "")
    if not text:
        return None
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != 6 or not np.isfinite(numbers).all():
        raise RecordError(
            f"{session.path}: shear_projection is {text[:100]!r}, but must be six numbers for fx, "
            "fy, fz, tx, ty, tz; correct the file's metadata."
        )
    return numbers if any(numbers) else None


# Detection


def _detections(
    session: Session, model: TouchModel, rate_hz: float, shear: Sequence[float] | None
) -> list[tuple[int, int]]:
    """Run the loop's test over the record.

    Returns
    -------
    list of tuple
        For each touch the tick of the detection, and the tick from which the beam was free before
        it.
    """
    samples = session.samples
    ticks = samples["tick"].astype(np.int64)
    torque_nm = samples["coupling_torque_nm"]
    shear_n = np.zeros(len(samples)) if shear is None else base_shear_n(samples, shear)
    rest = session.segments.get("rest", (0, 0))[1]
    judged = max(rest, int(ticks[0]) + round(_LEAST_REST_S * rate_hz))
    resting = ticks < judged
    noise = ChannelNoise(
        _noise(torque_nm[resting]),
        None if shear is None else _noise(shear_n[resting]),
        _angle_noise(samples["angle_rad"], resting),
    )
    beam = watched_beam(model, rate_hz, noise)
    detector = TouchDetector(beam, rate_hz, DetectorSettings())
    armed = False
    found: list[tuple[int, int]] = []
    quiet = round(_QUIET_S * rate_hz)
    last = int(ticks[0]) - quiet - 1
    before = int(ticks[0]) - 1
    columns = (
        ticks, samples["angle_rad"], torque_nm, shear_n,
        (samples["status"] & Status.ANGLE_STALE) != 0,
        (samples["status"] & Status.WRENCH_STALE) != 0,
    )  # fmt: skip
    for tick, angle, torque, force, angle_stale, wrench_stale in zip(
        *(column.tolist() for column in columns), strict=True
    ):
        if not armed and tick >= judged:
            detector.arm()
            armed = True
        if detector.step(
            angle, torque, force,
            missed=tick - before - 1, angle_stale=angle_stale, wrench_stale=wrench_stale,
        ):  # fmt: skip
            if tick - last > quiet:
                found.append((tick, last + 1))
            last = tick
        before = tick
    return found


def _noise(values: Real) -> float:
    """Return the standard deviation of white noise in values that otherwise change slowly."""
    steps = np.diff(values)
    return max(float(np.std(steps)) / sqrt(2), _LEAST_NOISE) if steps.size else _LEAST_NOISE


def _angle_noise(angle_rad: Real, resting: NDArray[np.bool_]) -> float:
    """Return the noise of the angle: its scatter at rest, or that of its resolution."""
    steps = np.abs(np.diff(angle_rad))
    steps = steps[steps > _LEAST_NOISE]
    resolution_rad = float(steps.min()) if steps.size else 0.0
    return max(_noise(angle_rad[resting]), resolution_rad / sqrt(12))


def _doubts(touches: Sequence[Touch]) -> list[str]:
    sentences = []
    short = [each.number for each in touches if each.estimate is None]
    if short:
        sentences.append(
            f"Touch {_listed(short)}: not estimated; it takes {_LEAST_BEFORE_S:g} s of record "
            f"before a touch and {1e3 * _LEAST_AFTER_S:g} ms after it."
        )
    poor = [
        each.number
        for each in touches
        if each.estimate is not None and each.estimate.chi2_per_degree > _MOST_OF_MODEL
    ]
    if poor:
        sentences.append(
            f"Touch {_listed(poor)}: the record is not explained by the model (residuals more than "
            f"{sqrt(_MOST_OF_MODEL):.1f} times the noise). Take an identified model (--model); "
            "without a contact, such a touch is the model's error."
        )
    return sentences


def _listed(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, numbers))


# Seen from above


def _deflection_m(free: FreeBeam, record: TouchRecord, time_s: float) -> Real:
    """Return the beam's deflection at a time relative to its root line, if it was free.

    Parameters
    ----------
    free
        Free motion at the points along the beam; the first is at the axis.
    record
        Record; the vibration is fitted to its samples before the time.
    time_s
        From the record's beginning.
    """
    quiet = min(max(int(time_s * record.rate_hz) - 1, _LEAST_QUIET), record.detected)
    motion = free.motion(record, quiet, quiet - 4)
    step = round((time_s - motion.first_s) / motion.step_s)
    moved: Real = motion.displacement_m[:, min(max(step, 0), motion.displacement_m.shape[1] - 1)]
    times_s = np.arange(record.angle_rad.size) / record.rate_hz
    return moved - float(np.interp(time_s, times_s, record.angle_rad)) * free.x_m


def _from_above(angle_rad: float, along_m: Real, across_m: Real) -> Real:
    """Return points of the bent beam in the plane, shape (points, 2), zero angle along x."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    return np.column_stack([cos * along_m - sin * across_m, sin * along_m + cos * across_m])
