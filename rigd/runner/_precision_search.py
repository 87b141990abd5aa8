"""Search for a requested precision: choice of the next excitation, and end of the session.

Each decision uses a fit of the samples before the last planned segment. It is therefore made during
that segment, in real time and under the virtual clock alike. If the planned segments are expected
to suffice, a pause follows instead of another segment. After the pause all damping structures are
fitted, as `analyze` does, and only this fit can state that the precision is reached.
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
from rigd.excitation import BAND_HZ, PAUSE_S, SHORTEST_S, BeamEstimate, PrecisionSearch, Segment
from rigd.excitation.experiment_design import expected_precisions, next_segment
from rigd.excitation.targets import Target
from rigd.profile import Profile
from rigd.runner.planning import RigPreview
from rigd.session import Validity
from rigd.units import with_half_width, with_percentage

Real = NDArray[np.float64]

_ENOUGH: Final = 0.98
"""Largest ratio of expected to target deviation at which a pause follows instead of a segment."""
_FORECAST_FROM: Final = 4
"""Number of estimates after which the remaining time is forecast."""
_HOPELESS: Final = 2.0
"""Ratio of forecast to available time above which the target is out of reach."""
_HOPELESS_IN_A_ROW: Final = 3
"""Number of such decisions in a row after which the search is given up."""
_NOT_SEEN: Final = "not visible yet"
_DOUBTFUL_IN_A_ROW: Final = 4
"""Number of doubtful fits of all structures in a row after which the search is given up."""
_WIDTH: Final = 22
_SCANS: Final = 2
"""Largest number of repeated scans after failed fits."""
_TIGHTER: Final = 0.7
"""Factor on the target deviations after a flagged estimate: twice the information."""
_FACTORS: Final = (0.5, 4.0)
"""Range of the correction factor: reported over expected standard deviation."""
_OF_MODES: Final = {"damping": "damping_ratio", "frequency": "frequency_hz"}


# Estimates of the requested quantities


@dataclass(frozen=True, slots=True)
class TargetEstimate:
    """Estimate of one requested quantity."""

    quantity: str
    """One of `rigd.excitation.QUANTITIES`."""
    mode: int | None
    """Number of the mode, from 1; None: not a modal quantity, or no such mode was found."""
    value: float | None
    """Estimated value; None: not estimated."""
    std: float
    """Standard deviation; infinite if the value is doubtful."""
    target_std: float
    """Requested standard deviation, in the same unit."""
    doubt: str = ""
    """Why the value is doubtful; else empty."""

    @property
    def name(self) -> str:
        """Name of the quantity for the operator."""
        if self.quantity not in _OF_MODES:
            return self.quantity
        return f"{self.quantity} of {'any mode' if self.mode is None else f'mode {self.mode}'}"

    @property
    def ratio(self) -> float:
        """Ratio of the standard deviation to the requested one."""
        return self.std / self.target_std if self.target_std > 0.0 else inf


def target_estimates(
    document: Mapping[str, Any], targets: Sequence[Target]
) -> list[TargetEstimate]:
    """Return the estimates of all requested quantities from an answer of the fit program.

    The answer is described in docs/online_fit.md. A modal target without a number applies to each
    mode in the band.
    """
    return [each for target in targets for each in _estimates_of(document, target)]


def _estimates_of(document: Mapping[str, Any], target: Target) -> Iterator[TargetEstimate]:
    key = _OF_MODES.get(target.quantity)
    if key is None:
        yield _read(target, document.get("parameters", {}).get(target.quantity))
        return
    # The fit also reports modes above the band, which no segment excites.
    inside = [m for m in document["modes"] if (m["frequency_hz"]["value"] or 0.0) < BAND_HZ]
    modes = [m for m in inside if target.mode in (None, m["mode"])]
    for mode in modes:
        found = _read(replace(target, mode=int(mode["mode"])), mode[key])
        yield found if mode["shown"] else replace(found, std=inf, doubt=_NOT_SEEN)
    if not modes:
        why = "no such mode was found in the band"
        yield TargetEstimate(target.quantity, target.mode, None, inf, target.std, why)


def _read(target: Target, found: Mapping[str, Any] | None) -> TargetEstimate:
    of = target.quantity, target.mode
    if found is None or found["value"] is None:
        return TargetEstimate(*of, None, inf, target.std, "it is not part of what was found")
    value, std, doubt = float(found["value"]), found["std"], found["flag"] or ""
    target_std = target.std * (abs(value) if target.relative else 1.0)
    return TargetEstimate(
        *of, value, inf if doubt or std is None else float(std), target_std, doubt
    )


def beam_estimate(
    document: Mapping[str, Any], targets: Sequence[Target], uniformity: float
) -> BeamEstimate:
    """Return the beam estimate of an answer of the fit program, for the design of excitation.

    `uniformity` is the relative standard deviation of each mode's frequency from that of a uniform
    beam. If all targets are modal, the estimate is that of the modal model.
    """
    names, noise = document["covariance"]["names"], document["noise"]
    found = BeamEstimate.from_dict({**document["plant"], "names": names, "noise": noise})
    if uniformity and all(target.quantity in _OF_MODES for target in targets):
        return found.modal()
    # The tolerance is wider if the modes deviate by more than the stated uniformity.
    return found.with_tolerance(max(uniformity, (document["uniformity_percent"] or 0.0) / 100.0))


# The search


@dataclass(slots=True)
class _Interval:
    """Interval of the reference and of the record."""

    name: str
    reference_rad: Real
    reference_tick: int
    """First tick in the reference."""
    record_tick: int
    """First tick in the record."""

    @property
    def size(self) -> int:
        return int(self.reference_rad.size)


class ExcitationPlanner:
    """Choose the segments of the reference of one session.

    `due` is the tick of the reference up to which the next decision needs samples; None: no further
    decision. If `may_be_last` is set, the next estimate may be the last one, and all structures are
    to be fitted.
    """

    def __init__(
        self,
        search: PrecisionSearch,
        profile: Profile,
        writer: ReferenceWriter,
        *,
        start_rad: float = 0.0,
    ) -> None:
        self._targets = search.targets
        self._tip_slope_rad = search.tip_slope_rad
        self._rig = RigPreview(profile, start_rad)
        self._writer = writer
        self._rate_hz = profile.rig.rate_hz
        self._most_ticks = writer.ticks + writer.room
        first, scan_rad = search.scan
        self._intervals = [_Interval("scan", scan_rad, first, first)]
        self._segment_count = self._scans = 0
        self._shows_modes = self._judged = False
        self._hopeless = self._doubtful = 0
        self._tightening = 1.0
        self._course = _Course()
        self._factors: dict[str, float] = {}
        percent = search.uniformity_percent
        of_profile = profile.uncertainty.uniformity_percent
        self._uniformity = (of_profile if percent is None else percent) / 100.0
        self._columns: list[str] = []
        self.due: int | None = first + scan_rad.size
        self.may_be_last = False

    def decide(self, document: Mapping[str, Any], held: int, held_before: int) -> Iterator[object]:
        """Plan the next segment from an answer to the samples before `due`; yield the messages.

        The angle was held for `held` ticks of the record because no segment was available, for
        `held_before` of them before the last segment that has begun.
        """
        last = self._intervals[-1]
        last.record_tick = last.reference_tick + held_before
        self._judged |= self.may_be_last
        if document["problem"] or "plant" not in document:
            problem = document["problem"] or "Nothing could be fitted."
            if self._columns:
                # Earlier fits succeeded: the record now has a gap, or the sensor is stuck.
                yield self._end(f"Given up: {problem}", reached=False)
            else:
                yield from self._scan_again(problem, held)
            return
        found = target_estimates(document, self._targets)
        time_s = document["tick"] / self._rate_hz
        self._course.note(time_s, max(each.ratio for each in found))
        doubt = document["doubt"] or ""
        # A doubt from the freest structure alone is first checked with all structures.
        yield self._report(document, found, time_s, quietly=bool(doubt) and not self.may_be_last)
        if self.may_be_last and all(each.ratio <= 1.0 for each in found):
            yield self._end(f"Reached: {in_words(found)}.", reached=True)
            return
        if self.may_be_last:
            flagged = [each for each in found if each.doubt not in ("", _NOT_SEEN)]
            if flagged and last.name == "pause" and not doubt:
                # Precise enough according to the plan, but flagged as no property of the antenna.
                doubt = f"{flagged[0].name}: {flagged[0].doubt}"
                self._tightening *= _TIGHTER
            self._doubtful = self._doubtful + 1 if doubt else 0
        if self._doubtful >= _DOUBTFUL_IN_A_ROW:
            findings = " ".join(document["findings"])
            reason = f"The record is doubtful: {doubt}. {findings} Take a chirp."
            yield self._end(reason.replace("  ", " "), reached=False)
            return
        try:
            estimate = beam_estimate(document, self._targets, self._uniformity)
            yield from self._go_on(estimate, document["tick"], found, held, doubt)
        except (RigdError, ArithmeticError, ValueError) as error:
            # The estimate is too wrong to plan with.
            yield from self._scan_again(str(error), held)

    @property
    def needs_early_fit(self) -> bool:
        """Whether all structures are to be fitted now, while the last segment is played.

        The first fit of all structures after a pause then has start values.
        """
        return self._intervals[-1].name == "pause" and not self._judged and self.due is not None

    def is_begun(self, begun: int) -> bool:
        """Whether the last segment has begun, so that its tick in the record is known."""
        return len(self._intervals) == 1 or begun > self._intervals[-1].reference_tick

    def ended(self, ticks: int, held_before: int, begun: int) -> SearchEnded:
        """Return the end of the search after the end of a record of `ticks` ticks."""
        if self.is_begun(begun):
            last = self._intervals[-1]
            last.record_tick = last.reference_tick + held_before
        else:
            self._intervals.pop()
        return self._end(self._too_long if ticks >= self._most_ticks else "", reached=False)

    @property
    def _too_long(self) -> str:
        return f"Not reached within {self._most_ticks / self._rate_hz:g} s (--at-most)."

    def _go_on(
        self,
        estimate: BeamEstimate,
        tick: int,
        found: Sequence[TargetEstimate],
        held: int,
        doubt: str,
    ) -> Iterator[object]:
        """Append a segment, or a pause if the planned segments are expected to suffice."""
        reference_rad = self._reference_rad(held)
        # Negative if the angle was held for long before the last segment.
        left_ticks = self._most_ticks - reference_rad.size
        left_s = left_ticks / self._rate_hz
        if left_s < SHORTEST_S + PAUSE_S:
            if self.may_be_last or left_ticks <= 0:
                yield self._end(self._too_long, reached=False)
            else:
                self._pause(min(PAUSE_S, left_s))
            return
        plant = self._rig.plant_with(estimate.loaded_beam)
        angle_rad = plant.respond(reference_rad).angle_rad
        segment = next_segment(
            estimate,
            angle_rad,
            self._aims(estimate, angle_rad[:tick], found),
            self._rig,
            left_s - PAUSE_S,
            tip_slope_rad=self._tip_slope_rad,
            through=self._through(found),
        )
        if not self.may_be_last and all(each.ratio <= _ENOUGH for each in segment.now):
            self._pause(PAUSE_S)
            return
        never = [f"{each.impossible}." for each in segment.now if each.impossible]
        # Two forecasts: from the information of possible segments, and from the course so far.
        slow = segment.forecast.seconds > _HOPELESS * left_s
        hopeless = never[0] if never else slow and self._course.hopeless(left_s)
        self._hopeless = self._hopeless + 1 if hopeless else 0
        if self._hopeless >= _HOPELESS_IN_A_ROW:
            yield self._end(f"Out of reach: {hopeless}", reached=False)
            return
        self._segment_count += 1
        self._append(f"piece_{self._segment_count}", segment.reference_rad)
        self.due = self._intervals[-1].reference_tick
        # Another structure, such as a compliant clamp, may explain what a uniform beam does not.
        self.may_be_last = bool(doubt) and not self.may_be_last
        yield PlannedSegment(segment.name, self._document(segment, found))

    def _aims(
        self, estimate: BeamEstimate, angle_rad: Real, found: Sequence[TargetEstimate]
    ) -> list[Target]:
        """Return the targets of the design, corrected for its bias.

        The design predicts standard deviations of a beam model, and a fit reports those of the
        modal model. Each target is divided by the ratio of reported to predicted deviation for the
        present record.
        """
        by_name = {each.name: each.std for each in found}
        aims = []
        for each in expected_precisions(angle_rad, estimate, self._targets, self._rate_hz):
            factor = by_name.get(each.target.name, inf) / max(each.std, 1e-300)
            factor = float(np.clip(factor, *_FACTORS)) if isfinite(factor) else 1.0
            self._factors[each.target.name] = factor
            aims.append(replace(each.target, std=self._tightening * each.target.std / factor))
        return aims

    def _through(self, found: Sequence[TargetEstimate]) -> list[int]:
        """Return the modes that the next segment must excite because the record does not show them.

        A model may determine such a mode from the others, and the design expects this, but the
        check of the record does not accept it. Every other segment is free for the design.
        """
        unseen = [each.mode for each in found if each.doubt == _NOT_SEEN and each.mode]
        self._shows_modes = bool(unseen) and self._segment_count > 0 and not self._shows_modes
        return unseen if self._shows_modes else []

    def _scan_again(self, why: str, held: int) -> Iterator[object]:
        """Repeat the scan after an unusable estimate."""
        if self._scans >= _SCANS or not self._scan(f"scan_{self._scans + 2}", held):
            yield self._end(f"Given up: {why}", reached=False)
            return
        self._scans += 1
        self.may_be_last = False
        yield PlannedSegment("the scan once more", {"why": why})

    def _scan(self, name: str, held: int) -> bool:
        """Append the scan under another name; return whether there was time for it."""
        scan_rad = self._intervals[0].reference_rad
        if self._most_ticks - self._writer.ticks - held < scan_rad.size:
            return False
        self._append(name, scan_rad)
        self.due = self._writer.ticks
        return True

    def _pause(self, duration_s: float) -> None:
        """Append a pause, after which all structures are fitted to the whole record."""
        self._append("pause", np.zeros(round(duration_s * self._rate_hz)))
        self.due, self.may_be_last = self._writer.ticks, True

    def _append(self, name: str, reference_rad: Real) -> None:
        tick = self._writer.ticks
        self._intervals.append(_Interval(name, reference_rad, tick, tick))
        self._writer.append(reference_rad)

    def _reference_rad(self, held: int) -> Real:
        """Return the reference of the record up to the end of the last segment, shape (n,)."""
        whole = np.zeros(self._writer.ticks + held)
        for each in self._intervals:
            whole[each.record_tick : each.record_tick + each.size] = each.reference_rad
        return whole

    def _report(
        self,
        document: Mapping[str, Any],
        found: Sequence[TargetEstimate],
        time_s: float,
        *,
        quietly: bool,
    ) -> FitReport:
        """Return a report of an estimate, with a row of the table of requested quantities."""
        state = {"left_s": self._course.left_s, "targets": targets_json(found)}
        validity = Validity.of_document(document.get("validity"))
        text = [] if quietly else self._rows(found, time_s, validity)
        return FitReport({**document, "search": state, "text": text})

    def _rows(
        self, found: Sequence[TargetEstimate], time_s: float, validity: Validity
    ) -> list[str]:
        """Return the next row of the table, after a header row if the columns changed."""
        rows = []
        columns = [each.name for each in found]
        if columns != self._columns:
            self._columns = columns
            heads = "".join(f"{name:<{_WIDTH}}" for name in columns)
            about = f"± one standard deviation; tip slope {validity.short}"
            rows.append(f"  time  {heads}left   ({about})")
        left_s = self._course.left_s
        cells = "".join(f"{_cell(each):<{_WIDTH}}" for each in found)
        return [*rows, f"{time_s:5.1f} s {cells}{'' if left_s is None else f'{left_s:.0f} s'}"]

    def state(self, document: Mapping[str, Any]) -> dict[str, Any]:
        """Return the estimates of the requested quantities for JSON."""
        return {"targets": targets_json(target_estimates(document, self._targets))}

    def _document(self, segment: Segment, found: Sequence[TargetEstimate]) -> dict[str, Any]:
        """Return the expected result of a segment and the estimate from which it was planned."""
        return {
            "duration_s": segment.reference_rad.size / self._rate_hz,
            "stated": {each.name: each.std for each in found if isfinite(each.std)},
            "expected": [
                {
                    "name": each.target.name,
                    "std": self._factors[each.target.name] * each.std,
                    "asked_std": self._factors[each.target.name]
                    * each.target_std
                    / self._tightening,
                }
                for each in segment.expected
                if isfinite(each.std)
            ],
            "share_of_limits": segment.fraction_of_limits,
            "left_s": self._course.left_s,
        }

    def _end(self, reason: str, *, reached: bool) -> SearchEnded:
        """End the search; the record ends with the planned segments."""
        self.due = None
        segments = {
            each.name: (each.record_tick, each.record_tick + each.size)
            for each in self._intervals
            if each.name != "pause"
        }
        segments["sweep"] = (self._intervals[0].record_tick, self._most_ticks)
        return SearchEnded(reached, reason, segments)


class _Course:
    """Course of the largest ratio of reported to requested deviation, and its extrapolation.

    The inverse square of the ratio is proportional to the information, which grows linearly with
    time under the most informative excitation.
    """

    def __init__(self) -> None:
        self._known: list[tuple[float, float]] = []

    def note(self, time_s: float, ratio: float) -> None:
        """Add the ratio at a time of the record."""
        if isfinite(ratio):
            self._known.append((time_s, ratio**-2))

    @property
    def left_s(self) -> float | None:
        """Forecast time until the ratio is 1, from the latest half of the course; None: unknown."""
        if len(self._known) < _FORECAST_FROM:
            return None
        (now_s, now), (then_s, then) = self._known[-1], self._known[len(self._known) // 2 - 1]
        if now >= 1.0:
            return 0.0
        return (1.0 - now) * (now_s - then_s) / (now - then) if now > then else None

    def hopeless(self, time_left_s: float) -> str:
        """Return why the available time is too short, and the remedy; else an empty text."""
        left_s = self.left_s
        if left_s is None or left_s <= _HOPELESS * time_left_s:
            return ""
        now_s, now = self._known[-1]
        ratio = (now + (1.0 - now) * time_left_s / left_s) ** -0.5
        return (
            f"it would take about {left_s:.0f} s more, and the {time_left_s:.0f} s that are left "
            f"will do for {ratio:.2g} times the deviation asked for. Ask for that, or give "
            f"--at-most {1.2 * (now_s + left_s):.0f}."
        )


def _cell(each: TargetEstimate) -> str:
    """Return the cell of a quantity in the table, damping ratios in percent."""
    if each.value is None or each.doubt:
        return each.doubt if each.doubt == _NOT_SEEN else "doubtful"
    scale, unit = (100.0, " %") if each.name.startswith("damping") else (1.0, "")
    half = scale * each.std
    return f"{with_half_width(scale * each.value, (-half, half))}{unit}"


def targets_json(found: Sequence[TargetEstimate]) -> list[dict[str, Any]]:
    """Return the estimates of the requested quantities for JSON."""
    return [
        {
            "name": each.name,
            "quantity": each.quantity,
            "mode": each.mode,
            "value": each.value,
            "std": each.std if isfinite(each.std) else None,
            "asked_std": each.target_std if isfinite(each.target_std) else None,
            "doubt": each.doubt,
        }
        for each in found
    ]


def in_words(found: Sequence[TargetEstimate]) -> str:
    """Return the estimates and their standard deviations as text."""
    return ", ".join(_one_in_words(each) for each in found)


def _one_in_words(each: TargetEstimate) -> str:
    if each.value is None or each.doubt:
        return f"{each.name}: {each.doubt}"
    return (
        f"{each.name} {each.value:.5g}, standard deviation {with_percentage(each.std, each.value)}"
    )
