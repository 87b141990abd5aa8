"""Touches of a recorded session: position, time and force of contacts of the antenna.

The control loop marks its detections in the samples. Without such marks, the loop's test is applied
to the record, because a session that was no search may have had contacts, too. Each touch is then
estimated as during a session (`rigd.touch`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
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
    stated_tip_mass_kg,
    stated_tool_inertia_kg_m2,
    stated_torque_filter_s,
)
from analysis.validity import record_validity
from rigd.beam import Damping, Plant
from rigd.session import Session, SessionError, Validity, read_session, readable_texts
from rigd.session.layout import Status
from rigd.sweep_response import nominal_damping
from rigd.touch import (
    ChannelNoise,
    DetectorSettings,
    FreeBeam,
    SensorFilter,
    TouchDetector,
    TouchEstimator,
    TouchModel,
    TouchRecord,
    detector_model,
)
from rigd.touch.samples import (
    FINAL_ESTIMATE_S,
    MAX_CONTACT_S,
    RECORD_BEFORE_DETECTION_S,
    around_touch,
    base_shear_n,
    touch_record,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path
    from typing import Any

    from numpy.typing import NDArray

    from rigd.touch import TouchEstimate

    RealArray = NDArray[np.float64]

_MIN_RECORD_BEFORE_TOUCH_S: Final = 0.3
"""Least duration that must be recorded before a detection for an estimate of the touch."""
_MIN_RECORD_AFTER_TOUCH_S: Final = 0.02
"""Least duration that must be recorded after a detection for an estimate of the touch."""
_MIN_REST_DURATION_S: Final = 0.5
"""Least duration of rest at the start of a record, from which the noise is estimated."""
_MIN_PAUSE_BETWEEN_TOUCHES_S: Final = 0.5
"""Pause between two detections from which they count as different touches: the beam may bounce."""
_MAX_SENSOR_FILTER_TICKS: Final = 0.99
"""Longest span in ticks of the filter that averages sensor records: that of 100 in a tick."""
_MAX_TOUCHES: Final = 20
"""Largest number of touches found in a record; with more, the model does not fit the record."""
_LARGEST_CHI2_PER_DEGREE: Final = 5.0
"""Sum of squared residuals per degree of freedom above which the model is doubtful."""
_MIN_NOISE_STD: Final = 1e-9
"""Least standard deviation of a channel's noise."""
_MIN_FIT_SAMPLES: Final = 100
"""Least number of samples for the fit of the vibration before a touch."""
_ANTENNA_POINTS: Final = 41
"""Number of points along the antenna at which its deflection is computed."""
_DAMPING_ATTACHMENTS: Final = ("specimen.toml", "profile.toml")
"""Attachments of a session file that may state the damping, in the order of preference."""


