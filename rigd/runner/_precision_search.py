"""Planning of a session that lasts until estimates reach a requested precision.

During each segment of the excitation, the next segment is chosen from a fit of the samples before
it. If the planned segments are expected to suffice, a pause follows instead of another segment.
After the pause all damping structures are fitted, as by `analyze`. Only this fit can show that the
precision is reached.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf, isfinite
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rigd.engine.messages import FitReport, PlannedSegment, SearchEnded
from rigd.engine.reference import ReferenceWriter
from rigd.errors import RigdError
from rigd.estimates import Estimate
from rigd.excitation import (
    BAND_HZ,
    SEGMENT_PAUSE_S,
    SHORTEST_SEGMENT_S,
    BeamEstimate,
    PrecisionSearch,
    Segment,
)
from rigd.excitation.experiment_design import expected_precisions, next_segment
from rigd.excitation.targets import Target
from rigd.profile import Profile
from rigd.runner.planning import RigPreview
from rigd.session import Validity
from rigd.units import with_half_width, with_percentage

RealArray = NDArray[np.float64]

_SUFFICIENT_STD_RATIO: Final = 0.98
"""Maximum ratio of expected to requested standard deviation at which a pause is appended."""
_MIN_FORECAST_ESTIMATES: Final = 4
"""Minimum number of estimates from which the remaining time is forecast."""
_UNREACHABLE_TIME_RATIO: Final = 2.0
"""Ratio of forecast to available time above which the requested precision is unreachable."""
_MAX_FORECAST_S: Final = 86_400.0
"""Longest time in s that is forecast: the information grows too little for a number if it takes
more than a day."""
_MAX_UNREACHABLE_FORECASTS: Final = 3
"""Number of consecutive forecasts of an unreachable precision that end the session."""
_NOT_VISIBLE_TEXT: Final = "not visible yet"
"""Doubt of an estimate whose mode the record does not show."""
_MAX_DOUBTFUL_FITS: Final = 4
"""Number of consecutive doubtful fits of all damping structures that end the session."""
_COLUMN_WIDTH: Final = 22
"""Width in characters of a column of the printed table."""
_MAX_REPEATED_SCANS: Final = 2
"""Maximum number of times that the scan is repeated after failed fits."""
_TARGET_TIGHTENING_FACTOR: Final = 0.7
"""Factor by which requested standard deviations are reduced after a flagged estimate: half the
variance requires twice the information."""
_TIP_SLOPE_FRACTION: Final = 0.85
"""Fraction of the largest tip slope for which segments are designed. While the damping is not known
precisely, the predicted slope is up to 24 % smaller than the slope of the segment."""
_REDUCED_AMPLITUDE_FRACTION: Final = 2**0.5 - 1
"""Amplitude of most segments, relative to the largest one, while air drag of unknown size damps the
beam. The effect of the damping on the torque is proportional to the amplitude, that of drag to its
square: this amplitude together with the largest one distinguishes them best (G. Elfving, Optimum
allocation in linear regression theory, Ann. Math. Stat. 23, 1952)."""
_SEGMENTS_PER_FULL_AMPLITUDE: Final = 4
"""While air drag is unknown, one of this number of segments has the largest amplitude; the optimum
would be 29 % of the time. Segments that only wait until the vibration has decayed to the reduced
amplitude are not counted: mode 1 takes some seconds for that."""
_CORRECTION_FACTOR_RANGE: Final = (0.5, 16.0)
"""Range to which the factor that corrects the design is limited: the ratio of the reported standard
deviation to the predicted one."""
_MODAL_QUANTITY_KEYS: Final = {"damping": "damping_ratio", "frequency": "frequency_hz"}
"""Requested modal quantity → its key in the estimates of a mode."""


# Estimates of the requested quantities


@dataclass(frozen=True, slots=True)
class TargetEstimate:
    """Estimate of a quantity whose precision the operator requested."""

    quantity: str
    """Name of the quantity, one of `rigd.excitation.QUANTITIES`."""
    mode: int | None
    """Number of the mode, from 1; None if the quantity is not modal or no such mode was found."""
    value: float | None
    """Estimated value, or None if the quantity was not estimated."""
    std: float
    """Standard deviation of the estimate, infinite if the estimate is doubtful."""
    target_std: float
    """Requested standard deviation, in the unit of the value."""
    doubt: str = ""
    """Text that states why the estimate is doubtful; empty if it is not."""

    @property
    def name(self) -> str:
        """Name of the quantity for the operator, with its mode."""
        if self.quantity not in _MODAL_QUANTITY_KEYS:
            return self.quantity
        return f"{self.quantity} of {'any mode' if self.mode is None else f'mode {self.mode}'}"

    @property
    def std_ratio(self) -> float:
        """Ratio of the estimate's standard deviation to the requested one; at most 1 suffices."""
        return self.std / self.target_std if self.target_std > 0.0 else inf


