"""Scores of the analyzer's document against the truth about a rig with a defect.

The truth is the document of `DefectRecord.truth`; the scored document is an object of `headlines`
as ``analyze --json`` prints it. Nothing else of the analyzer is used. A number is compared with the
range of true values (`Defect.ranges`): inside it the error is 0, outside it the distance to the
nearer end over the standard deviation that the 95 % interval implies on that side.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from statistics import median
from typing import Any, Literal

import numpy as np
from defect_records import clamp_loss_factor

Range = tuple[float, float]
Document = dict[str, Any]

FAR = 4.0
"""Error in standard deviations above which a number without a flag is wrong."""
DECIDED_ORDERS = ("compatible", "fractional")
"""Statuses of an order whose interval is stated as a fact."""
MATCHED = 0.1
"""Largest relative difference of frequency between a mode and its true one."""
LONGEST_S = 10.0
"""Largest allowed processor time of an analysis."""

_NORMAL_95 = 1.959963984540054
_STATED_OVER = 4.7e-3 / 0.090275
_STATED_STIFFNESS = 0.090275
_OF_EFFECT = {
    "delay": "delay_s",
    "tool inertia": "tool_inertia_kg_m2",
    "air drag": "drag_m",
}
"""True value with which the size of a named effect is compared."""

Group = Literal["mode", "parameter", "size", "exact geometry"]


@dataclass(frozen=True, slots=True)
class ScoredNumber:
    """A number of the document, and the range of true values.

    Attributes
    ----------
    name : str
    group : str
    truth : tuple of float
    value : float
    interval : tuple of float or None
        95 %.
    flag : str or None
    """

    name: str
    group: Group
    truth: Range
    value: float
    interval: Range | None
    flag: str | None

    @property
    def single(self) -> bool:
        """Whether there is one true value."""
        return self.truth[0] == self.truth[1]

    @property
    def inside(self) -> bool:
        """Whether the interval contains a true value."""
        return (
            self.interval is not None
            and self.interval[0] <= self.truth[1]
            and self.truth[0] <= self.interval[1]
        )

    @property
    def deviation(self) -> float:
        """Distance to the true values in standard deviations; 0 without an interval."""
        return _deviation(self.value, self.interval, self.truth)


@dataclass(frozen=True, slots=True)
class ScoredDefect:
    """Statements of the document of one record, compared with the truth.

    Attributes
    ----------
    seed : int
    kind : str
    linear_constant : bool
    coloured : bool
        Whether the noise is coloured.
    cpu_s : float
        Processor time of the analysis.
    type : str
        Structure of the headline.
    numbers : tuple of ScoredNumber
    not_given : tuple of int
        Visible modes without an unflagged entry.
    visible : int
        Count of visible modes.
    false_facts : tuple of str
    gate : str or None
        Status of the test for a uniform beam; None without one.
    gate_p : float or None
    shift : float or None
        Shift of the headline of a uniform beam by the defect, in standard deviations that include
        the tolerance of the geometry.
    exact_shift : float or None
        The same for exact geometry, with standard deviations about a tenth of those.
    error : str or None
        Reason if there is no document.
    """

    seed: int
    kind: str
    linear_constant: bool
    coloured: bool
    cpu_s: float
    type: str = ""
    numbers: tuple[ScoredNumber, ...] = ()
    not_given: tuple[int, ...] = ()
    visible: int = 0
    false_facts: tuple[str, ...] = ()
    gate: str | None = None
    gate_p: float | None = None
    shift: float | None = None
    exact_shift: float | None = None
    error: str | None = None

    @classmethod
    def from_line(cls, line: str) -> ScoredDefect:
        """Read a record written by `line`."""
        fields = json.loads(line)
        numbers = tuple(
            ScoredNumber(
                **{
                    **each,
                    "truth": tuple(each["truth"]),
                    "interval": each["interval"] and tuple(each["interval"]),
                }
            )
            for each in fields.pop("numbers")
        )
        lists = {name: tuple(fields.pop(name)) for name in ("not_given", "false_facts")}
        return cls(**fields, **lists, numbers=numbers)

    def line(self) -> str:
        """Write as one line of JSON."""
        return json.dumps(asdict(self))

    @property
    def wrong(self) -> tuple[ScoredNumber, ...]:
        """Numbers without a flag that are wrong by `FAR` standard deviations."""
        return tuple(
            each
            for each in self.numbers
            if each.flag is None and each.group != "exact geometry" and each.deviation > FAR
        )

    @property
    def moved(self) -> bool:
        """Whether the defect shifts the headline of a uniform beam by a standard deviation.

        Without a shift (rigs that are not linear and constant): whether a parameter without a flag
        is off by three standard deviations, which is improbable by noise alone.
        """
        return self._is_moved(self.shift, "parameter")

    @property
    def moved_exactly(self) -> bool:
        """Whether the defect shifts the result of a uniform beam with exact geometry."""
        return self._is_moved(self.exact_shift, "exact geometry")

    def _is_moved(self, shift: float | None, group: Group) -> bool:
        if shift is not None:
            return shift > 1
        stated = [each for each in self.numbers if each.group == group and each.flag is None]
        return any(each.deviation > 3 for each in stated)

    @property
    def modes(self) -> tuple[ScoredNumber, ...]:
        """Frequencies and damping ratios without a flag."""
        return tuple(each for each in self.numbers if each.group == "mode" and each.flag is None)


def score_document(truth: Document, headline: Document, cpu_s: float) -> ScoredDefect:
    """Compare a headline with the truth.

    Parameters
    ----------
    truth : dict
    headline : dict
    cpu_s : float
    """
    ranges = {name: (low, high) for name, (low, high) in truth["ranges"].items()}
    modes, not_given = _scored_modes(truth, headline)
    validity = headline.get("validity", {}).get("uniform_beam") or {}
    exact = headline.get("exact_geometry") or {}
    narrow, _ = _scored_modes(truth, exact)
    return ScoredDefect(
        seed=truth["seed"],
        kind=truth["kind"],
        linear_constant=truth["linear_constant"],
        coloured=bool(truth["noise"]["corner_hz"] or truth["noise"]["bumps"]),
        cpu_s=round(cpu_s, 3),
        type=headline["type"],
        numbers=(
            *modes,
            *_scored_parameters("parameter", headline["parameters"], ranges),
            *_scored_sizes(headline["sizes"], truth),
            *_scored_parameters("exact geometry", exact.get("parameters", {}), ranges),
            *(replace(each, group="exact geometry") for each in narrow),
        ),
        not_given=not_given,
        visible=sum(mode["visible"] for mode in truth["modes"]),
        false_facts=(
            *_false_orders(headline["orders"], truth, ranges),
            *_false_effects(headline["named"], truth, ranges),
            *_false_exclusions(headline, truth),
        ),
        gate=validity.get("status"),
        gate_p=validity.get("p_value"),
    )


def _scored(name: str, group: Group, entry: Document, truth: Range) -> ScoredNumber:
    ends = entry.get("interval_95")
    known = None if ends is None or None in ends else (float(ends[0]), float(ends[1]))
    value = entry["value"]
    if value is None:
        return ScoredNumber(name, group, truth, math.nan, None, entry.get("flag") or "no value")
    return ScoredNumber(name, group, truth, float(value), known, entry.get("flag"))


def _scored_modes(
    truth: Document, headline: Document
) -> tuple[list[ScoredNumber], tuple[int, ...]]:
    """Match modes by frequency; a mode is given if neither of its numbers has a flag."""
    numbers, given = [], set()
    for entry in headline.get("modes", ()):
        frequency = entry["frequency_hz"]
        if frequency["value"] is None:
            continue
        matched = _nearest(truth["modes"], entry["mode"], frequency["value"])
        if matched is None:
            continue
        pair = []
        for key, short in (("frequency_hz", "f"), ("damping_ratio", "xi")):
            before, after = matched[key], matched[f"later_{key}"]
            if before is None:
                continue
            ends = (before, before if after is None else after)
            name = f"{short}{matched['mode']}"
            pair.append(_scored(name, "mode", entry[key], (min(ends), max(ends))))
        numbers += pair
        flags = [entry[key].get("flag") for key in ("frequency_hz", "damping_ratio")]
        if not any(flags) and all(each.interval is not None for each in pair):
            given.add(matched["mode"])
    visible = (mode["mode"] for mode in truth["modes"] if mode["visible"])
    return numbers, tuple(number for number in visible if number not in given)


def _nearest(modes: Iterable[Document], number: int, frequency_hz: float) -> Document | None:
    """Return the true mode of nearest frequency; by number if the rig has no frequency."""
    best, distance = None, MATCHED
    for mode in modes:
        if mode["frequency_hz"] is None:
            if mode["mode"] == number:
                return mode
            continue
        off = abs(frequency_hz / mode["frequency_hz"] - 1)
        if off < distance:
            best, distance = mode, off
    return best


def _scored_parameters(
    group: Group, entries: Document, ranges: dict[str, Range]
) -> list[ScoredNumber]:
    return [
        _scored(name, group, entry, ranges[name])
        for name, entry in entries.items()
        if name in ranges
    ]


def _scored_sizes(entries: Iterable[Document], truth: Document) -> list[ScoredNumber]:
    """Compare losses at their pivots with those of laws with a single coefficient."""
    law, ranges = truth["law"], truth["ranges"]
    numbers = []
    for entry in entries:
        omega = entry["omega_rad_s"]
        internal = entry["damping"] == "internal"
        names = ("zeta", "alpha") if internal else ("gamma", "lambda", "density_over_stiffness")
        clamp = law.get("clamp") if internal else None
        if omega is None or (
            clamp is None
            and any(name not in ranges or ranges[name][0] != ranges[name][1] for name in names)
        ):
            continue
        coefficient, order = law[names[0]], law[names[1]]
        lost = coefficient * omega**order * math.sin(order * math.pi / 2)
        if not internal:
            lost /= _STATED_OVER * omega**2
        # The loss of a clamp acts like that of the material.
        more = 0.0 if clamp is None else float(clamp_loss_factor(tuple(clamp), np.array(omega)))
        numbers.append(_scored(f"{entry['damping']} size", "size", entry, (lost, lost + more)))
    return numbers


def _deviation(value: float, interval: Range | None, truth: Range) -> float:
    if interval is None or truth[0] <= value <= truth[1]:
        return 0.0
    distance, half = (
        (truth[0] - value, interval[1] - value)
        if value < truth[0]
        else (value - truth[1], value - interval[0])
    )
    return distance * _NORMAL_95 / half if half > 0 else math.inf


def _false_orders(entries: Document, truth: Document, ranges: dict[str, Range]) -> list[str]:
    """List orders stated as facts that are wrong."""
    found = []
    for order, entry in entries.items():
        status, interval = entry["status"], entry["interval_95"]
        if status not in DECIDED_ORDERS or interval is None or None in interval:
            continue
        low, high = interval
        true = ranges.get(order)
        relaxing = order == "alpha" and bool(truth["law"]["relaxations"])
        if status == "fractional" and (relaxing or (true and true[0] <= 1 <= true[1])):
            found.append(f"{order} fractional ({low:.3f} to {high:.3f})")
        elif true and _deviation((low + high) / 2, (low, high), true) > FAR:
            found.append(f"{order} {low:.3f} to {high:.3f}, true {true[0]:.3f} to {true[1]:.3f}")
    return found


def _false_effects(
    entries: Iterable[Document], truth: Document, ranges: dict[str, Range]
) -> list[str]:
    """List effects stated with an interval that the rig does not have, or has in another size."""
    found = []
    for entry in entries:
        what, value, interval = entry["what"], entry["value"], entry["interval_95"]
        if interval is None or value is None or None in interval:
            continue
        true = _true_size(entry, ranges)
        if true is not None:
            if what in truth["effects"]:
                # Its size is an idealisation: only its presence counts.
                continue
            if _deviation(value, (interval[0], interval[1]), true) > FAR:
                found.append(f"{what} {value:.4g}, true {true[0]:.4g} to {true[1]:.4g}")
        elif what not in truth["effects"]:
            found.append(f"{what} {value:.4g} ({interval[0]:.4g} to {interval[1]:.4g})")
    return found


def _true_size(entry: Document, ranges: dict[str, Range]) -> Range | None:
    if entry["what"] != "beam data":
        return ranges.get(_OF_EFFECT.get(entry["what"], ""))
    over = "rho/EI" in entry["sentence"]
    name = "density_over_stiffness" if over else "bending_stiffness_n_m2"
    stated = _STATED_OVER if over else _STATED_STIFFNESS
    low, high = ranges[name]
    return low / stated - 1, high / stated - 1


def _false_exclusions(headline: Document, truth: Document) -> list[str]:
    """List structures reported as excluded although they include the uniform beam."""
    if truth["kind"] != "none":
        return []
    law = truth["law"]
    contains = ["VI"]
    if law["alpha"] == 1:
        contains.append("VII")
        if law["lambda"] == 1:
            contains.append("III")
    status = {each["type"]: each["status"] for each in headline.get("structures", ())}
    return [f"type {name} excluded" for name in contains if status.get(name) == "excluded"]


# -------------------------------------------------------------------------------- totals


@dataclass(frozen=True, slots=True)
class Totals:
    """Counts over records.

    Attributes
    ----------
    records : int
    wrong : int
        Records with a number without a flag beyond `FAR` standard deviations.
    false : int
        Records with a false fact.
    linear : int
        Linear, constant rigs.
    not_given : int
        Of these, those with a visible mode that is missing or has a flag.
    inside, intervals : int
        Intervals of their modes that contain the true value, and all of them.
    wrong_modes : int
        Numbers of their modes beyond `FAR` standard deviations.
    refused, passed, tested : int
        Records by the gate's status.
    median_s, most_s : float
    """

    records: int
    wrong: int
    false: int
    linear: int
    not_given: int
    inside: int
    intervals: int
    wrong_modes: int
    refused: int
    passed: int
    tested: int
    median_s: float
    most_s: float


def totals(records: Sequence[ScoredDefect]) -> Totals:
    """Count over records; those without a document count as records whose modes are missing."""
    linear = [each for each in records if each.linear_constant]
    modes = [number for each in linear for number in each.modes if number.single]
    times = [each.cpu_s for each in records if each.error is None] or [0.0]
    return Totals(
        records=len(records),
        wrong=sum(bool(each.wrong) for each in records),
        false=sum(bool(each.false_facts) for each in records),
        linear=len(linear),
        not_given=sum(bool(each.not_given) or each.error is not None for each in linear),
        inside=sum(number.inside for number in modes),
        intervals=len(modes),
        wrong_modes=sum(number.deviation > FAR for number in modes),
        refused=sum(each.gate == "refused" for each in records),
        passed=sum(each.gate == "passed" for each in records),
        tested=sum(each.gate in ("refused", "passed") for each in records),
        median_s=median(times),
        most_s=max(times),
    )


def table(records: Sequence[ScoredDefect]) -> str:
    """Return a table in Markdown: a row for each kind, and a total."""
    heads = (
        "kind", "records", "beyond 4 std", "false fact", "a mode not given",
        "modes inside 95 %", "modes beyond 4 std", "gate refused", "median s", "most s",
    )  # fmt: skip
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    kinds = dict.fromkeys(each.kind for each in records)
    groups: list[tuple[str, Sequence[ScoredDefect]]] = [
        (kind, [each for each in records if each.kind == kind]) for kind in sorted(kinds)
    ]
    for name, group in (*groups, ("**all**", records)):
        its = totals(group)
        cells = (
            name,
            its.records,
            its.wrong,
            its.false,
            f"{its.not_given} of {its.linear}" if its.linear else "–",
            f"{its.inside} of {its.intervals}" if its.intervals else "–",
            its.wrong_modes if its.linear else "–",
            f"{its.refused} of {its.tested}" if its.tested else "–",
            f"{its.median_s:.2f}",
            f"{its.most_s:.2f}",
        )
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def coverage(records: Sequence[ScoredDefect]) -> str:
    """Return the coverage of the 95 % intervals of each quantity, on linear constant rigs."""
    lines = []
    for title, chosen in (
        ("controls", [each for each in records if each.kind == "none"]),
        ("linear, constant defects", [
            each for each in records if each.linear_constant and each.kind != "none"
        ]),
    ):  # fmt: skip
        numbers = [number for each in chosen for number in each.numbers if number.single]
        for group, name in dict.fromkeys((number.group, number.name) for number in numbers):
            its = [
                each for each in numbers
                if (each.group, each.name) == (group, name) and each.interval is not None
            ]  # fmt: skip
            facts = [each for each in its if each.flag is None]
            flagged = [each for each in its if each.flag is not None]
            lines.append(
                f"    {title}, {group} {name}: {sum(each.inside for each in facts)} of "
                f"{len(facts)}, worst {max((e.deviation for e in facts), default=0.0):.1f} std; "
                f"flagged {sum(each.inside for each in flagged)} of {len(flagged)}"
            )
    return "\n".join(lines)


def gate_passes(records: Sequence[ScoredDefect], *, exact: bool) -> tuple[int, int]:
    """Count the defects that shift a headline, or a value for exact geometry, significantly.

    Parameters
    ----------
    records : sequence of ScoredDefect
    exact : bool
        Whether values for exact geometry count instead of headlines.

    Returns
    -------
    tuple of int
        The number of those that pass the gate, and of all.
    """
    moving = [
        each for each in records
        if each.kind != "none" and each.gate in ("refused", "passed")
        and (each.moved_exactly if exact else each.moved)
    ]  # fmt: skip
    return sum(each.gate == "passed" for each in moving), len(moving)


def complaints(records: Sequence[ScoredDefect]) -> list[str]:
    """List the limits that records exceed; each allows one of a few records beyond it."""
    its = totals(records)
    controls = totals([each for each in records if each.kind == "none"])
    passed, moved = gate_passes(records, exact=False)
    limits = (
        ("records with a number beyond 4 std and no flag", its.wrong, 0.05 * its.records),
        ("records with a false fact", its.false, 0.02 * its.records),
        ("uniform beams refused by the gate", controls.refused, controls.tested / 30),
        ("defects that move a headline by 1 std and pass the gate", passed, 0.05 * moved),
    )
    found = [
        f"{what}: {count}, at most {limit:.3g}"
        for what, count, limit in limits
        if count > math.ceil(limit)
    ]
    if its.not_given:
        found.append(f"linear rigs of which a visible mode is not given: {its.not_given}, none")
    if its.wrong_modes:
        found.append(f"modes of linear rigs beyond 4 std: {its.wrong_modes}, none")
    if its.inside < math.floor(0.93 * its.intervals):
        found.append(f"modes of linear rigs inside: {its.inside} of {its.intervals}, 93 %")
    if its.most_s > LONGEST_S:
        found.append(f"longest judgement: {its.most_s:.1f} s of processor, {LONGEST_S:g} s")
    errors = [each.seed for each in records if each.error is not None]
    if errors:
        found.append(f"records without a result: seeds {errors}")
    return found
