"""Reproduction of oddities in the paper's results: its method on beams with known parameters.

The program prints the tables of ``docs/validation/paper_method.md``, part by part (``--part``);
with ``--figures DIR`` it also draws the figures of that page there. The tables are of 20 sessions
of each of two beams, which take some five minutes; without ``--sessions`` there are 3.

The beams are the paper's link with internal damping of order 1. In the second one the stiffness of
the modes is off by +0.6, +0.5 and -1.3 %, as in a link that is not quite uniform. The sessions are
those of ``exact_sessions.py``.
"""

import argparse
import csv
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import oddities_figures as draw
from exact_sessions import LINK, Session, session
from gate import Gate, Row
from numpy.typing import NDArray

from analysis.identify import RecordFit, Selection, fit_record, select
from analysis.models import STRUCTURES
from analysis.paper import fit_many
from rigd.beam import Beam, Damping, Plant, ResponseGrid, modes
from rigd.spectral import FrequencyResponse, Segmentation, segment_count

DAMPING = Damping(zeta=7.1e-5, alpha=1.0, gamma=5.5e-2, lambda_=0.594)
NOT_UNIFORM = Plant(
    # Mode 1 has the stiffness of the beam, the others are relative to it.
    Beam(0.98, 4.7e-3, 0.090275 * 1.006),
    DAMPING,
    stiffness_offsets=(1.005 / 1.006 - 1, 0.987 / 1.006 - 1),
)
PLANTS = {"uniform": Plant(LINK, DAMPING), "not uniform": NOT_UNIFORM}
ROWS = (
    # Measured 7.7, 8.3, 1.463, 0.985, 0.13 (-17.6 dB) and 626: docs/validation/paper_method.md.
    Row("zeta of I, omega over const, beam not uniform", least=6, most=10),
    Row("zeta of IV, omega over const, beam not uniform", least=6, most=10),
    Row("alpha of VI with const weights, beam not uniform", least=1.35, most=1.6),
    Row("alpha of VI with const weights, uniform beam", least=0.95, most=1.05),
    Row("whole record: worst mode without a flag", most=4.5, unit="standard deviations"),
    Row("whole record, first peak: worst damping ratio", most=4.5, unit="standard deviations"),
    Row("Welch's first peak at a twentieth of the damping", most=0.2, unit="times the true one"),
    Row("cost of VI with a sample of overlap less", least=100, unit="times that of the paper's"),
)
TYPES = ("I", "II", "III", "IV", "V", "VI")
EXTERNAL = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 4.0)
"""External damping of the beams of `first_peaks`, relative to that of `DAMPING`."""

PAPER_TABLE3 = Path(__file__).parents[1] / "analysis" / "report" / "data" / "paper_table3.csv"


@dataclass(frozen=True, slots=True)
class PaperRoute:
    """Fits of a campaign by the Welch method, by type and weighting."""

    parameters: dict[tuple[str, str], dict[str, NDArray[np.float64]]]

    @classmethod
    def of(cls, made: Session, count: int) -> "PaperRoute":
        """Fit `count` sessions."""
        found: dict[tuple[str, str], list[dict[str, float]]] = {}
        for seed in range(count):
            h1 = made.noisy(seed).h1()
            for fit in fit_many(
                h1.frequency_hz, h1.response, LINK, [STRUCTURES[name] for name in TYPES]
            ):
                found.setdefault((fit.structure.name, fit.weighting), []).append(fit.parameters)
        return cls(
            {
                key: {name: np.array([each[name] for each in fits]) for name in fits[0]}
                for key, fits in found.items()
            }
        )


def paper_means() -> dict[tuple[str, str, str], float]:
    """Return the means of the paper's Table 3 by type, weighting and parameter."""
    with PAPER_TABLE3.open() as file:
        return {
            (row["type"], row["weighting"], row["parameter"]): float(row["mean"])
            for row in csv.DictReader(file)
        }