def target_estimates(
    fit_document: Mapping[str, Any], targets: Sequence[Target]
) -> list[TargetEstimate]:
    """Return the estimates of all requested quantities from a document of the estimator.

    docs/online_fit.md describes the document. A modal target without a mode number applies to each
    mode in the excited frequency band.
    """
    return [estimate for target in targets for estimate in _estimates_of(fit_document, target)]


def _estimates_of(fit_document: Mapping[str, Any], target: Target) -> Iterator[TargetEstimate]:
    """Yield the estimates of one requested quantity, one for each mode to which it applies."""
    quantity_key = _MODAL_QUANTITY_KEYS.get(target.quantity)
    if quantity_key is None:
        parameters = fit_document.get("parameters", {})
        yield _target_estimate(target, Estimate.from_json(parameters.get(target.quantity)))
        return
    # The fit also reports modes above the band, which no segment excites.
    modes_in_band = [
        m for m in fit_document["modes"] if (m["frequency_hz"]["value"] or 0.0) < BAND_HZ
    ]
    matching_modes = [m for m in modes_in_band if target.mode in (None, m["mode"])]
    for mode_document in matching_modes:
        target_estimate = _target_estimate(
            replace(target, mode=int(mode_document["mode"])),
            Estimate.from_json(mode_document[quantity_key]),
        )
        yield (
            target_estimate
            if mode_document["shown"]
            else replace(target_estimate, std=inf, doubt=_NOT_VISIBLE_TEXT)
        )
    if not matching_modes:
        missing_reason = "no such mode was found in the band"
        yield TargetEstimate(target.quantity, target.mode, None, inf, target.std, missing_reason)


def _target_estimate(target: Target, estimate: Estimate | None) -> TargetEstimate:
    """Return the estimate of a requested quantity."""
    quantity_and_mode = target.quantity, target.mode
    if estimate is None:
        return TargetEstimate(
            *quantity_and_mode, None, inf, target.std, "the fit does not include it"
        )
    # An estimate that is less than its uncertainty does not show how small the value is.
    relative_scale = max(abs(estimate.value), estimate.std or 0.0)
    return TargetEstimate(
        *quantity_and_mode,
        estimate.value,
        inf if estimate.flag or estimate.std is None else estimate.std,
        target.std * (relative_scale if target.is_relative else 1.0),
        estimate.flag or "",
    )


def beam_estimate(
    fit_document: Mapping[str, Any], targets: Sequence[Target], uniformity: float
) -> BeamEstimate:
    """Return the beam estimate, for the design of excitation, from the estimator's document.

    `uniformity` is the relative standard deviation of each mode's frequency from the frequency of a
    uniform beam. If all targets are modal, the parameters are those of the modal model.
    """
    parameter_names, noise_document = fit_document["covariance"]["names"], fit_document["noise"]
    estimated_beam = BeamEstimate.from_dict(
        {**fit_document["plant"], "names": parameter_names, "noise": noise_document}
    )
    if uniformity and all(target.quantity in _MODAL_QUANTITY_KEYS for target in targets):
        return estimated_beam.with_modal_parameters()
    # The tolerance is wider if the modes deviate by more than the stated uniformity.
    return estimated_beam.with_tolerance(
        max(uniformity, (fit_document["uniformity_percent"] or 0.0) / 100.0)
    )


# The search


@dataclass(slots=True)
class _PlannedInterval:
    """Planned segment of the reference, and its position in the record.

    The record has more ticks than the reference if the angle was held until a segment was planned.
    """

    name: str
    reference_rad: RealArray
    first_reference_tick: int
    """First tick of the segment in the reference."""
    first_record_tick: int
    """First tick of the segment in the record."""

    @property
    def tick_count(self) -> int:
        """Number of ticks of the segment."""
        return int(self.reference_rad.size)