@dataclass(frozen=True, slots=True)
class Touch:
    """Contact of the antenna during a session, with the estimate of its position and time.

    Attributes
    ----------
    number
        Number of the touch, from 1, in the order of time.
    tick
        Tick of the detection.
    detection_time_s
        Time of the detection after the start of the record used for the estimate.
    angle_rad
        Motor angle at the touch.
    start_s
        Time in the session at which the record used for the estimate starts.
    estimate
        Estimate of the touch. It is None, like the following attributes, if the record around the
        touch is too short.
    antenna_points_m
        Points of the bent antenna at the touch, seen from above with the motor's axis at (0, 0),
        shape (points, 2).
    contact_point_m
        Point of contact in this plane, shape (2,); None if it is not known.
    interval_ends_m
        Ends of the 95 % interval of the point of contact, shape (2, 2); None if it is not known.
    """

    number: int
    tick: int
    detection_time_s: float
    angle_rad: float
    start_s: float
    estimate: TouchEstimate | None = None
    antenna_points_m: RealArray | None = None
    contact_point_m: RealArray | None = None
    interval_ends_m: RealArray | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return the touch and its estimate as a JSON document."""
        estimate = self.estimate
        contact_point = None if self.contact_point_m is None else self.contact_point_m.tolist()
        return {
            "number": self.number,
            "tick": self.tick,
            "angle_rad": self.angle_rad,
            **({} if estimate is None else estimate.as_dict(self.start_s)),
            "point_m": contact_point,
            "chi2_per_degree": None if estimate is None else estimate.chi2_per_degree,
        }


@dataclass(frozen=True, slots=True)
class SessionTouches:
    """Touches found in one session.

    Attributes
    ----------
    path
        Session file.
    touches
        Touches in the order of time.
    detection_source
        Where touches were detected: in the control ``loop``, or in the ``record`` by this analysis.
    model
        Model of the beam used for the estimates.
    rate_hz
        Ticks per second.
    has_shear
        Whether the file has the base shear force.
    warnings
        Sentences on restrictions of the result.
    validity
        Validity of the linear model for the session.
    """

    path: Path
    touches: tuple[Touch, ...]
    detection_source: str
    model: TouchModel
    rate_hz: float
    has_shear: bool
    warnings: tuple[str, ...]
    validity: Validity = field(default_factory=Validity)


class TouchAnalysis:
    """Detection and estimation of touches in sessions, with one model for several sessions.

    Parameters
    ----------
    model_path
        JSON document of ``analyze … --json`` with the beam to assume. With None, the nominal beam
        of the profile attached to each file is used.
    """

    def __init__(self, model_path: Path | None = None) -> None:
        self._model = model_path
        self._prepared: dict[tuple[object, ...], _PreparedModel] = {}

    def analyse_session(
        self, path: Path, on_step: Callable[[str], None] = lambda _: None
    ) -> SessionTouches:
        """Return the touches of a session.

        Parameters
        ----------
        path
            Session file.
        on_step
            Called with the name of a step before each step that takes a second or more.

        Raises
        ------
        SessionError
            The file cannot be read, or lacks a key.
        RecordError
            The samples of the file cannot be analysed.
        IdentifiedBeamError
            The model file cannot be read, or contains no model.
        """
        on_step("reading")
        session = read_session(path)
        samples = session.samples
        rate_hz = _check_samples(session)
        touch_model = _touch_model(session, rate_hz, self._model)
        shear_coefficients = _shear_projection(session)
        warnings = []
        if shear_coefficients is None:
            warnings.append(
                "The file states no shear_projection: the touches are estimated from the torque "
                "alone, which determines instant and point poorly."
            )
        flagged_ticks = samples["tick"][(samples["status"] & Status.TOUCHED) != 0].tolist()
        contact_ticks = round(MAX_CONTACT_S * rate_hz)
        first_free_ticks = [
            0,
            *(detection_tick + contact_ticks for detection_tick in flagged_ticks),
        ]
        detection_source, detected_ticks = (
            "loop",
            list(zip(flagged_ticks, first_free_ticks, strict=False)),
        )
        if not flagged_ticks:
            on_step("searching for touches")
            detection_source, detected_ticks = (
                "record",
                _detect_touches(session, touch_model, rate_hz, shear_coefficients),
            )
            if len(detected_ticks) > _MAX_TOUCHES:
                warnings.append(
                    f"More than {_MAX_TOUCHES} touches were found, of which the first are shown: "
                    "the model does not fit the record. Use an identified one (--model)."
                )
                detected_ticks = detected_ticks[:_MAX_TOUCHES]
        touches = []
        for touch_number, (detection_tick, free_tick) in enumerate(detected_ticks, start=1):
            on_step(f"touch {touch_number} of {len(detected_ticks)}")
            touch_samples = around_touch(samples, detection_tick, rate_hz, free_tick)
            touches.append(
                self._estimate_touch(
                    touch_samples,
                    touch_number,
                    detection_tick,
                    touch_model,
                    rate_hz,
                    shear_coefficients,
                )
            )
        warnings += _describe_doubts(touches)
        validity = record_validity(
            readable_texts(session.metadata, "keys of the metadata")[0],
            samples["angle_rad"], rate_hz, touch_model.plant,
        )  # fmt: skip
        return SessionTouches(
            path, tuple(touches), detection_source, touch_model, rate_hz,
            shear_coefficients is not None, tuple(warnings), validity,
        )  # fmt: skip

    def _estimate_touch(
        self,
        touch_samples: NDArray[np.void],
        touch_number: int,
        detection_tick: int,
        touch_model: TouchModel,
        rate_hz: float,
        shear_coefficients: Sequence[float] | None,
    ) -> Touch:
        """Return a touch with its estimate from the samples around its detection."""
        start_s = int(touch_samples["tick"][0]) / rate_hz
        record_around_touch = touch_record(
            touch_samples, detection_tick, rate_hz, shear_coefficients
        )
        touch_time_s = record_around_touch.detection_index / rate_hz
        recorded_after_s = (
            record_around_touch.angle_rad.size - 1 - record_around_touch.detection_index
        ) / rate_hz
        angles_rad = record_around_touch.angle_rad
        if (
            touch_time_s < _MIN_RECORD_BEFORE_TOUCH_S
            or recorded_after_s < _MIN_RECORD_AFTER_TOUCH_S
        ):
            return Touch(
                touch_number,
                detection_tick,
                touch_time_s,
                float(angles_rad[record_around_touch.detection_index]),
                start_s,
            )
        prepared_model = self._prepare_model(touch_model, rate_hz)
        touch_estimate = prepared_model.estimator.estimate(record_around_touch)
        if touch_estimate.time_s is not None:
            touch_time_s = touch_estimate.time_s.value
        angle_rad = float(np.interp(touch_time_s, np.arange(angles_rad.size) / rate_hz, angles_rad))
        x_m = prepared_model.free_beam.x_m
        deflection_m = _free_deflection_m(
            prepared_model.free_beam, record_around_touch, touch_time_s
        )
        contact_point_m = interval_ends_m = None
        if touch_estimate.x_m is not None:
            positions_m = np.array([touch_estimate.x_m.value, *touch_estimate.x_m.interval_95])
            contact_points = _top_view(
                angle_rad, positions_m, np.interp(positions_m, x_m, deflection_m)
            )
            contact_point_m, interval_ends_m = contact_points[0], contact_points[1:]
        return Touch(
            touch_number,
            detection_tick,
            record_around_touch.detection_index / rate_hz,
            angle_rad,
            start_s,
            touch_estimate,
            _top_view(angle_rad, x_m, deflection_m),
            contact_point_m,
            interval_ends_m,
        )

    def _prepare_model(self, touch_model: TouchModel, rate_hz: float) -> _PreparedModel:
        """Return touch estimator and freely moving beam of a model, made at the first use."""
        cache_key = (
            touch_model.plant,
            touch_model.angle_delay_s,
            touch_model.sensor_filter,
            rate_hz,
        )
        if cache_key not in self._prepared:
            x_m = np.linspace(0.0, touch_model.plant.beam.length_m, _ANTENNA_POINTS)
            sample_count = round((RECORD_BEFORE_DETECTION_S + FINAL_ESTIMATE_S) * rate_hz) + 1
            self._prepared[cache_key] = _PreparedModel(
                TouchEstimator(touch_model, rate_hz),
                FreeBeam(touch_model, x_m, rate_hz, sample_count),
            )
        return self._prepared[cache_key]


@dataclass(frozen=True, slots=True)
class _PreparedModel:
    """Touch estimator and freely moving beam of one model, made once for all touches."""

    estimator: TouchEstimator
    free_beam: FreeBeam


# What the file states


def _check_samples(session: Session) -> float:
    """Return the sampling rate of a session; raise if its samples cannot be analysed."""
    path, samples = session.path, session.samples
    if len(samples) == 0:
        raise RecordError(f"{path}: the session holds no samples, so there is nothing to analyse.")
    rate_hz = stated_rate_hz(session)
    ticks = samples["tick"].astype(np.int64)
    check_span(path, ticks)
    for field_name in ("angle_rad", "coupling_torque_nm"):
        check_finite(path, field_name, samples[field_name], ticks)
    check_sensor(path, samples["coupling_torque_nm"])
    return rate_hz


def _touch_model(session: Session, rate_hz: float, model_path: Path | None) -> TouchModel:
    """Return the beam model with which the touches of a session are estimated.

    It is the identified model in the file `model_path`, or else the nominal model of the session.
    Raise `RecordError` if the session states a mass at the tip, which no model of touches has.
    """
    if tip_mass_kg := stated_tip_mass_kg(session):
        raise RecordError(
            f"{session.path}: tip_mass_kg = {tip_mass_kg:.4g} kg: the estimation of touches does "
            "not take a mass at the tip into account; take it off, remove beam.tip_mass_kg from "
            "the profile, and record again."
        )
    ticks = session.samples["tick"]
    beam = stated_beam(session, rate_hz, int(ticks[-1]) - int(ticks[0]) + 1)
    angle_delay_s = stated_delay_s(session, "angle_delay_s")
    undamped_plant = Plant(
        beam,
        Damping(),
        delay_s=stated_delay_s(session, "torque_delay_s") - angle_delay_s,
        tool_inertia_kg_m2=stated_tool_inertia_kg_m2(session),
    )
    sensor_filter = _sensor_filter(session, rate_hz)
    if model_path is not None:
        return TouchModel.from_analysis(model_path, undamped_plant, angle_delay_s, sensor_filter)
    attached_files = (
        session.attachments.get(attachment_name, b"") for attachment_name in _DAMPING_ATTACHMENTS
    )
    damping: Damping | None = next(filter(None, map(nominal_damping, attached_files)), None)
    if damping is None:
        raise SessionError(
            f"{session.path}: no profile.toml with [beam.damping] is attached, so the damping is "
            "not known. Identify the beam (analyze SESSION --json FILE), and give --model FILE."
        )
    return TouchModel.with_assumed_uncertainty(
        replace(undamped_plant, damping=damping), angle_delay_s, sensor_filter
    )


def _sensor_filter(session: Session, rate_hz: float) -> SensorFilter:
    """Return the filters of the sensor, as a session states them.

    These are its low-pass filter and, if stated, the filter that averages several sensor records in
    each tick.
    """
    filter_order, time_constant_s = max(
        enumerate(stated_torque_filter_s(session), start=1), key=itemgetter(1)
    )
    corner_hz = 1 / (2 * pi * time_constant_s) if time_constant_s else 0.0
    filter_kind = session.metadata.get("sensor_filter", "")
    if not filter_kind:
        return SensorFilter(corner_hz, filter_order)
    delay_s = session.number("sensor_filter_delay_s", 0.0)
    # A mean of n records per tick has a delay of (n - 1) / 2n ticks, a triangle twice as much.
    delay_fraction = delay_s * rate_hz * {"mean": 2.0, "triangle": 1.0}.get(filter_kind, inf)
    if not 0.0 <= delay_fraction < _MAX_SENSOR_FILTER_TICKS:
        raise RecordError(
            f"{session.path}: sensor_filter is {filter_kind[:100]!r} with sensor_filter_delay_s "
            f"= {delay_s:g} s, but must be a mean (shorter than half a period, {0.5 / rate_hz:g} "
            "s) or a triangle (shorter than a period); correct the file's metadata."
        )
    averaged_record_count = round(1 / (1 - delay_fraction))
    record_spacing_s = delay_fraction / rate_hz / max(averaged_record_count - 1, 1)
    return SensorFilter.for_records(
        corner_hz, filter_order, filter_kind, averaged_record_count, record_spacing_s
    )


def _shear_projection(session: Session) -> tuple[float, ...] | None:
    """Return the six coefficients of the base shear force as a sum of fx, fy, fz, tx, ty, tz.

    These are the forces and torques of the sensor. Return None if the session states no
    coefficients or only zeros.
    """
    projection_text = session.metadata.get("shear_projection", "")
    if not projection_text:
        return None
    try:
        coefficients = tuple(float(number_text) for number_text in projection_text.split(","))
    except ValueError:
        coefficients = ()
    if len(coefficients) != 6 or not np.isfinite(coefficients).all():
        raise RecordError(
            f"{session.path}: shear_projection is {projection_text[:100]!r}, but must be six "
            "numbers for fx, fy, fz, tx, ty, tz; correct the file's metadata."
        )
    return coefficients if any(coefficients) else None


# Detection


def _detect_touches(
    session: Session,
    touch_model: TouchModel,
    rate_hz: float,
    shear_coefficients: Sequence[float] | None,
) -> list[tuple[int, int]]:
    """Detect touches by applying the control loop's test to a record.

    Return for each touch the tick of its detection, and the earlier tick from which the beam was
    free.
    """
    samples = session.samples
    ticks = samples["tick"].astype(np.int64)
    torque_nm = samples["coupling_torque_nm"]
    shear_n = (
        np.zeros(len(samples))
        if shear_coefficients is None
        else base_shear_n(samples, shear_coefficients)
    )
    rest_end_tick = session.segments.get("rest", (0, 0))[1]
    noise_end_tick = max(rest_end_tick, int(ticks[0]) + round(_MIN_REST_DURATION_S * rate_hz))
    is_at_rest = ticks < noise_end_tick
    channel_noise = ChannelNoise(
        _white_noise_std(torque_nm[is_at_rest]),
        None if shear_coefficients is None else _white_noise_std(shear_n[is_at_rest]),
        _angle_noise_std(samples["angle_rad"], is_at_rest),
    )
    beam_detector_model = detector_model(touch_model, rate_hz, channel_noise)
    detector = TouchDetector(beam_detector_model, rate_hz, DetectorSettings())
    is_armed = False
    detections: list[tuple[int, int]] = []
    pause_ticks = round(_MIN_PAUSE_BETWEEN_TOUCHES_S * rate_hz)
    last_detection_tick = int(ticks[0]) - pause_ticks - 1
    previous_tick = int(ticks[0]) - 1
    sample_columns = (
        ticks, samples["angle_rad"], torque_nm, shear_n,
        (samples["status"] & Status.ANGLE_STALE) != 0,
        (samples["status"] & Status.WRENCH_STALE) != 0,
    )  # fmt: skip
    for tick, angle_rad, sample_torque_nm, sample_shear_n, is_angle_stale, is_wrench_stale in zip(
        *(sample_column.tolist() for sample_column in sample_columns), strict=True
    ):
        if not is_armed and tick >= noise_end_tick:
            detector.arm()
            is_armed = True
        if detector.step(
            angle_rad, sample_torque_nm, sample_shear_n,
            missed_tick_count=tick - previous_tick - 1,
            angle_stale=is_angle_stale, wrench_stale=is_wrench_stale,
        ):  # fmt: skip
            if tick - last_detection_tick > pause_ticks:
                detections.append((tick, last_detection_tick + 1))
            last_detection_tick = tick
        previous_tick = tick
    return detections


def _white_noise_std(signal_values: RealArray) -> float:
    """Return the standard deviation of the white noise in a slowly changing signal."""
    value_steps = np.diff(signal_values)
    return (
        max(float(np.std(value_steps)) / sqrt(2), _MIN_NOISE_STD)
        if value_steps.size
        else _MIN_NOISE_STD
    )


def _angle_noise_std(angle_rad: RealArray, is_at_rest: NDArray[np.bool_]) -> float:
    """Return the standard deviation of the angle's noise, from rest or from its resolution."""
    angle_increments_rad = np.abs(np.diff(angle_rad))
    angle_increments_rad = angle_increments_rad[angle_increments_rad > _MIN_NOISE_STD]
    resolution_rad = float(angle_increments_rad.min()) if angle_increments_rad.size else 0.0
    return max(_white_noise_std(angle_rad[is_at_rest]), resolution_rad / sqrt(12))