def table3(count: int, gate: Gate) -> dict[str, PaperRoute]:
    """Print the paper's Table 3 and the results of its method on both beams."""
    routes = {name: PaperRoute.of(session(plant), count) for name, plant in PLANTS.items()}
    print(f"\nTable 3 of the paper, and its route here: mean ± std of {count} sessions")
    print(f"{'type, weights, parameter':28}{'paper':>10}" + "".join(f"{n:>24}" for n in routes))
    for (name, weighting, parameter), paper in paper_means().items():
        cells = []
        for route in routes.values():
            values = route.parameters[name, weighting][parameter]
            cells.append(f"{values.mean():13.3g} ± {values.std(ddof=1):8.2g}")
        print(f"{name:4} {weighting:6} {parameter:16}{paper:10.3g}" + "".join(cells))
    for name in ("I", "IV"):
        ratios = [
            route.parameters[name, "omega"]["zeta"].mean()
            / route.parameters[name, "const"]["zeta"].mean()
            for route in routes.values()
        ]
        paper = paper_means()[name, "omega", "zeta"] / paper_means()[name, "const", "zeta"]
        print(f"zeta of {name}: omega over const, paper {paper:.1f}, here {np.round(ratios, 1)}")
        gate.measured(f"zeta of {name}, omega over const, beam not uniform", ratios[-1])
    for name, row in (("not uniform", "beam not uniform"), ("uniform", "uniform beam")):
        alphas = routes[name].parameters["VI", "const"]["alpha"]
        gate.measured(f"alpha of VI with const weights, {row}", alphas.mean())
    return routes


def record_method(count: int, gate: Gate) -> list[Selection]:
    """Print the results of the whole-record method for the beam that is not uniform."""
    made = session(NOT_UNIFORM)
    found = [select(made.noisy(seed).measurement()) for seed in range(count)]
    print(f"\nWhole record, not uniform, {count} sessions")
    tests = [each.headline.uniform_beam for each in found]
    statuses = ["not tested" if test is None else test.status for test in tests]
    print(f"  uniform beam: {dict(Counter(statuses))}")
    for order in ("alpha", "lambda_"):
        print(f"  {order}: {dict(Counter(getattr(e.verdict, order).status for e in found))}")
    worst = np.nan
    print(f"  {'mode':26}{'truth':>10}  mean ± std of the sessions; typical std stated; flags")
    for index, pole in enumerate(NOT_UNIFORM.mode_poles(3, ())):
        at = pole.at_rad_s
        for name, unit, truth, size in (
            ("frequency_hz", "Hz", at.imag / (2 * np.pi), 1.0),
            ("damping_ratio", "%", -100 * at.real / abs(at), 100.0),
        ):
            numbers = [getattr(each.headline.modes[index], name) for each in found]
            values = size * np.array([each.value for each in numbers])
            stated = size * np.median([each.std for each in numbers])
            flags = sum(each.flag is not None for each in numbers)
            errors = [abs(size * each.value - truth) / (size * each.std)
                      for each in numbers if each.flag is None and each.std]  # fmt: skip
            worst = np.fmax(worst, max(errors, default=np.nan))
            print(
                f"  {f'{name} of mode {pole.mode}, {unit}':26}{truth:10.5g}  "
                f"{values.mean():.5g} ± {values.std(ddof=min(1, count - 1)):.2g}; "
                f"{stated:.2g}; {flags}"
            )
    gate.measured("whole record: worst mode without a flag", worst)
    alphas = [fit.parameters["alpha"] for fit in _type_vi(found)]
    print(f"  alpha of VI on a uniform beam: {np.mean(alphas):.3f} ± {np.std(alphas):.3f}")
    return found


def _type_vi(found: list[Selection]) -> list[RecordFit]:
    """Return the fit of type VI to each session, also where a uniform beam is refused."""
    return [next(c.fit for c in each.candidates if c.structure.name == "VI") for each in found]


@dataclass(frozen=True, slots=True)
class FirstPeak:
    """First resonance of one beam: true values, and the results of the methods."""

    plant: Plant
    true_peak: tuple[float, float]
    welch_peak: tuple[float, float]
    welch: FrequencyResponse
    true_ratio: float
    welch_ratio: dict[str, float]
    record: RecordFit


def peak_of(
    frequency_hz: NDArray[np.float64], response: NDArray[np.complex128]
) -> tuple[float, float]:
    """Return the height of a peak in dB re 1 N·m/rad, and its half-power width in Hz."""
    size = np.abs(response)
    top = int(np.argmax(size))
    level = size[top] / np.sqrt(2)
    left = top - int(np.argmax(size[top::-1] < level))
    right = top + int(np.argmax(size[top:] < level))
    edges = [
        np.interp(level, size[[low, high]], frequency_hz[[low, high]])
        for low, high in ((left, left + 1), (right, right - 1))
    ]
    return 20 * float(np.log10(size[top])), float(edges[1] - edges[0])


