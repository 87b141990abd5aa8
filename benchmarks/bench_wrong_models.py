"""Results of the analyzer on records of rigs that violate its assumptions.

``bench_wrong_models.py [--records N] [--defect TEXT ...] [--rig NAME ...]`` makes N records of each
defect (those whose names contain one of the texts; without texts, every fourth) on its rigs in
turn, at least one on each, and analyses them. It prints a line for each defect: the number of
records whose residual is reported as noise, the named effects, and the worst error of a number
without a flag, in its standard deviations. ``--say`` prints the verdict on each record.
"""

from __future__ import annotations

import argparse
import math
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

from gate import Gate, Row, percent
from wrong_models import DEFECTS, RIGS, Record

from analysis.identify import Selection, select
from rigd.estimates import Estimate

ROWS = (
    # Measured 3.6: docs/validation/structure_selection.md.
    Row("worst error without a flag", most=5, unit="standard deviations"),
    Row("defects that are named or leave an unexplained residual", least=80, unit="%"),
    Row("sound records of which something is named", most=0, unit="%"),
)
SOUND = "none"
DEFAULT_STEP = 4
"""Without names, every fourth defect is evaluated; the first is the sound rig."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Verdict of the analyzer on one record."""

    selection: Selection
    errors: dict[str, float]
    cpu_s: float

    @classmethod
    def of(cls, made: Record) -> Verdict:
        """Analyse a record."""
        measurement = made.measurement()
        start = time.process_time()
        selection = select(measurement)
        cpu_s = time.process_time() - start
        return cls(selection, dict(errors_of(made, selection)), cpu_s)

    @property
    def worst(self) -> tuple[float, str]:
        """Largest error of a number without a flag, and the name of the number."""
        return max(((abs(e), name) for name, e in self.errors.items()), default=(0.0, "nothing"))


def errors_of(made: Record, selection: Selection) -> Iterator[tuple[str, float]]:
    """Yield name and error of numbers without a flag, in standard deviations.

    A frequency that changes during the sweep has no single true value.
    """
    headline = selection.headline
    for name, true in made.rig.parameters.items():
        if name in headline.parameters:
            yield from _error(name, headline.parameters[name], true)
    for mode, true in zip(headline.modes, made.rig.damping_ratios.tolist(), strict=False):
        yield from _error(f"xi{mode.number}", mode.damping_ratio, true)
    if made.frequencies_change:
        return
    for mode, pole in zip(headline.modes, made.rig.poles().tolist(), strict=False):
        yield from _error(f"f{mode.number}", mode.frequency_hz, pole.imag / (2 * math.pi))


def _error(name: str, quantity: Estimate, true: float) -> Iterator[tuple[str, float]]:
    if quantity.flag is None and quantity.std:
        yield name, (quantity.value - true) / quantity.std


def main() -> None:
    """Evaluate the requested records and check the limits."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--records", type=int, default=1, help="of each defect")
    parser.add_argument("--first", type=int, default=0, help="seed of the first")
    parser.add_argument("--defect", nargs="+", help="only those that hold this text")
    parser.add_argument("--rig", nargs="+", choices=list(RIGS), default=list(RIGS))
    parser.add_argument("--say", action="store_true", help="print every verdict")
    gate = Gate(ROWS, parser)
    given = gate.given
    every: dict[str, list[Verdict]] = {}
    defects = list(DEFECTS)[::DEFAULT_STEP]
    if given.defect:
        defects = [name for name in DEFECTS if any(text in name for text in given.defect)]
    print(
        "| defect | explained, nothing more asked for | named | worst error without a flag "
        "| CPU s |"
    )
    print("|---|---|---|---|---|")
    for defect in defects:
        rigs, make = DEFECTS[defect]
        verdicts = []
        chosen = [name for name in rigs if name in given.rig]
        for name in chosen:
            count = math.ceil(given.records / len(chosen))
            for seed in range(given.first, given.first + count):
                one = Verdict.of(make(RIGS[name], seed))
                verdicts.append(one)
                if given.say:
                    _say(f"{defect}, {name}, {seed}", one)
        if verdicts:
            every[defect] = verdicts
            _show(defect, verdicts)
    records = [each for of_defect in every.values() for each in of_defect]
    gate.measured("worst error without a flag", max(each.worst for each in records)[0])
    seen = {
        sound: [
            bool(each.selection.verdict.findings) or not each.selection.verdict.adequate
            for defect, verdicts in every.items()
            if (defect == SOUND) is sound
            for each in verdicts
        ]
        for sound in (False, True)
    }
    gate.measured(
        "defects that are named or leave an unexplained residual",
        percent(sum(seen[False]), len(seen[False])),
    )
    if seen[True] or not given.defect:
        gate.measured(
            "sound records of which something is named", percent(sum(seen[True]), len(seen[True]))
        )
    gate.finish(part=bool(given.defect))


def _say(title: str, one: Verdict) -> None:
    print(f"\n{title}: {one.selection.candidates[0].name}, {one.cpu_s:.1f} s")
    for sentence in one.selection.verdict.sentences:
        print(f"    {sentence}")
    print("   ", ", ".join(f"{name} {error:+.1f}" for name, error in one.errors.items()))
    for row in one.selection.verdict.table[:6]:
        print("   ", row)


def _show(defect: str, verdicts: list[Verdict]) -> None:
    white = sum(one.selection.verdict.adequate for one in verdicts)
    named = Counter(
        kind
        for one in verdicts
        for kind in dict.fromkeys(f.kind for f in one.selection.verdict.findings)
    )
    names = ", ".join(f"{kind} {count}" for kind, count in named.most_common()) or "nothing"
    sure = sum("no unmodelled effect" in " ".join(o.selection.verdict.sentences) for o in verdicts)
    worst, what = max(one.worst for one in verdicts)
    cpu_s = max(one.cpu_s for one in verdicts)
    print(
        f"| {defect} | {white}, {sure} of {len(verdicts)} | {names} | {worst:.1f} ({what}) "
        f"| {cpu_s:.1f} |",
        flush=True,
    )


if __name__ == "__main__":
    main()
