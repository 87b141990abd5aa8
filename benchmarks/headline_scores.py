"""Scores of a headline against the known truth: coverage, widths and statements.

A headline is an object of `headlines` in the document of ``analyze --json``, the truth is a
`Truth`. Only the printed numbers of the analyzer are used.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from dataclasses import asdict, dataclass
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from independent_records import Truth
    from numpy.typing import NDArray

    Interval = tuple[float, float]

LEAST, MOST = 0.90, 0.99
"""Required range of the fraction of 95 % intervals that contain the true value."""

NARROW, WIDE = 1.1, 2.5
"""Largest width over that of a fit with the true structure: of `CLOSE`, and of the rest."""

CLOSE = ("internal size", "external size", "f1", "xi1", "f2", "xi2", "loss factor")

LOSS_POINTS = 12
"""Number of frequencies at which the curve of the loss factor is compared."""

_NORMAL_95 = 1.959963984540054

RELATIVE = frozenset({"internal size", "external size", "loss factor"})
"""Quantities compared by relative width, because they refer to different frequencies."""

SILENT = frozenset({"not identifiable"})
"""Only status of an order allowed if a single mode is visible."""


@dataclass(frozen=True, slots=True)
class ReportedNumber:
    """One printed number, with its true value.

    Attributes
    ----------
    name : str
    truth, value : float
    interval : tuple of float or None
        95 %.
    flag : str or None
        As printed; None if the number counts as a fact.
    """

    name: str
    truth: float
    value: float
    interval: Interval | None
    flag: str | None = None

    @property
    def holds(self) -> bool:
        """Whether the interval contains the true value."""
        return self.interval is not None and self.interval[0] <= self.truth <= self.interval[1]

    @property
    def width(self) -> float:
        """Width of the interval; NaN without one."""
        return math.nan if self.interval is None else self.interval[1] - self.interval[0]

    @property
    def relative_width(self) -> float:
        """Width over the value."""
        return self.width / abs(self.value)

    @property
    def error(self) -> float:
        """Error in standard deviations, which follow from the width of the interval."""
        return 2 * _NORMAL_95 * (self.value - self.truth) / self.width if self.width else 0.0


def headline_numbers(headline: dict[str, Any], truth: Truth) -> list[ReportedNumber]:
    """Return every number of a headline with its true value.

    Parameters
    ----------
    headline : dict
        Object of `headlines` in the document.
    truth : Truth
    """
    numbers = [
        _reported_number(name, truth.parameters[name], entry)
        for name, entry in headline["parameters"].items()
        if name in truth.parameters
    ]
    for size in headline["sizes"]:
        omega_rad_s = size["omega_rad_s"]
        of = truth.internal_loss if size["damping"] == "internal" else truth.external_loss
        coefficient = truth.zeta if size["damping"] == "internal" else truth.gamma
        true = coefficient if omega_rad_s is None else of(omega_rad_s)
        numbers.append(_reported_number(f"{size['damping']} size", true, size))
    for mode in headline["modes"]:
        number = mode["mode"]
        numbers.append(
            _reported_number(f"f{number}", truth.frequency_hz(number), mode["frequency_hz"])
        )
        numbers.append(
            _reported_number(f"xi{number}", truth.damping_ratio(number), mode["damping_ratio"])
        )
    return numbers


def loss_frequencies_hz(curves: dict[str, Any]) -> NDArray[np.float64]:
    """Choose frequencies on the loss factor's curve within the band supported by data.

    Parameters
    ----------
    curves : dict
        Curves of an object of `records` in the document.
    """
    chosen = _loss_indices(curves)
    return np.array(curves["frequency_hz"], dtype=np.float64)[chosen]


def loss_factor_numbers(curves: dict[str, Any], truth: Truth) -> list[ReportedNumber]:
    """Return the loss factor at the frequencies of `loss_frequencies_hz`.

    Parameters
    ----------
    curves : dict
    truth : Truth
    """
    factor, indices = curves["loss_factor"], _loss_indices(curves)
    true = truth.loss_factor(loss_frequencies_hz(curves))
    return [
        ReportedNumber(
            "loss factor", float(at), factor["value"][i], (factor["low"][i], factor["high"][i])
        )
        for i, at in zip(indices, true, strict=True)
        if factor["value"][i] is not None and factor["low"][i] is not None
    ]


def _loss_indices(curves: dict[str, Any]) -> list[int]:
    supported = curves["loss_factor_supported_hz"]
    if supported is None or curves["loss_factor"] is None:
        return []
    low_hz, high_hz = supported
    inside = [i for i, hz in enumerate(curves["frequency_hz"]) if low_hz <= hz <= high_hz]
    if len(inside) <= LOSS_POINTS:
        return inside
    return [inside[round(position)] for position in np.linspace(0, len(inside) - 1, LOSS_POINTS)]


def typical_width(numbers: Sequence[ReportedNumber]) -> float | None:
    """Return the median width of one quantity's intervals, relative if it is in `RELATIVE`.

    Parameters
    ----------
    numbers : sequence of ReportedNumber
    """
    widths = [
        each.relative_width if each.name in RELATIVE else each.width
        for each in numbers
        if each.interval is not None
    ]
    return median(widths) if widths else None


def interval_coverage(numbers: Sequence[ReportedNumber]) -> float | None:
    """Return the fraction of one quantity's intervals that contain the true value.

    Parameters
    ----------
    numbers : sequence of ReportedNumber
    """
    known = [each.holds for each in numbers if each.interval is not None]
    return sum(known) / len(known) if known else None


def _reported_number(name: str, truth: float, entry: dict[str, Any]) -> ReportedNumber:
    ends = entry["interval_95"]
    known = None if ends is None or None in ends else (float(ends[0]), float(ends[1]))
    return ReportedNumber(name, truth, float(entry["value"]), known, entry["flag"])


@dataclass(frozen=True, slots=True)
class Scored:
    """Numbers and statements of one session, and the widths of a fit with the true structure.

    Attributes
    ----------
    cell : str
    seed : int
    cpu_s : float
        Processor time of the analysis.
    type : str
        Structure that the headline is of.
    numbers : tuple of ReportedNumber
        Every number; several points of the loss factor.
    own : dict
        By name the width of the interval with the true structure, for `RELATIVE` over the value.
    own_holds : dict
        By name the fraction of these intervals that contain the true value.
    contains : tuple of str
        Structures that include the truth.
    structures : dict
        Status by name.
    orders : dict
        By name: true value, status, interval or None.
    named : list of str
        Other effects found.
    """

    cell: str
    seed: int
    cpu_s: float
    type: str
    numbers: tuple[ReportedNumber, ...]
    own: dict[str, float | None]
    own_holds: dict[str, float | None]
    contains: tuple[str, ...]
    structures: dict[str, str]
    orders: dict[str, list[Any]]
    named: list[str]

    @classmethod
    def from_line(cls, line: str) -> Scored:
        """Read a session that was written by `line`."""
        fields = json.loads(line)
        numbers = tuple(
            ReportedNumber(**{**each, "interval": each["interval"] and tuple(each["interval"])})
            for each in fields.pop("numbers")
        )
        contains = tuple(fields.pop("contains"))
        return cls(**fields, numbers=numbers, contains=contains)

    def line(self) -> str:
        """Write as one line of JSON."""
        return json.dumps(asdict(self), allow_nan=False)

    @property
    def excluded_falsely(self) -> list[str]:
        """Structures reported as excluded although they include the truth."""
        return [name for name in self.contains if self.structures.get(name) == "excluded"]

    @property
    def fractional_falsely(self) -> list[str]:
        """Orders reported as fractional although they are 1."""
        return [
            order
            for order, (true, status, _) in self.orders.items()
            if status == "fractional" and true == 1
        ]

    @property
    def statements(self) -> list[str]:
        """Orders with a status other than `SILENT`."""
        return [order for order, (_, status, _) in self.orders.items() if status not in SILENT]


def containing(truth: Truth) -> tuple[str, ...]:
    """Return the structures that include a truth with both kinds of damping, the narrowest first.

    Parameters
    ----------
    truth : Truth
        No structure includes a beam that is not uniform.
    """
    if any(truth.offsets):
        return ()
    types = ["VI"]
    if truth.alpha == 1:
        types.insert(0, "VII")
        if truth.lambda_ == 1:
            types.insert(0, "III")
    return tuple(types)


def wilson(hits: float, of: int) -> Interval:
    """Return the 95 % interval of a proportion (E. B. Wilson, JASA 22 (1927) 209-212).

    Parameters
    ----------
    hits : float
    of : int
    """
    if of == 0:
        return 0.0, 1.0
    z, fraction = _NORMAL_95, hits / of
    middle = (fraction + z * z / (2 * of)) / (1 + z * z / of)
    half = z / (1 + z * z / of) * math.sqrt(fraction * (1 - fraction) / of + z * z / (4 * of * of))
    return max(middle - half, 0.0), min(middle + half, 1.0)


@dataclass(frozen=True, slots=True)
class Score:
    """Score of one quantity over the sessions of a cell.

    Attributes
    ----------
    held, facts : float, int
        Intervals without a flag that contain the true value, and the number of sessions with one.
    held_flagged, flagged : float, int
        The same for intervals with a flag.
    without : int
        Sessions without an interval.
    wider : float or None
        Median of the width over that of a fit with the true structure, without a flag.
    bias : float or None
        Mean error in half widths over 1.96: in standard deviations, without a flag.
    own : float or None
        Coverage of the intervals of fits with the true structure, on the same records.
    """

    held: float
    facts: int
    held_flagged: float
    flagged: int
    without: int
    wider: float | None
    bias: float | None
    own: float | None

    @property
    def mark(self) -> str:
        """``<`` or ``>`` if the coverage is significantly below or above the required range."""
        return _mark(self.held, self.facts)

    @property
    def mark_of_all(self) -> str:
        """The same for all intervals, with and without a flag.

        If the flag depends on the estimate, intervals without one are a selection with another
        coverage.
        """
        return _mark(self.held + self.held_flagged, self.facts + self.flagged)

    def __str__(self) -> str:
        if self.facts:
            low, high = wilson(self.held, self.facts)
            text = f"{self.held:.3g}/{self.facts} [{100 * low:.0f}, {100 * high:.0f}]{self.mark}"
        else:
            text = "-"
        if self.mark and self.own is not None:
            text += f" own {100 * self.own:.0f} %"
        if self.wider is not None:
            text += f" x{self.wider:.2f}"
        if self.bias is not None:
            text += f" {self.bias:+.2f}"
        if self.flagged:
            text += f" (flagged {self.held_flagged:.3g}/{self.flagged}){self.mark_of_all}"
        if self.without:
            text += f" (none {self.without})"
        return text


def _mark(held: float, count: int) -> str:
    low, high = wilson(held, count)
    return "<" if high < LEAST else ">" if low > MOST else ""


def score(name: str, sessions: Iterable[Scored]) -> Score:
    """Score one quantity.

    The errors at the points of the loss factor are correlated, so a session counts once, by the
    fraction of its points whose interval contains the true value.

    Parameters
    ----------
    name : str
    sessions : iterable of Scored
    """
    held = held_flagged = 0.0
    facts = flagged = without = 0
    wider: list[float] = []
    errors: list[float] = []
    owns: list[float] = []
    for session in sessions:
        its = [each for each in session.numbers if each.name == name]
        if not its:
            continue
        coverage, width = interval_coverage(its), typical_width(its)
        if coverage is None or width is None:
            without += 1
            continue
        known = [each for each in its if each.interval is not None]
        if known[0].flag is not None:
            flagged += 1
            held_flagged += coverage
            continue
        facts += 1
        held += coverage
        errors.append(float(np.mean([each.error for each in known])))
        own, own_coverage = session.own.get(name), session.own_holds.get(name)
        if own:
            wider.append(width / own)
        if own_coverage is not None:
            owns.append(own_coverage)
    return Score(
        held,
        facts,
        held_flagged,
        flagged,
        without,
        median(wider) if wider else None,
        float(np.mean(errors)) if errors else None,
        float(np.mean(owns)) if owns else None,
    )


def names_of(numbers: Iterable[ReportedNumber]) -> list[str]:
    """Return the names of all reported quantities, in order of their first occurrence.

    Parameters
    ----------
    numbers : iterable of ReportedNumber
    """
    return list(dict.fromkeys(each.name for each in numbers))


def _every(sessions: Iterable[Scored]) -> list[ReportedNumber]:
    return [each for session in sessions for each in session.numbers]


def shown(cell: str, sessions: Sequence[Scored]) -> str:
    """Describe a cell: coverage, widths, statements.

    Parameters
    ----------
    cell : str
    sessions : sequence of Scored
    """
    lines = [f"{cell}: {len(sessions)} sessions, of {dict(Counter(s.type for s in sessions))}"]
    lines += [f"    {name:24} {score(name, sessions)}" for name in names_of(_every(sessions))]
    statuses = Counter(
        f"{order} {its[1]}" for session in sessions for order, its in session.orders.items()
    )
    lines.append(f"    orders: {dict(statuses)}")
    for what, count in (
        ("excluded falsely", sum(bool(s.excluded_falsely) for s in sessions)),
        ("fractional though 1", sum(bool(s.fractional_falsely) for s in sessions)),
    ):
        low, high = wilson(count, len(sessions))
        lines.append(f"    {what} {count}/{len(sessions)} [{100 * low:.1f}, {100 * high:.1f}] %")
    named = Counter(what for session in sessions for what in session.named)
    cpu_s = sorted(session.cpu_s for session in sessions)
    lines.append(f"    named {dict(named)}; CPU s median {median(cpu_s):.2f}, most {cpu_s[-1]:.2f}")
    return "\n".join(lines)


def table(groups: dict[str, list[Scored]]) -> str:
    """Return a table in Markdown: a row for each quantity, a column for each group of sessions.

    An entry has the percentage of the 95 % intervals without a flag that contain the true value,
    with its 95 % interval; the median width over that of a fit with the true structure; and the
    percentage of sessions in which the quantity has a flag, if any.

    Parameters
    ----------
    groups : dict
        Sessions by the name of their group.
    """
    names = names_of(_every(session for sessions in groups.values() for session in sessions))
    heads = [f"{group} ({len(sessions)})" for group, sessions in groups.items()]
    lines = ["| |" + "".join(f" {head} |" for head in heads), "|---" * (len(heads) + 1) + "|"]
    for name in names:
        entries = (_table_entry(score(name, sessions)) for sessions in groups.values())
        lines.append(f"| {name} |" + "".join(f" {entry} |" for entry in entries))
    return "\n".join(lines)


def _table_entry(its: Score) -> str:
    parts = []
    if its.facts:
        low, high = wilson(its.held, its.facts)
        percentage = 100 * its.held / its.facts
        parts.append(f"{percentage:.1f} % ({100 * low:.0f}–{100 * high:.0f})")
        if its.wider is not None:
            parts.append(f"× {its.wider:.2f}")
    if its.flagged:
        parts.append(f"flagged {100 * its.flagged / (its.flagged + its.facts + its.without):.0f} %")
    return ", ".join(parts) or "–"


def complaints(cells: dict[str, list[Scored]]) -> list[str]:
    """Return the requirements that are not met: coverage, widths, statements.

    Parameters
    ----------
    cells : dict
        Sessions by cell.
    """
    found = []
    for cell, sessions in cells.items():
        for name in names_of(_every(sessions)):
            its = score(name, sessions)
            limit = NARROW if name in CLOSE else WIDE
            if its.mark:
                found.append(f"coverage of {name}, {cell}: {its}")
            if its.wider is not None and its.wider > limit:
                found.append(f"width of {name}, {cell}: {its.wider:.2f} > {limit:g}")
        for what, count in (
            ("excluded falsely", sum(bool(s.excluded_falsely) for s in sessions)),
            ("fractional though 1", sum(bool(s.fractional_falsely) for s in sessions)),
        ):
            if wilson(count, len(sessions))[0] > 0.01:
                found.append(f"{what}, {cell}: {count}/{len(sessions)}")
        silent_cell = cell.startswith("one mode")
        spoken = sum(bool(session.statements) for session in sessions)
        if silent_cell and spoken:
            found.append(f"orders stated, {cell}: {spoken}/{len(sessions)}")
    return found