def first_peaks(gate: Gate) -> list[FirstPeak]:
    """Print the first peak of beams with different external damping."""
    fine_hz = np.linspace(2.0, 3.2, 240_001)
    found = []
    print("\nFirst peak: dB and half-power width, true and of Welch's estimate (no noise); damping")
    print("ratio in %: true, type VI by the paper's route (const, omega), whole record")
    for factor in EXTERNAL:
        damping = Damping(DAMPING.zeta, 1.0, DAMPING.gamma * factor, DAMPING.lambda_)
        plant = Plant(LINK, damping)
        made = session(plant)
        h1, noisy = made.h1().band(2.0, 3.2), made.noisy(0)
        estimate = noisy.h1()
        plain = fit_many(estimate.frequency_hz, estimate.response, LINK, [STRUCTURES["VI"]])
        each = FirstPeak(
            plant=plant,
            true_peak=peak_of(fine_hz, ResponseGrid(2j * np.pi * fine_hz).evaluate(plant)[0]),
            welch_peak=peak_of(h1.frequency_hz, h1.response),
            welch=h1,
            true_ratio=modes(LINK, damping, 1)[0].damping_ratio,
            welch_ratio={
                fit.weighting: modes(LINK, fit.damping, 1)[0].damping_ratio for fit in plain
            },
            record=fit_record(noisy.measurement(), [STRUCTURES["VI"]]).fits[0],
        )
        found.append(each)
        mode = each.record.modes[0]
        print(
            "  {:5.2f} dB {:.4f} Hz".format(*each.true_peak),
            "  {:5.2f} dB {:.4f} Hz".format(*each.welch_peak),
            f"  {100 * each.true_ratio:.3f} ",
            " ".join(f"{100 * ratio:.3f}" for ratio in each.welch_ratio.values()),
            f"{100 * mode.damping_ratio:.3f} ± {100 * mode.damping_ratio_std:.3f}",
        )  # fmt: skip
    worst = max(
        abs(each.record.modes[0].damping_ratio - each.true_ratio)
        / each.record.modes[0].damping_ratio_std
        for each in found
    )
    gate.measured("whole record, first peak: worst damping ratio", worst)
    gate.measured(
        "Welch's first peak at a twentieth of the damping",
        10 ** ((found[0].welch_peak[0] - found[0].true_peak[0]) / 20),
    )
    return found


def segment_trap(gate: Gate) -> dict[int, FrequencyResponse]:
    """Print the effect of one sample less overlap on the estimate and on type VI."""
    made = session(PLANTS["uniform"])
    noisy, estimates, costs = made.noisy(0), {}, []
    near_hz = np.linspace(44, 46, 4001)
    truth = ResponseGrid(2j * np.pi * near_hz).evaluate(PLANTS["uniform"])[0]
    level_db = peak_of(near_hz, truth)[0]
    print(f"\nSegments: third peak (true {level_db:.2f} dB), cost and parameters of type VI")
    for overlap in (Segmentation().overlap, Segmentation().overlap - 1):
        count = segment_count(120_000, 17_266, overlap)
        h1 = estimates[overlap] = noisy.h1(overlap)
        third_db = 20 * np.log10(np.abs(made.h1(overlap).band(44, 46).response).max())
        print(f"  overlap {overlap}: {count} segments, third peak without noise {third_db:.2f} dB")
        for fit in fit_many(h1.frequency_hz, h1.response, LINK, [STRUCTURES["VI"]]):
            costs.append(fit.cost)
            print(
                f"    {fit.weighting:6} cost {fit.cost:8.3f} ",
                "  ".join(f"{name} {value:.3g}" for name, value in fit.parameters.items()),
            )
    gate.measured("cost of VI with a sample of overlap less", costs[2] / costs[0])
    return estimates


def main() -> None:
    """Print the requested parts, and draw them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sessions", type=int, default=3, help="of each beam")
    parser.add_argument("--part", choices=("table3", "record", "first_peak", "segments"))
    parser.add_argument("--figures", type=Path, help="folder for the page's figures")
    gate = Gate(ROWS, parser)
    given = gate.given
    if given.part in (None, "table3"):
        routes = table3(given.sessions, gate)
        if given.figures:
            draw.weights(given.figures, routes["not uniform"].parameters, session(NOT_UNIFORM))
    if given.part in (None, "record"):
        selections = record_method(given.sessions, gate)
        if given.figures:
            route = PaperRoute.of(session(NOT_UNIFORM), given.sessions)
            uniform = [fit.parameters["alpha"] for fit in _type_vi(selections)]
            modes_found = selections[0].headline.modes
            draw.order(given.figures, route.parameters, np.array(uniform), modes_found)
    if given.part in (None, "first_peak"):
        peaks = first_peaks(gate)
        if given.figures:
            draw.first_peak(given.figures, peaks)
    if given.part in (None, "segments"):
        estimates = segment_trap(gate)
        if given.figures:
            draw.segments(given.figures, estimates)
    gate.finish(part=given.part is not None)


if __name__ == "__main__":
    main()
