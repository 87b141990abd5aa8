"""What a headline is worth against a truth that is known: coverage, widths and statements.

A headline is an object of `headlines` in the document of ``analyze --json``, the truth is a
`Truth`. Nothing is taken from the analyzer but the numbers that it prints.
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
"""Share of the 95 % intervals that has to hold the truth."""

NARROW, WIDE = 1.1, 2.5
"""Most that an interval may be wider than the true structure's own: of `CLOSE`, and of the rest."""

CLOSE = ("internal size", "external size", "f1", "xi1", "f2", "xi2", "loss factor")

LOSS_POINTS = 12
"""Frequencies at which a loss factor's curve is compared."""

_NORMAL_95 = 1.959963984540054

RELATIVE = frozenset({"internal size", "external size", "loss factor"})
"""Quantities whose widths compare relative to the value: they are not taken at one frequency."""

SILENT = frozenset({"not identifiable"})
"""What may be said of an order where one mode alone is seen: that nothing can be."""


@dataclass(frozen=True, slots=True)
class Told:
    """One number as printed, beside the truth.

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
        """Whether the interval holds the truth."""
        return self.interval is not None and self.interval[0] <= self.truth <= self.interval[1]

    @property
    def width(self) -> float:
        """Width of the interval; not a number without one."""
        return math.nan if self.interval is None else self.interval[1] - self.interval[0]

    @property
    def relative_width(self) -> float:
        """Width over the value."""
        return self.width / abs(self.value)

    @property
    def error(self) -> float:
        """Error in standard deviations, as far as the interval's width tells them."""
        return 2 * _NORMAL_95 * (self.value - self.truth) / self.width if self.width else 0.0


def told(headline: dict[str, Any], truth: Truth) -> list[Told]:
    """Collect every number of a headline with its truth.

    Parameters
    ----------
    headline : dict
        As the document has it.
    truth : Truth
    """
    numbers = [
        _told(name, truth.parameters[name], entry)
        for name, entry in headline["parameters"].items()
        if name in truth.parameters
    ]
    for size in headline["sizes"]:
        omega_rad_s = size["omega_rad_s"]
        of = truth.internal_loss if size["damping"] == "internal" else truth.external_loss
        coefficient = truth.zeta if size["damping"] == "internal" else truth.gamma
        true = coefficient if omega_rad_s is None else of(omega_rad_s)
        numbers.append(_told(f"{size['damping']} size", true, size))
    for mode in headline["modes"]:
        number = mode["mode"]
        numbers.append(_told(f"f{number}", truth.frequency_hz(number), mode["frequency_hz"]))
        numbers.append(_told(f"xi{number}", truth.damping_ratio(number), mode["damping_ratio"]))
    return numbers


def loss_frequencies_hz(curves: dict[str, Any]) -> NDArray[np.float64]:
    """Choose points of the loss factor's curve, as far as it rests on data.

    Parameters
    ----------
    curves : dict
        Curves of an object of `records` in the document.
    """
    chosen = _loss_places(curves)
    return np.array(curves["frequency_hz"], dtype=np.float64)[chosen]


def loss_told(curves: dict[str, Any], truth: Truth) -> list[Told]:
    """Collect the loss factor at these points.

    Parameters
    ----------
    curves : dict
    truth : Truth
    """
    factor, places = curves["loss_factor"], _loss_places(curves)
    true = truth.loss_factor(loss_frequencies_hz(curves))
    return [
        Told("loss factor", float(at), factor["value"][i], (factor["low"][i], factor["high"][i]))
        for i, at in zip(places, true, strict=True)
        if factor["value"][i] is not None and factor["low"][i] is not None
    ]


def _loss_places(curves: dict[str, Any]) -> list[int]:
    supported = curves["loss_factor_supported_hz"]
    if supported is None or curves["loss_factor"] is None:
        return []
    low_hz, high_hz = supported
    inside = [i for i, hz in enumerate(curves["frequency_hz"]) if low_hz <= hz <= high_hz]
    if len(inside) <= LOSS_POINTS:
        return inside
    return [inside[round(place)] for place in np.linspace(0, len(inside) - 1, LOSS_POINTS)]


def typical_width(numbers: Sequence[Told]) -> float | None:
    """Median width of one quantity's intervals, relative if it is of `RELATIVE`.

    Parameters
    ----------
    numbers : sequence of Told
    """
    widths = [
        each.relative_width if each.name in RELATIVE else each.width
        for each in numbers
        if each.interval is not None
    ]
    return median(widths) if widths else None


def share_held(numbers: Sequence[Told]) -> float | None:
    """Share of one quantity's intervals that hold the truth.

    Parameters
    ----------
    numbers : sequence of Told
    """
    known = [each.holds for each in numbers if each.interval is not None]
    return sum(known) / len(known) if known else None


def _told(name: str, truth: float, entry: dict[str, Any]) -> Told:
    ends = entry["interval_95"]
    known = None if ends is None or None in ends else (float(ends[0]), float(ends[1]))
    return Told(name, truth, float(entry["value"]), known, entry["flag"])