def _describe_doubts(touches: Sequence[Touch]) -> list[str]:
    """Return sentences on touches that are not estimated or not explained by the model."""
    sentences = []
    touches_without_estimate = [touch.number for touch in touches if touch.estimate is None]
    if touches_without_estimate:
        sentences.append(
            f"Touch {_number_list(touches_without_estimate)}: not estimated, because that "
            f"requires {_MIN_RECORD_BEFORE_TOUCH_S:g} s of record before a touch and "
            f"{1e3 * _MIN_RECORD_AFTER_TOUCH_S:g} ms after it."
        )
    unexplained_touches = [
        touch.number
        for touch in touches
        if touch.estimate is not None and touch.estimate.chi2_per_degree > _LARGEST_CHI2_PER_DEGREE
    ]
    if unexplained_touches:
        sentences.append(
            f"Touch {_number_list(unexplained_touches)}: the record is not explained by the "
            f"model (residuals more than {sqrt(_LARGEST_CHI2_PER_DEGREE):.1f} times the noise). "
            "Use an identified model (--model); if there was no contact, such a touch is an "
            "error of the model."
        )
    return sentences


def _number_list(numbers: Sequence[int]) -> str:
    """Return numbers as text, separated by commas."""
    return ", ".join(map(str, numbers))


# Seen from above


