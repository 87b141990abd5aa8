"""Whether campaigns of one beam are taken as one specimen, and those of two beams as two.

``bench_specimens.py [--times N] [--records N] [--noise-nm NM] [--apart RATIO] [--first SEED]``
writes session files of exact records (`independent_records.py`, alpha 0.996), each with different
noise: N campaigns (1) of one beam, then one whose second half is of a beam with frequencies higher
by a relative difference. Each is evaluated by `campaign`, as by `analyze FILES`. A line for each
campaign: the structures selected by its sessions, whether it is called a mixture, by which test and
in which groups, the least p-value, and the worst error of the pooled numbers in their standard
deviations.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

from gate import Gate, Row, percent
from independent_records import (
    AMPLITUDE_RAD,
    FIRST_HZ,
    LAST_HZ,
    RATE_HZ,
    REST_S,
    SWEEP_S,
    Exact,
    Truth,
    exact,
)

from analysis.campaigns import CampaignResult, campaign
from rigd.runtime.background import use_one_thread
from rigd.testing import Signals, write_session

ROWS = (
    # Measured 0 of 5, 1 of 1, and 2.3 at most: docs/validation/campaigns.md.
    Row("campaigns of one beam called mixed", most=0, unit="%"),
    Row("campaigns of two beams called mixed", least=100, unit="%"),
    Row("worst error of pooled numbers", most=4, unit="standard deviations"),
    Row("sessions left out", most=0),
)
BEAM = Truth(zeta=7.1e-5, alpha=0.996, gamma=5.5e-2, lambda_=0.594)


@dataclass(frozen=True, slots=True)
class Case:
    """A campaign: the exact record of each session."""

    name: str
    records: tuple[Exact, ...]


def written(case: Case, noise_nm: float, first_seed: int, folder: Path) -> list[Path]:
    """Write the sessions of a campaign, each with different noise."""
    rest, sweep = round(REST_S * RATE_HZ), round(SWEEP_S * RATE_HZ)
    paths = []
    for number, record in enumerate(case.records):
        angle_rad, torque_nm = record.noisy(noise_nm, first_seed + number)
        segments = {
            "rest": (0, rest),
            "sweep": (rest, rest + sweep),
            "ring_down": (rest + sweep, angle_rad.size),
        }
        stated = {
            "excitation": "chirp",
            "amplitude_rad": repr(AMPLITUDE_RAD),
            "start_hz": repr(FIRST_HZ),
            "stop_hz": repr(LAST_HZ),
            "duration_s": repr(SWEEP_S),
        }
        signals = Signals(record.reference_rad, angle_rad, torque_nm, segments, RATE_HZ, stated)
        paths.append(write_session(folder / f"{number:03}.mcap", signals))
    return paths


def line(case: Case, found: CampaignResult) -> str:
    """Return the result of a campaign as a row."""
    verdict, alike = found.verdict, found.homogeneity
    if verdict is None:
        return f"| {case.name} | no verdict |"
    alone = ", ".join(f"{name} {count}" for name, count in verdict.alone.items())
    least = min(each.p_value for each in alike.quantities)
    mixed = "no"
    if (leading := alike.leading_scatter) is not None:
        sizes = " and ".join(str(len(group)) for group in leading.session_groups)
        stds = f"{leading.relative_between_session_std:.0f} std"
        mixed = f"yes, {sizes or 'no groups'}, by {leading.quantity} ({stds})"
    worst = "" if alike.is_mixture else f"{worst_error(case, found):.1f}"
    lost = len(found.failures) + len(found.failed_predictions)
    return (
        f"| {case.name} | {alone} | {mixed} | {least:.2g} of {len(alike.quantities)} "
        f"| {worst} | {lost} |"
    )


def worst_error(case: Case, found: CampaignResult) -> float:
    """Return the largest error of the pooled parameters, in their standard deviations."""
    estimate, truth = found.freest, case.records[0].truth.parameters
    assert estimate is not None
    return max(
        abs(each.value - truth[each.name]) / each.std
        for each in estimate.parameters
        if each.name in truth and each.std
    )


def main() -> None:
    """Evaluate the requested campaigns and check the limits."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--times", type=int, default=1, help="campaigns of one beam")
    parser.add_argument("--records", type=int, default=8, help="of each campaign")
    parser.add_argument("--noise-nm", type=float, default=5e-3, help="of the torque")
    parser.add_argument(
        "--apart", type=float, default=5e-4, help="relative difference of two beams"
    )
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--jobs", type=int, default=1)
    gate = Gate(ROWS, parser)
    given = gate.given
    use_one_thread()
    one = exact(BEAM)
    faster = BEAM.density_over_stiffness / (1 + given.apart) ** 2
    other = exact(replace(BEAM, density_over_stiffness=faster))
    half = given.records // 2
    cases = [Case("one beam", (one,) * given.records) for _ in range(given.times)]
    two = (one,) * half + (other,) * (given.records - half)
    cases.append(Case(f"two beams, {given.apart:.2%} apart", two))
    print("| campaign | alone | called mixed | least p | worst error pooled | left out |")
    print("|---|---|---|---|---|---|")
    results: list[CampaignResult] = []
    for number, case in enumerate(cases):
        with tempfile.TemporaryDirectory() as name:
            paths = written(case, given.noise_nm, given.first + number * given.records, Path(name))
            begun = time.perf_counter()
            found = campaign(paths, jobs=given.jobs)
        print(line(case, found), f"{time.perf_counter() - begun:.0f} s", flush=True)
        results.append(found)
    *ones, mixed = (each.homogeneity.is_mixture for each in results)
    gate.measured("campaigns of one beam called mixed", percent(sum(ones), len(ones)))
    gate.measured("campaigns of two beams called mixed", percent(mixed, 1))
    worst = [
        worst_error(case, each)
        for case, each in zip(cases, results, strict=True)
        if not each.homogeneity.is_mixture
    ]
    gate.measured("worst error of pooled numbers", max(worst, default=math.nan))
    lost = sum(len(each.failures) + len(each.failed_predictions) for each in results)
    gate.measured("sessions left out", lost)
    gate.finish()


if __name__ == "__main__":
    main()