@dataclass(frozen=True, slots=True)
class Scored:
    """One session: what its headline said, and what the true structure's own fit would have.

    Attributes
    ----------
    cell : str
    seed : int
    cpu_s : float
        Processor time of the judgement.
    type : str
        Structure that the headline is of.
    told : tuple of Told
        Every number; of the loss factor several points.
    own : dict
        By name the width of the true structure's interval, of `RELATIVE` over the value.
    own_holds : dict
        By name the share of its intervals that hold the truth.
    contains : tuple of str
        Structures that the truth is a case of.
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
    told: tuple[Told, ...]
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
            Told(**{**each, "interval": each["interval"] and tuple(each["interval"])})
            for each in fields.pop("told")
        )
        contains = tuple(fields.pop("contains"))
        return cls(**fields, told=numbers, contains=contains)

    def line(self) -> str:
        """Write as one line of JSON."""
        return json.dumps(asdict(self), allow_nan=False)

    @property
    def excluded_falsely(self) -> list[str]:
        """Structures said to be excluded though the truth is a case of them."""
        return [name for name in self.contains if self.structures.get(name) == "excluded"]

    @property
    def fractional_falsely(self) -> list[str]:
        """Orders said to be fractional though they are 1."""
        return [
            order
            for order, (true, said, _) in self.orders.items()
            if said == "fractional" and true == 1
        ]

    @property
    def statements(self) -> list[str]:
        """Orders of which something is said."""
        return [order for order, (_, said, _) in self.orders.items() if said not in SILENT]


def containing(truth: Truth) -> tuple[str, ...]:
    """Structures that a truth with both kinds of damping is a case of, the narrowest first.

    Parameters
    ----------
    truth : Truth
        One whose beam is not uniform is a case of none.
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
    """95 % interval of a share (E. B. Wilson, JASA 22 (1927) 209-212).

    Parameters
    ----------
    hits : float
    of : int
    """
    if of == 0:
        return 0.0, 1.0
    z, share = _NORMAL_95, hits / of
    middle = (share + z * z / (2 * of)) / (1 + z * z / of)
    half = z / (1 + z * z / of) * math.sqrt(share * (1 - share) / of + z * z / (4 * of * of))
    return max(middle - half, 0.0), min(middle + half, 1.0)


@dataclass(frozen=True, slots=True)
class Score:
    """One quantity over the sessions of a cell.

    Attributes
    ----------
    held, facts : float, int
        Intervals without a flag that hold the truth, of how many sessions.
    held_flagged, flagged : float, int
        The same of those with a flag.
    without : int
        Sessions that gave no interval.
    wider : float or None
        Median of the width over that of the true structure's own fit, without a flag.
    bias : float or None
        Mean error in half widths over 1.96: in standard deviations, without a flag.
    own : float or None
        Share of the true structure's own intervals that hold the truth, on the same records: what
        an estimator that knew it would have got.
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
        """``<`` or ``>`` where the coverage is below or above what is asked for, beyond chance."""
        return _mark(self.held, self.facts)

    @property
    def mark_of_all(self) -> str:
        """The same of all intervals, with and without a flag.

        A flag that depends on the estimate leaves a selection behind, whose coverage is another.
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
    """Count how one quantity did.

    The loss factor's points are one error seen many times, so a session counts once, by the share
    of them whose interval holds the truth.

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
        its = [each for each in session.told if each.name == name]
        if not its:
            continue
        share, width = share_held(its), typical_width(its)
        if share is None or width is None:
            without += 1
            continue
        known = [each for each in its if each.interval is not None]
        if known[0].flag is not None:
            flagged += 1
            held_flagged += share
            continue
        facts += 1
        held += share
        errors.append(float(np.mean([each.error for each in known])))
        own, own_share = session.own.get(name), session.own_holds.get(name)
        if own:
            wider.append(width / own)
        if own_share is not None:
            owns.append(own_share)
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


def names_of(numbers: Iterable[Told]) -> list[str]:
    """Every quantity that was told, in the order in which it first was.

    Parameters
    ----------
    numbers : iterable of Told
    """
    return list(dict.fromkeys(each.name for each in numbers))


def _every(sessions: Iterable[Scored]) -> list[Told]:
    return [each for session in sessions for each in session.told]


def shown(cell: str, sessions: Sequence[Scored]) -> str:
    """Describe a cell: coverage, widths, statements.

    Parameters
    ----------
    cell : str
    sessions : sequence of Scored
    """
    lines = [f"{cell}: {len(sessions)} sessions, of {dict(Counter(s.type for s in sessions))}"]
    lines += [f"    {name:24} {score(name, sessions)}" for name in names_of(_every(sessions))]
    said = Counter(
        f"{order} {its[1]}" for session in sessions for order, its in session.orders.items()
    )
    lines.append(f"    said: {dict(said)}")
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
    """Write a table in Markdown: a row a quantity, a column a group of sessions.

    In each place: share of the 95 % intervals without a flag that hold the truth, with its 95 %
    interval; share of the sessions that give the quantity a flag, if any; median width over that of
    the true structure's own fit.

    Parameters
    ----------
    groups : dict
        Sessions by the name of their group.
    """
    names = names_of(_every(session for sessions in groups.values() for session in sessions))
    heads = [f"{group} ({len(sessions)})" for group, sessions in groups.items()]
    lines = ["| |" + "".join(f" {head} |" for head in heads), "|---" * (len(heads) + 1) + "|"]
    for name in names:
        places = (_place(score(name, sessions)) for sessions in groups.values())
        lines.append(f"| {name} |" + "".join(f" {place} |" for place in places))
    return "\n".join(lines)


def _place(its: Score) -> str:
    parts = []
    if its.facts:
        low, high = wilson(its.held, its.facts)
        share = 100 * its.held / its.facts
        parts.append(f"{share:.1f} % ({100 * low:.0f}–{100 * high:.0f})")
        if its.wider is not None:
            parts.append(f"× {its.wider:.2f}")
    if its.flagged:
        parts.append(f"flagged {100 * its.flagged / (its.flagged + its.facts + its.without):.0f} %")
    return ", ".join(parts) or "–"


def complaints(cells: dict[str, list[Scored]]) -> list[str]:
    """Say where what is asked for is missed: coverage beyond chance, widths, statements.

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
            found.append(f"orders told, {cell}: {spoken}/{len(sessions)}")
    return found