class ExcitationPlanner:
    """Planner that chooses the segments of the reference until the precision is reached.

    `due_tick` is the tick of the reference up to which samples are needed for the next decision, or
    None after the last decision. If `may_be_last` is True, the next estimate may end the session,
    and must be a fit of all damping structures.
    """

    def __init__(
        self,
        search: PrecisionSearch,
        profile: Profile,
        reference_writer: ReferenceWriter,
        *,
        start_angle_rad: float = 0.0,
    ) -> None:
        self._targets = search.targets
        self._tip_slope_rad = search.tip_slope_rad
        self._preview = RigPreview(profile, start_angle_rad)
        self._writer = reference_writer
        self._rate_hz = profile.rig.rate_hz
        self._max_ticks = reference_writer.ticks + reference_writer.room
        scan_tick, scan_rad = search.scan
        self._intervals = [_PlannedInterval("scan", scan_rad, scan_tick, scan_tick)]
        self._segment_count = self._driven_count = self._repeated_scans = self._shown_tick = 0
        self._excites_unseen_modes = self._has_full_fit = False
        self._unreachable_count = self._doubtful_count = 0
        self._tightening = 1.0
        self._forecast = _TimeForecast()
        self._correction_factors: dict[str, float] = {}
        stated_uniformity_percent = search.uniformity_percent
        profile_uniformity_percent = profile.uncertainty.uniformity_percent
        self._uniformity = (
            profile_uniformity_percent
            if stated_uniformity_percent is None
            else stated_uniformity_percent
        ) / 100.0
        self._column_names: list[str] = []
        self.due_tick: int | None = scan_tick + scan_rad.size
        self.may_be_last = False

    def plan_next_segment(
        self, fit_document: Mapping[str, Any], held_ticks: int, held_ticks_before: int
    ) -> Iterator[object]:
        """Plan the next segment from a fit of the samples before `due_tick`.

        Yields the messages for the supervisor. `held_ticks` is the number of ticks in which the
        angle was held because no segment was planned in time; `held_ticks_before` is its value at
        the start of the segment that began last.
        """
        last_interval = self._intervals[-1]
        last_interval.first_record_tick = last_interval.first_reference_tick + held_ticks_before
        self._has_full_fit |= self.may_be_last
        if fit_document["problem"] or "plant" not in fit_document:
            problem_text = fit_document["problem"] or "Nothing could be fitted."
            if self._column_names:
                # Earlier fits succeeded: the record now has a gap, or the sensor is stuck.
                yield self._search_end_message(f"Given up: {problem_text}", is_reached=False)
            else:
                yield from self._repeat_scan(problem_text, held_ticks)
            return
        estimates = target_estimates(fit_document, self._targets)
        record_time_s = fit_document["tick"] / self._rate_hz
        self._forecast.add(
            record_time_s, max(target_estimate.std_ratio for target_estimate in estimates)
        )
        doubt_text = fit_document["doubt"] or ""
        # A doubt from the structure with most parameters is first checked with all structures.
        is_tick_shown = fit_document["tick"] == self._shown_tick
        hides_row = is_tick_shown or (bool(doubt_text) and not self.may_be_last)
        yield self._report_message(
            fit_document, estimates, record_time_s, without_table_row=hides_row
        )
        if not hides_row:
            self._shown_tick = fit_document["tick"]
        if self.may_be_last and all(
            target_estimate.std_ratio <= 1.0 for target_estimate in estimates
        ):
            yield self._search_end_message(
                f"Reached: {estimates_text(estimates)}.", is_reached=True
            )
            return
        if self.may_be_last:
            flagged_estimates = [
                target_estimate
                for target_estimate in estimates
                if target_estimate.doubt not in ("", _NOT_VISIBLE_TEXT)
            ]
            if flagged_estimates and last_interval.name == "pause" and not doubt_text:
                # The plan is fulfilled, but the estimate is flagged as no property of the antenna.
                doubt_text = f"{flagged_estimates[0].name}: {flagged_estimates[0].doubt}"
                self._tightening *= _TARGET_TIGHTENING_FACTOR
            self._doubtful_count = self._doubtful_count + 1 if doubt_text else 0
        if self._doubtful_count >= _MAX_DOUBTFUL_FITS:
            findings_text = " ".join(fit_document["findings"])
            end_reason = (
                f"The record is doubtful: {doubt_text}. {findings_text} Record a chirp instead: "
                "rigd run chirp."
            )
            yield self._search_end_message(end_reason.replace("  ", " "), is_reached=False)
            return
        try:
            estimate = beam_estimate(fit_document, self._targets, self._uniformity)
            yield from self._plan_segment_or_pause(
                estimate,
                fit_document["tick"],
                estimates,
                held_ticks,
                doubt_text,
                self._next_amplitude_fraction(with_air_drag=fit_document["with_air_drag"]),
            )
        except (RigdError, ArithmeticError, ValueError) as error:
            # The estimate is too inaccurate for planning.
            yield from self._repeat_scan(str(error), held_ticks)

    @property
    def needs_early_fit(self) -> bool:
        """Whether all damping structures are to be fitted once before the end of the pause.

        The early fit provides start values for the fit of all structures after the pause.
        """
        return (
            self._intervals[-1].name == "pause"
            and not self._has_full_fit
            and self.due_tick is not None
        )

    def has_last_segment_begun(self, begun_segment_end: int) -> bool:
        """Return whether the last planned segment has begun, so that its record tick is known.

        `begun_segment_end` is the tick of the reference at which the segment that began last
        ends, or 0 if none has begun.
        """
        return (
            len(self._intervals) == 1
            or begun_segment_end > self._intervals[-1].first_reference_tick
        )

    def record_end_message(
        self, record_ticks: int, held_ticks_before: int, begun_segment_end: int
    ) -> SearchEnded:
        """Return the message that ends the search because the record has ended."""
        if self.has_last_segment_begun(begun_segment_end):
            last_interval = self._intervals[-1]
            last_interval.first_record_tick = last_interval.first_reference_tick + held_ticks_before
        else:
            self._intervals.pop()
        return self._search_end_message(
            self._not_reached_text if record_ticks >= self._max_ticks else "", is_reached=False
        )

    @property
    def _not_reached_text(self) -> str:
        """Text that states that the precision was not reached in the maximum duration."""
        return f"Not reached within {self._max_ticks / self._rate_hz:g} s (--at-most)."

    def _plan_segment_or_pause(
        self,
        estimate: BeamEstimate,
        record_tick: int,
        estimates: Sequence[TargetEstimate],
        held_ticks: int,
        doubt_text: str,
        amplitude_fraction: float,
    ) -> Iterator[object]:
        """Append the next segment, or a pause if the planned segments are expected to suffice."""
        reference_rad = self._reference_rad(held_ticks)
        # Negative if the angle was held for a long time before the last segment.
        remaining_ticks = self._max_ticks - reference_rad.size
        remaining_s = remaining_ticks / self._rate_hz
        if remaining_s < SHORTEST_SEGMENT_S + SEGMENT_PAUSE_S:
            if self.may_be_last or remaining_ticks <= 0:
                yield self._search_end_message(self._not_reached_text, is_reached=False)
            else:
                self._append_pause(min(SEGMENT_PAUSE_S, remaining_s))
            return
        move_plant = self._preview.plant_with(estimate.plant)
        angle_rad = move_plant.respond(reference_rad).angle_rad
        next_planned_segment = next_segment(
            estimate,
            angle_rad,
            self._corrected_targets(estimate, angle_rad[:record_tick], estimates),
            self._preview,
            remaining_s - SEGMENT_PAUSE_S,
            tip_slope_rad=_TIP_SLOPE_FRACTION * self._tip_slope_rad,
            modes_to_drive=self._modes_to_excite(estimates),
            limit_fraction=amplitude_fraction,
        )
        if not self.may_be_last and all(
            target_forecast.std_to_target_ratio <= _SUFFICIENT_STD_RATIO
            for target_forecast in next_planned_segment.present_precisions
        ):
            self._append_pause(SEGMENT_PAUSE_S)
            return
        impossible_reasons = [
            f"{target_forecast.impossible_reason}."
            for target_forecast in next_planned_segment.present_precisions
            if target_forecast.impossible_reason
        ]
        # Two forecasts: from the information of possible segments, and from the progress so far.
        is_too_slow = (
            next_planned_segment.forecast.time_to_targets_s > _UNREACHABLE_TIME_RATIO * remaining_s
        )
        unreachable_reason = (
            impossible_reasons[0]
            if impossible_reasons
            else is_too_slow and self._forecast.unreachable_reason(remaining_s)
        )
        # A segment of reduced amplitude does not show what is out of reach.
        if amplitude_fraction == 1.0 or not unreachable_reason:
            self._unreachable_count = self._unreachable_count + 1 if unreachable_reason else 0
        if self._unreachable_count >= _MAX_UNREACHABLE_FORECASTS:
            yield self._search_end_message(f"Out of reach: {unreachable_reason}", is_reached=False)
            return
        self._segment_count += 1
        self._driven_count += bool(np.any(next_planned_segment.reference_rad))
        self._append_segment(f"piece_{self._segment_count}", next_planned_segment.reference_rad)
        self.due_tick = self._intervals[-1].first_reference_tick
        # Another structure, such as a compliant clamp, may fit where a uniform beam does not.
        self.may_be_last = bool(doubt_text) and not self.may_be_last
        yield PlannedSegment(
            next_planned_segment.name, self._expectation_document(next_planned_segment, estimates)
        )

    def _next_amplitude_fraction(self, *, with_air_drag: bool) -> float:
        """Return the amplitude of the next segment, relative to the largest one."""
        has_full_amplitude = (
            not with_air_drag or self._driven_count % _SEGMENTS_PER_FULL_AMPLITUDE == 0
        )
        return 1.0 if has_full_amplitude else _REDUCED_AMPLITUDE_FRACTION

    def _corrected_targets(
        self, estimate: BeamEstimate, angle_rad: RealArray, estimates: Sequence[TargetEstimate]
    ) -> list[Target]:
        """Return the corrected standard deviations that the next segment is designed to reach.

        The design predicts the standard deviations of the beam model, but a fit reports those of
        the modal model. Each requested standard deviation is therefore divided by the ratio of the
        reported to the predicted one for the record so far.
        """
        std_by_name = {target_estimate.name: target_estimate.std for target_estimate in estimates}
        corrected_targets = []
        for expected_precision in expected_precisions(
            angle_rad, estimate, self._targets, self._rate_hz
        ):
            correction_factor = std_by_name.get(expected_precision.target.name, inf) / max(
                expected_precision.std, 1e-300
            )
            correction_factor = (
                float(np.clip(correction_factor, *_CORRECTION_FACTOR_RANGE))
                if isfinite(correction_factor)
                else 1.0
            )
            self._correction_factors[expected_precision.target.name] = correction_factor
            corrected_targets.append(
                replace(
                    expected_precision.target,
                    std=self._tightening * expected_precision.target.std / correction_factor,
                )
            )
        return corrected_targets

    def _modes_to_excite(self, estimates: Sequence[TargetEstimate]) -> list[int]:
        """Return the numbers of the modes that the next segment must excite to make them visible.

        The design assumes that the beam model determines such a mode from the others, but the check
        of the record requires that the mode itself is visible. Only every second segment must
        excite such modes; for the other segments the list is empty.
        """
        unseen_modes = [
            target_estimate.mode
            for target_estimate in estimates
            if target_estimate.doubt == _NOT_VISIBLE_TEXT and target_estimate.mode
        ]
        self._excites_unseen_modes = (
            bool(unseen_modes) and self._segment_count > 0 and not self._excites_unseen_modes
        )
        return unseen_modes if self._excites_unseen_modes else []

    def _repeat_scan(self, reason: str, held_ticks: int) -> Iterator[object]:
        """Append the scan (the first chirp) again after an unusable estimate, or end the search.

        Yields the message for the supervisor. `reason` states why the estimate is unusable.
        """
        if self._repeated_scans >= _MAX_REPEATED_SCANS or not self._append_scan(
            f"scan_{self._repeated_scans + 2}", held_ticks
        ):
            yield self._search_end_message(f"Given up: {reason}", is_reached=False)
            return
        self._repeated_scans += 1
        self.may_be_last = False
        yield PlannedSegment("the scan once more", {"why": reason})

    def _append_scan(self, segment_name: str, held_ticks: int) -> bool:
        """Append the first chirp again as a segment; return False if too little time remains.

        The motor has been held for `held_ticks` so far, which the record contains in addition.
        """
        scan_rad = self._intervals[0].reference_rad
        if self._max_ticks - self._writer.ticks - held_ticks < scan_rad.size:
            return False
        self._append_segment(segment_name, scan_rad)
        self.due_tick = self._writer.ticks
        return True

    def _append_pause(self, duration_s: float) -> None:
        """Append a pause, after which all damping structures are fitted to the whole record."""
        self._append_segment("pause", np.zeros(round(duration_s * self._rate_hz)))
        self.due_tick, self.may_be_last = self._writer.ticks, True

    def _append_segment(self, segment_name: str, reference_rad: RealArray) -> None:
        """Append a named segment to the reference that the control loop reads."""
        first_tick = self._writer.ticks
        self._intervals.append(
            _PlannedInterval(segment_name, reference_rad, first_tick, first_tick)
        )
        self._writer.append(reference_rad)

    def _reference_rad(self, held_ticks: int) -> RealArray:
        """Return the reference angle at each tick of the record so far, shape (n,).

        The record ends with the last segment and `held_ticks` ticks of rest.
        """
        reference_rad = np.zeros(self._writer.ticks + held_ticks)
        for interval in self._intervals:
            reference_rad[
                interval.first_record_tick : interval.first_record_tick + interval.tick_count
            ] = interval.reference_rad
        return reference_rad

    def _report_message(
        self,
        fit_document: Mapping[str, Any],
        estimates: Sequence[TargetEstimate],
        record_time_s: float,
        *,
        without_table_row: bool,
    ) -> FitReport:
        """Return the message that reports an estimate, with a row of the printed table.

        The row is left out if `without_table_row` is True.
        """
        search_document = {"left_s": self._forecast.remaining_s, "targets": targets_json(estimates)}
        validity = Validity.from_document(fit_document.get("validity"))
        table_rows = (
            [] if without_table_row else self._table_rows(estimates, record_time_s, validity)
        )
        return FitReport({**fit_document, "search": search_document, "text": table_rows})

    def _table_rows(
        self, estimates: Sequence[TargetEstimate], record_time_s: float, validity: Validity
    ) -> list[str]:
        """Return the next row of the printed table, after a heading if its columns changed."""
        table_rows = []
        column_names = [target_estimate.name for target_estimate in estimates]
        if column_names != self._column_names:
            self._column_names = column_names
            heading_text = "".join(
                f"{column_name:<{_COLUMN_WIDTH}}" for column_name in column_names
            )
            heading_note = f"± one standard deviation; tip slope {validity.short_text}"
            table_rows.append(f"  time  {heading_text}left   ({heading_note})")
        remaining_s = self._forecast.remaining_s
        row_text = "".join(
            f"{_cell_text(target_estimate):<{_COLUMN_WIDTH}}" for target_estimate in estimates
        )
        return [
            *table_rows,
            f"{record_time_s:5.1f} s "
            f"{row_text}{'' if remaining_s is None else f'{remaining_s:.0f} s'}",
        ]

    def targets_document(self, fit_document: Mapping[str, Any]) -> dict[str, Any]:
        """Return the estimates of all requested quantities as a dictionary for JSON."""
        return {"targets": targets_json(target_estimates(fit_document, self._targets))}

    def _expectation_document(
        self, segment: Segment, estimates: Sequence[TargetEstimate]
    ) -> dict[str, Any]:
        """Return the present standard deviations, and those expected after a segment, for JSON."""
        return {
            "duration_s": segment.reference_rad.size / self._rate_hz,
            "stated": {
                target_estimate.name: target_estimate.std
                for target_estimate in estimates
                if isfinite(target_estimate.std)
            },
            "expected": [
                {
                    "name": target_forecast.target.name,
                    "std": self._correction_factors[target_forecast.target.name]
                    * target_forecast.std,
                    "asked_std": self._correction_factors[target_forecast.target.name]
                    * target_forecast.target_std
                    / self._tightening,
                }
                for target_forecast in segment.expected_precisions
                if isfinite(target_forecast.std)
            ],
            "share_of_limits": segment.fraction_of_limits,
            "left_s": self._forecast.remaining_s,
        }

    def _search_end_message(self, reason: str, *, is_reached: bool) -> SearchEnded:
        """Return the message that ends the search, with the ticks of all segments."""
        self.due_tick = None
        segment_ticks = {
            interval.name: (
                interval.first_record_tick,
                interval.first_record_tick + interval.tick_count,
            )
            for interval in self._intervals
            if interval.name != "pause"
        }
        segment_ticks["sweep"] = (self._intervals[0].first_record_tick, self._max_ticks)
        return SearchEnded(is_reached, reason, segment_ticks)