def _free_deflection_m(free_beam: FreeBeam, record: TouchRecord, touch_time_s: float) -> RealArray:
    """Return the deflection in metres of a beam that moves freely, relative to its undeformed line.

    `free_beam` computes the motion at points along the beam, the first at the motor's axis. Its
    vibration is fitted to the samples of `record` before `touch_time_s` (since the record's start).
    """
    fit_sample_count = min(
        max(int(touch_time_s * record.rate_hz) - 1, _MIN_FIT_SAMPLES), record.detection_index
    )
    motion_without_touch = free_beam.motion(record, fit_sample_count, fit_sample_count - 4)
    step_index = round((touch_time_s - motion_without_touch.first_s) / motion_without_touch.step_s)
    displacement_m: RealArray = motion_without_touch.displacement_m[
        :, min(max(step_index, 0), motion_without_touch.displacement_m.shape[1] - 1)
    ]
    times_s = np.arange(record.angle_rad.size) / record.rate_hz
    return (
        displacement_m - float(np.interp(touch_time_s, times_s, record.angle_rad)) * free_beam.x_m
    )


def _top_view(angle_rad: float, along_m: RealArray, across_m: RealArray) -> RealArray:
    """Return points of the bent beam seen from above, shape (points, 2); angle 0 is along x."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    return np.column_stack([cos * along_m - sin * across_m, sin * along_m + cos * across_m])
