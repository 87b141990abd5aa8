"""Search for a precision: what to excite next, and when the session has told enough.

Each decision rests on a fit of the samples up to the beginning of the last piece that is planned,
so that it is made while that piece is played, in real time as under the virtual clock. Where what
is planned is expected to suffice, a pause follows instead of a piece; after it all structures are
fitted, as `analyze` does, and only what that says counts as reached.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf, isfinite
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rigd.engine.messages import FitTold, PieceTold, SearchEnded
from rigd.engine.reference import PieceWriter
from rigd.errors import RigdError
from rigd.excitation import BAND_HZ, PAUSE_S, SHORTEST_S, BeamEstimate, Piece, PrecisionSearch
from rigd.excitation.experiment_design import expected_precisions, next_piece
from rigd.excitation.targets import Target
from rigd.profile import Profile
from rigd.runner.planning import LoopPreview
from rigd.session import Validity
from rigd.units import with_half_width, with_share

Real = NDArray[np.float64]

_ENOUGH: Final = 0.98
"""Expected deviation over the one asked for, up to which a pause follows instead of a piece."""
_FORECAST_FROM: Final = 4
"""Estimates from which on the time left is forecast."""
_HOPELESS: Final = 2.0
"""Forecast over the time that is left from which on a search is out of reach."""
_HOPELESS_IN_A_ROW: Final = 3
"""Decisions in a row that have to find so before the search is given up."""
_NOT_SEEN: Final = "not visible yet"
_DOUBTFUL_IN_A_ROW: Final = 4
"""Fits of all structures in a row of which no number is to be believed, before it is given up."""
_WIDTH: Final = 22
_SCANS: Final = 2
"""How often the scan is repeated where nothing can be fitted."""
_TIGHTER: Final = 0.7
"""Factor on the deviations aimed at where a number is flagged: twice the information."""
_FACTORS: Final = (0.5, 4.0)
"""Range of the stated over the expected deviation that is allowed for."""
_OF_MODES: Final = {"damping": "damping_ratio", "frequency": "frequency_hz"}


# What an estimate states of what is asked


@dataclass(frozen=True, slots=True)
class TargetEstimate:
    """One quantity that is asked for, as a fit states it."""

    quantity: str
    """One of `rigd.excitation.QUANTITIES`."""
    mode: int | None
    """Its mode, from 1 on; None: it is none of a mode, or no mode was found."""
    value: float | None
    """None: there is none."""
    std: float
    """Standard deviation; infinite where the value is not to be believed."""
    asked_std: float
    """The standard deviation that is asked for, in the same unit."""
    doubt: str = ""
    """Why the value is not to be believed; empty if it is."""

    @property
    def name(self) -> str:
        """The quantity, for the operator."""
        if self.quantity not in _OF_MODES:
            return self.quantity
        return f"{self.quantity} of {'any mode' if self.mode is None else f'mode {self.mode}'}"

    @property
    def ratio(self) -> float:
        """Standard deviation over the one asked for."""
        return self.std / self.asked_std if self.asked_std > 0.0 else inf


def target_estimates(
    document: Mapping[str, Any], targets: Sequence[Target]
) -> list[TargetEstimate]:
    """Return what an estimate states of everything that is asked for.

    Parameters
    ----------
    document
        Answer of the fit program; see docs/online_fit.md.
    targets
        What is asked for; of modes without a number, it is asked of each one in the band.
    """
    return [each for target in targets for each in _estimates_of(document, target)]


def _estimates_of(document: Mapping[str, Any], target: Target) -> Iterator[TargetEstimate]:
    key = _OF_MODES.get(target.quantity)
    if key is None:
        yield _read(target, document.get("parameters", {}).get(target.quantity))
        return
    # A fit tells of modes above its band as well, which no piece drives.
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
    asked_std = target.std * (abs(value) if target.relative else 1.0)
    return TargetEstimate(*of, value, inf if doubt or std is None else float(std), asked_std, doubt)


def beam_estimate(
    document: Mapping[str, Any], targets: Sequence[Target], uniformity: float
) -> BeamEstimate:
    """Return the beam of an answer of the fit program, for the design of excitation.

    Parameters
    ----------
    document
        The answer, which has a fit.
    targets
        What is asked for: modes alone are those of the modal model.
    uniformity
        Stated relative standard deviation of each mode's frequency from that of a uniform beam.

    Raises
    ------
    ExcitationError
        If it cannot be used.
    """
    names, noise = document["covariance"]["names"], document["noise"]
    found = BeamEstimate.from_dict({**document["plant"], "names": names, "noise": noise})
    if uniformity and all(target.quantity in _OF_MODES for target in targets):
        return found.modal()
    # A wider one where the modes do not lie within that stated.
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
    """Decides on the pieces of one session.

    Parameters
    ----------
    search
        What is asked.
    profile
        Profile of the rig.
    writer
        Takes the pieces.
    start_rad
        Where the motor stands, from the rig's zero.

    Attributes
    ----------
    due
        Tick of the reference up to which samples are needed for the next decision; None: no more
        is to be decided.
    may_be_last
        The next estimate may be the last: all structures are to be fitted.
    """

    def __init__(
        self,
        search: PrecisionSearch,
        profile: Profile,
        writer: PieceWriter,
        *,
        start_rad: float = 0.0,
    ) -> None:
        self._targets = search.targets
        self._tip_slope_rad = search.tip_slope_rad
        self._rig = LoopPreview(profile, start_rad)
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
        """Decide by an estimate; yields what the supervisor is to be told.

        Parameters
        ----------
        document
            Answer of the fit program to the samples before `due`.
        held
            Ticks of the record in which the angle was held because there was no piece.
        held_before
            Those of them before the piece that was begun last.
        """
        last = self._intervals[-1]
        last.record_tick = last.reference_tick + held_before
        self._judged |= self.may_be_last
        if document["problem"] or "plant" not in document:
            problem = document["problem"] or "Nothing could be fitted."
            if self._columns:
                # What could be fitted before now has a gap, or a sensor that stands still.
                yield self._end(f"Given up: {problem}", reached=False)
            else:
                yield from self._scan_again(problem, held)
            return
        found = target_estimates(document, self._targets)
        time_s = document["tick"] / self._rate_hz
        self._course.note(time_s, max(each.ratio for each in found))
        doubt = document["doubt"] or ""
        # Doubts of the freest structure alone are looked into first.
        yield self._report(document, found, time_s, quietly=bool(doubt) and not self.may_be_last)
        if self.may_be_last and all(each.ratio <= 1.0 for each in found):
            yield self._end(f"Reached: {in_words(found)}.", reached=True)
            return
        if self.may_be_last:
            flagged = [each for each in found if each.doubt not in ("", _NOT_SEEN)]
            if flagged and last.name == "pause" and not doubt:
                # Precise enough by what was planned, and yet no property of the antenna.
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
            # An estimate so far off that nothing can be planned with it.
            yield from self._scan_again(str(error), held)

    @property
    def needs_early_fit(self) -> bool:
        """Whether all structures are to be fitted to what there is, while the rest is played.

        Before a pause, after which the first judgement would otherwise start from nothing.
        """
        return self._intervals[-1].name == "pause" and not self._judged and self.due is not None

    def is_begun(self, begun: int) -> bool:
        """Whether what was planned last is being played: only then is it known from which tick on.

        Parameters
        ----------
        begun
            Ticks of the reference up to the end of the piece that was begun last.
        """
        return len(self._intervals) == 1 or begun > self._intervals[-1].reference_tick

    def ended(self, ticks: int, held_before: int, begun: int) -> SearchEnded:
        """Return what there is of a search whose record has ended after so many ticks.

        Parameters
        ----------
        ticks
            Ticks of the record.
        held_before
            As for `decide`.
        begun
            As for `is_begun`.
        """
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
        """Append a piece, or a pause where what is planned is expected to suffice."""
        reference_rad = self._reference_rad(held)
        # Less than nothing where the angle was held for long before the last piece.
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
        segment = next_piece(
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
        # Two ways to look ahead: from what pieces can tell, and from what they did tell.
        slow = segment.forecast.seconds > _HOPELESS * left_s
        hopeless = never[0] if never else slow and self._course.hopeless(left_s)
        self._hopeless = self._hopeless + 1 if hopeless else 0
        if self._hopeless >= _HOPELESS_IN_A_ROW:
            yield self._end(f"Out of reach: {hopeless}", reached=False)
            return
        self._segment_count += 1
        self._append(f"piece_{self._segment_count}", segment.reference_rad)
        self.due = self._intervals[-1].reference_tick
        # What a uniform beam does not explain, another structure may: a clamp that gives way.
        self.may_be_last = bool(doubt) and not self.may_be_last
        yield PieceTold(segment.name, self._document(segment, found))

    def _aims(
        self, estimate: BeamEstimate, angle_rad: Real, found: Sequence[TargetEstimate]
    ) -> list[Target]:
        """Return the precisions to design for, in terms of what the design expects.

        The design expects the deviations of a beam, and a fit states those of the modal model: its
        own are those requested times what it expects of the record fitted over what was stated.
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
        """Return modes that the next piece has to drive, because the record does not show them.

        A model may tell of such a mode by the others, as the design expects; the judgement of the
        record does not accept that. Every other piece is left to the design.
        """
        unseen = [each.mode for each in found if each.doubt == _NOT_SEEN and each.mode]
        self._shows_modes = bool(unseen) and self._segment_count > 0 and not self._shows_modes
        return unseen if self._shows_modes else []

    def _scan_again(self, why: str, held: int) -> Iterator[object]:
        """Repeat the scan where an estimate is of no use."""
        if self._scans >= _SCANS or not self._scan(f"scan_{self._scans + 2}", held):
            yield self._end(f"Given up: {why}", reached=False)
            return
        self._scans += 1
        self.may_be_last = False
        yield PieceTold("the scan once more", {"why": why})

    def _scan(self, name: str, held: int) -> bool:
        """Append the scan, as a stretch of another name; say whether there was time for it."""
        scan_rad = self._intervals[0].reference_rad
        if self._most_ticks - self._writer.ticks - held < scan_rad.size:
            return False
        self._append(name, scan_rad)
        self.due = self._writer.ticks
        return True

    def _pause(self, duration_s: float) -> None:
        """Hold the angle for a while; then have all structures fitted to the whole record."""
        self._append("pause", np.zeros(round(duration_s * self._rate_hz)))
        self.due, self.may_be_last = self._writer.ticks, True

    def _append(self, name: str, reference_rad: Real) -> None:
        tick = self._writer.ticks
        self._intervals.append(_Interval(name, reference_rad, tick, tick))
        self._writer.append(reference_rad)

    def _reference_rad(self, held: int) -> Real:
        """Return the reference of the record up to the end of what is planned, shape (n,)."""
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
    ) -> FitTold:
        """Return an estimate with a row of the table of what is asked for."""
        state = {"left_s": self._course.left_s, "targets": targets_json(found)}
        validity = Validity.of_document(document.get("validity"))
        text = [] if quietly else self._rows(found, time_s, validity)
        return FitTold({**document, "search": state, "text": text})

    def _rows(
        self, found: Sequence[TargetEstimate], time_s: float, validity: Validity
    ) -> list[str]:
        """Return the next row of the table, with its heads where these are new."""
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
        """Return what an estimate states of what is asked for, as JSON documents have it.

        Parameters
        ----------
        document
            Answer of the fit program.
        """
        return {"targets": targets_json(target_estimates(document, self._targets))}

    def _document(self, segment: Piece, found: Sequence[TargetEstimate]) -> dict[str, Any]:
        """Return what is expected of a piece, and what was stated when it was planned."""
        return {
            "duration_s": segment.reference_rad.size / self._rate_hz,
            "stated": {each.name: each.std for each in found if isfinite(each.std)},
            "expected": [
                {
                    "name": each.target.name,
                    "std": self._factors[each.target.name] * each.std,
                    "asked_std": self._factors[each.target.name]
                    * each.asked_std
                    / self._tightening,
                }
                for each in segment.expected
                if isfinite(each.std)
            ],
            "share_of_limits": segment.share_of_limits,
            "left_s": self._course.left_s,
        }

    def _end(self, reason: str, *, reached: bool) -> SearchEnded:
        """End the search; the record ends with what is planned."""
        self.due = None
        segments = {
            each.name: (each.record_tick, each.record_tick + each.size)
            for each in self._intervals
            if each.name != "pause"
        }
        segments["sweep"] = (self._intervals[0].record_tick, self._most_ticks)
        return SearchEnded(reached, reason, segments)