class _TimeForecast:
    """Forecast of the time until the requested precision is reached.

    The ratio of reported to requested standard deviation is extrapolated for the least precise
    quantity. Its inverse square is proportional to the information, which grows linearly with time
    under the most informative excitation.
    """

    def __init__(self) -> None:
        self._information_at_times: list[tuple[float, float]] = []

    def add(self, record_time_s: float, std_ratio: float) -> None:
        """Add the ratio of reported to requested standard deviation at a time of the record."""
        if isfinite(std_ratio):
            self._information_at_times.append((record_time_s, std_ratio**-2))

    @property
    def remaining_s(self) -> float | None:
        """Forecast of the time in s until the ratio is 1, from the last half of the estimates.

        It is None if there are too few estimates, or if the information hardly grows.
        """
        required_s = self._required_time_s()
        return None if required_s is None or required_s > _MAX_FORECAST_S else required_s

    def _required_time_s(self) -> float | None:
        """Return the time in s until the ratio is 1, however long; None if there is no forecast."""
        if len(self._information_at_times) < _MIN_FORECAST_ESTIMATES:
            return None
        (now_s, present_information), (earlier_s, earlier_information) = (
            self._information_at_times[-1],
            self._information_at_times[len(self._information_at_times) // 2 - 1],
        )
        if present_information >= 1.0:
            return 0.0
        return (
            (1.0 - present_information)
            * (now_s - earlier_s)
            / (present_information - earlier_information)
            if present_information > earlier_information
            else None
        )

    def unreachable_reason(self, available_s: float) -> str:
        """Return text that states why the available time is too short, with the remedy.

        The text is empty if the time may suffice.
        """
        required_s = self._required_time_s()
        if required_s is None or required_s <= _UNREACHABLE_TIME_RATIO * available_s:
            return ""
        now_s, present_information = self._information_at_times[-1]
        reachable_ratio = (
            present_information + (1.0 - present_information) * available_s / required_s
        ) ** -0.5
        if required_s > _MAX_FORECAST_S:
            required_time_text, longer_record_text = "more than a day", ""
        else:
            required_time_text = f"about {required_s:.0f} s more"
            longer_record_text = f", or give --at-most {1.2 * (now_s + required_s):.0f}"
        return (
            f"it would take {required_time_text}, and the remaining {available_s:.0f} s suffice "
            f"for {reachable_ratio:.2g} times the requested standard deviation. Request "
            f"that{longer_record_text}."
        )


def _cell_text(target_estimate: TargetEstimate) -> str:
    """Return the text of a table cell with an estimate; damping ratios are in percent."""
    if target_estimate.value is None or target_estimate.doubt:
        return target_estimate.doubt if target_estimate.doubt == _NOT_VISIBLE_TEXT else "doubtful"
    display_scale, unit_text = (
        (100.0, " %") if target_estimate.name.startswith("damping") else (1.0, "")
    )
    scaled_std = display_scale * target_estimate.std
    value_text = with_half_width(display_scale * target_estimate.value, (-scaled_std, scaled_std))
    return f"{value_text}{unit_text}"


def targets_json(estimates: Sequence[TargetEstimate]) -> list[dict[str, Any]]:
    """Return the estimates of requested quantities as a list of dictionaries for JSON."""
    return [
        {
            "name": estimate.name,
            "quantity": estimate.quantity,
            "mode": estimate.mode,
            "value": estimate.value,
            "std": estimate.std if isfinite(estimate.std) else None,
            "asked_std": estimate.target_std if isfinite(estimate.target_std) else None,
            "doubt": estimate.doubt,
        }
        for estimate in estimates
    ]


def estimates_text(estimates: Sequence[TargetEstimate]) -> str:
    """Return one line of text with the estimates and their standard deviations."""
    return ", ".join(_estimate_text(estimate) for estimate in estimates)


def _estimate_text(target_estimate: TargetEstimate) -> str:
    """Return text with one estimate and its standard deviation, or why it is doubtful."""
    if target_estimate.value is None or target_estimate.doubt:
        return f"{target_estimate.name}: {target_estimate.doubt}"
    return (
        f"{target_estimate.name} {target_estimate.value:.5g}, standard deviation "
        f"{with_percentage(target_estimate.std, target_estimate.value)}"
    )