class _Course:
    """How the largest deviation over the one asked for goes down, and where that leads.

    Its inverse square grows as the information does: with time, once what tells most is driven.
    """

    def __init__(self) -> None:
        self._known: list[tuple[float, float]] = []

    def note(self, time_s: float, ratio: float) -> None:
        """Take the ratio at a time of the record."""
        if isfinite(ratio):
            self._known.append((time_s, ratio**-2))

    @property
    def left_s(self) -> float | None:
        """Time until the ratio is 1, by the latest half of the course; None: not known yet."""
        if len(self._known) < _FORECAST_FROM:
            return None
        (now_s, now), (then_s, then) = self._known[-1], self._known[len(self._known) // 2 - 1]
        if now >= 1.0:
            return 0.0
        return (1.0 - now) * (now_s - then_s) / (now - then) if now > then else None

    def hopeless(self, time_left_s: float) -> str:
        """Say why the time that is left will not do, and what would; empty if it may."""
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
    """Write a quantity for the table: ratios and frequencies as people read them."""
    if each.value is None or each.doubt:
        return each.doubt if each.doubt == _NOT_SEEN else "doubtful"
    scale, unit = (100.0, " %") if each.name.startswith("damping") else (1.0, "")
    half = scale * each.std
    return f"{with_half_width(scale * each.value, (-half, half))}{unit}"


def targets_json(found: Sequence[TargetEstimate]) -> list[dict[str, Any]]:
    """Return what is stated of what is asked for, as JSON documents have it.

    Parameters
    ----------
    found
        As of `target_estimates`.
    """
    return [
        {
            "name": each.name,
            "quantity": each.quantity,
            "mode": each.mode,
            "value": each.value,
            "std": each.std if isfinite(each.std) else None,
            "asked_std": each.asked_std if isfinite(each.asked_std) else None,
            "doubt": each.doubt,
        }
        for each in found
    ]


def in_words(found: Sequence[TargetEstimate]) -> str:
    """Say how precise everything is.

    Parameters
    ----------
    found
        What an estimate states.
    """
    return ", ".join(_one_in_words(each) for each in found)


def _one_in_words(each: TargetEstimate) -> str:
    if each.value is None or each.doubt:
        return f"{each.name}: {each.doubt}"
    return f"{each.name} {each.value:.5g}, standard deviation {with_share(each.std, each.value)}"
