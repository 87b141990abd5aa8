"""Designed excitation against the paper's chirp: precision against time.

The Fisher information predicts the standard deviations of a whole-record fit: for the paper's chirp
while it runs, for a scan of 5 s followed by designed segments, and for the best steady sines, a
bound that no session can reach because a mode needs time to build up (``--picture FILE`` draws
them). The beam is that of the profile ``sim`` (type VI), the torque noise 5e-3 N·m per sample. The
slope of the tip reaches 0.5 rad in the chirp, beyond the range of small slopes; the segments stay
within that range, or within ``--tip-slope``.

``--check`` makes records of scan and segments by exact synthesis, with noise, and fits them with
`analysis`. It prints the standard deviation stated by a fit over the predicted one, and the scatter
over the stated one.
"""

import argparse
import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from bench_modes import response
from bench_record_fit import LINK, PLANTS, RATE_HZ
from gate import Gate, Row
from numpy.typing import NDArray

from analysis.identify import Measurement, fit_record
from analysis.models import STRUCTURES
from rigd.beam import Plant
from rigd.beam.tip import tip_motion
from rigd.excitation import BeamEstimate, Segment, chirp, information, modes
from rigd.excitation._beam_estimate import UNIFORM_BEAM_PARAMETERS
from rigd.excitation._fisher_information import RecordSoFar, covariance_of
from rigd.excitation._segment_search import SegmentSearch
from rigd.excitation.experiment_design import next_segment
from rigd.excitation.targets import Precision, Quantities, Target, parse_target
from rigd.profile import load_profile
from rigd.runner.planning import RigPreview

NOISE_NM = 5e-3
DAMPING = PLANTS["VI"]
ESTIMATE = BeamEstimate(
    Plant(LINK, DAMPING),
    UNIFORM_BEAM_PARAMETERS,
    np.array([1.0]),
    np.array([2.0 * NOISE_NM**2 / RATE_HZ]),
)
SCAN = chirp(rate_hz=RATE_HZ, start_hz=0.5, stop_hz=50.0, duration_s=5.0, rest_s=1.0, ring_down_s=0)

Real = NDArray[np.float64]
ROWS = tuple(
    # Measured 13, 13, 29, 15, 72.5, 24, 7.5 and 7 s: docs/validation/experiment_design.md.
    Row(f"{name}, slope to {slope_rad:g} rad", most=most, unit="of the time of the paper's chirp")
    for name, both in {
        "damping 1 %": (0.12, 0.12),
        "damping 0.5 %": (0.26, 0.14),
        "damping 0.2 %": (0.64, 0.22),
        "scatter of the paper": (0.07, 0.07),
    }.items()
    for slope_rad, most in zip((0.14, 0.5), both, strict=True)
)
CHIRP_S = 136.0


def precisions(angle_rad: Real, targets: list[Target]) -> tuple[Precision, ...]:
    """Return the precisions expected after a record."""
    covariance = covariance_of(information(angle_rad, ESTIMATE, RATE_HZ), ESTIMATE)
    return Quantities.from_targets(targets, ESTIMATE).precisions(covariance)


def designed(
    rig: RigPreview, targets: list[Target], longest_s: float, tip_slope_rad: float
) -> tuple[Real, Real, list[Segment], float]:
    """Scan, then add segments until all targets are reached.

    Return reference, angle, segments, and the processor time in s of the slowest decision.
    """
    reference_rad = SCAN.reference_rad
    angle_rad = rig.plant_with(Plant(LINK, DAMPING)).respond(reference_rad).angle_rad
    segments: list[Segment] = []
    slowest_s, left_s = 0.0, longest_s
    while left_s > 1.0:
        started_s = time.process_time()
        segment = next_segment(
            ESTIMATE, angle_rad, targets, rig, left_s, tip_slope_rad=tip_slope_rad
        )
        slowest_s = max(slowest_s, time.process_time() - started_s)
        segments.append(segment)
        reference_rad = np.concatenate([reference_rad, segment.reference_rad])
        angle_rad = np.concatenate([angle_rad, segment.angle_rad])
        left_s -= segment.reference_rad.size / RATE_HZ
        if all(each.reached for each in segment.expected_precisions):
            break
    return reference_rad, angle_rad, segments, slowest_s


def steady_s(rig: RigPreview, targets: list[Target], tip_slope_rad: float) -> float:
    """Return the time of the best steady sines alone, a lower bound for any session, in s."""
    record = RecordSoFar.from_angle(np.zeros(8), ESTIMATE, RATE_HZ, 8.0)
    plant = rig.plant_with(Plant(LINK, DAMPING))
    quantities = Quantities.from_targets(targets, ESTIMATE)
    return float(
        SegmentSearch(ESTIMATE, quantities, plant, 0.0, record, tip_slope_rad).mixture.times_s.sum()
    )


def table(rig: RigPreview, slopes_rad: list[float], gate: Gate) -> None:
    """Print the times needed to reach the targets."""
    goals = {
        "damping 1 %": [parse_target("damping", "1%")],
        "damping 0.5 %": [parse_target("damping", "0.5%")],
        "damping 0.2 %": [parse_target("damping", "0.2%")],
        "scatter of the paper": [
            parse_target(*each)
            for each in (("zeta", "28%"), ("gamma", "7%"), ("lambda", "0.028"), ("alpha", "0.057"))
        ],
    }
    print(
        "target                 slope/rad  rig time/s  segments  steady sines/s  slowest decision/s"
    )
    for name, targets in goals.items():
        for slope_rad in slopes_rad:
            reference, angle, segments, slowest_s = designed(rig, targets, 120.0, slope_rad)
            motion = tip_motion(Plant(LINK, DAMPING), angle, RATE_HZ)
            done = all(each.reached for each in segments[-1].expected_precisions)
            print(
                f"{name:22} {motion.slope_rad:9.3f} {'' if done else '>'}"
                f"{reference.size / RATE_HZ:10.1f} {len(segments):9} "
                f"{steady_s(rig, targets, slope_rad):15.1f} {slowest_s:19.2f}",
                flush=True,
            )
            row = f"{name}, slope to {slope_rad:g} rad"
            if row in gate.rows:
                time_s = reference.size / RATE_HZ if done else np.inf
                gate.measured(row, time_s / CHIRP_S)


def worst_percent(angle_rad: Real) -> float:
    """Return the largest relative standard deviation of a damping ratio after a record, in %."""
    targets = [parse_target("damping", "1%")]
    return max(100 * each.std / each.value for each in precisions(angle_rad, targets))


def curves(rig: RigPreview, slope_rad: float) -> dict[str, tuple[Real, Real]]:
    """Return by name the times in s, and the result of `worst_percent` after each."""
    chirped = (
        rig.plant_with(Plant(LINK, DAMPING)).respond(chirp(rate_hz=RATE_HZ).reference_rad).angle_rad
    )
    ends_s = np.array([41.0, 45.0, 60.0, 90.0, 100.0, 105.0, 108.0, 110.0, 115.0, 136.0])
    percent = [worst_percent(chirped[: round(end * RATE_HZ)]) for end in ends_s]
    found = {"paper's chirp, while it runs (slope 0.5 rad)": (ends_s, np.array(percent))}
    times_s = np.array([5.0, 10.0, 20.0, 40.0, 80.0, 120.0])
    swept = [swept_rad(rig, time_s) for time_s in times_s]
    slope = tip_motion(Plant(LINK, DAMPING), swept[-1], RATE_HZ).slope_rad
    found[f"scan and narrow sweeps, rigd run modes (slope {slope:.1f} rad)"] = (
        np.array([angle.size / RATE_HZ for angle in swept]),
        np.array([worst_percent(angle) for angle in swept]),
    )
    # No session reaches this target: each is as precise as its time allows.
    targets = [parse_target("damping", "0.01%")]
    for limit_rad in (slope_rad, 0.5):
        angles = [designed(rig, targets, time_s, limit_rad)[1] for time_s in (2, 5, 10, 20, 40, 80)]
        found[f"scan and designed segments, slope to {limit_rad:g} rad"] = (
            np.array([angle.size / RATE_HZ for angle in angles]),
            np.array([worst_percent(angle) for angle in angles]),
        )
    bound_targets = [parse_target("damping", "0.1%")]
    for limit_rad in (slope_rad, 0.5):
        best_s = steady_s(rig, bound_targets, limit_rad)
        times_s = np.geomspace(5.0, 136.0, 24)
        found[f"steady sines, slope to {limit_rad:g} rad (bound)"] = (
            times_s,
            0.1 * np.sqrt(best_s / times_s),
        )
    return found


def swept_rad(rig: RigPreview, duration_s: float) -> Real:
    """Return the angle of the scan and of narrow sweeps over the modes that it found."""
    found = [
        {"frequency_hz": mode.frequency_hz, "damping_ratio": mode.damping_ratio}
        for mode in ESTIMATE.modes()
    ]
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "modes.json"
        path.write_text(json.dumps({"modes": found}), "utf-8")
        taper_s = min(1.0, duration_s / 20)
        sweeps = modes(
            rate_hz=RATE_HZ, path=path, duration_s=duration_s, rest_s=0.0, ring_down_s=1.0,
            taper_s=taper_s, rig=rig,
        )  # fmt: skip
    reference_rad = np.concatenate([SCAN.reference_rad, sweeps.reference_rad])
    return rig.plant_with(Plant(LINK, DAMPING)).respond(reference_rad).angle_rad


def draw(rig: RigPreview, path: Path, slope_rad: float) -> None:
    """Draw the curves of precision against time."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(7.0, 4.2), layout="constrained")
    styles = ["C7.-", "C2s-", "C0o-", "C1o-", "C0:", "C1:"]
    for (name, (time_s, percent)), style in zip(
        curves(rig, slope_rad).items(), styles, strict=True
    ):
        axes.loglog(time_s, percent, style, label=name)
    axes.set_xlabel("time of the record (s)")
    axes.set_ylabel("largest relative std of a mode's damping (%)")
    axes.set_ylim(0.004, 20.0)
    for axis, ticks in (
        (axes.xaxis, [5, 10, 20, 50, 100]),
        (axes.yaxis, [0.01, 0.03, 0.1, 0.3, 1, 3, 10]),
    ):
        axis.set_ticks(ticks, [f"{tick:g}" for tick in ticks])
        axis.set_ticks([], minor=True)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, loc="lower left")
    figure.savefig(path, dpi=130)


def check(rig: RigPreview, sessions: int, slope_rad: float) -> None:
    """Print stated over predicted standard deviations, and the scatter of the fits."""
    targets = [parse_target("damping", "1%")]
    reference, angle, _, _ = designed(rig, targets, 30.0, slope_rad)
    names = ("zeta", "alpha", "gamma", "lambda")
    requested = [*(Target(name, 1.0, is_relative=False) for name in names), *targets]
    predicted = [each.std for each in precisions(angle, requested)]
    made = response(Plant(LINK, DAMPING), reference)
    everywhere = np.ones(made.angle_rad.size, dtype=bool)
    found, stated = [], []
    for seed in range(sessions):
        noise = np.random.default_rng(seed).normal(scale=NOISE_NM, size=made.torque_nm.size)
        measurement = Measurement(
            "session",
            np.round(made.angle_rad / 7e-5) * 7e-5,
            np.round((made.torque_nm + noise) / 1.25e-4) * 1.25e-4,
            RATE_HZ,
            LINK,
            everywhere,
            everywhere,
            rest_angle_rad=0.0,
        )
        fit = fit_record(measurement, [STRUCTURES["VI"]]).fits[0]
        found.append([fit.parameters[n] for n in names] + [m.damping_ratio for m in fit.modes])
        stated.append(
            [fit.std[n] or np.nan for n in names] + [m.damping_ratio_std for m in fit.modes]
        )
    truth = [DAMPING.zeta, DAMPING.alpha, DAMPING.gamma, DAMPING.lambda_]
    truth += [mode.damping_ratio for mode in ESTIMATE.modes()]
    labels = [*names, *(f"damping {mode.mode}" for mode in ESTIMATE.modes())]
    print(f"\n{sessions} sessions of {reference.size / RATE_HZ:g} s")
    print("quantity    predicted std   stated/predicted  scatter/stated  bias/stated")
    for i, label in enumerate(labels):
        std = float(np.nanmedian([row[i] for row in stated]))
        values = np.array([row[i] for row in found])
        print(
            f"{label:10} {predicted[i]:14.2e} {std / predicted[i]:18.2f} "
            f"{values.std(ddof=1) / std:15.2f} {(values.mean() - truth[i]) / std:12.2f}"
        )


def main() -> None:
    """Run the requested parts, and check the limits of the times."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tip-slope", type=float, action="append", help="rad (0.14 and 0.5)")
    parser.add_argument("--check", type=int, metavar="N", help="fit so many records")
    parser.add_argument("--picture", type=Path, help="draw precision against time")
    gate = Gate(ROWS, parser)
    given = gate.given
    rig = RigPreview(replace(load_profile("sim")))
    slopes_rad = given.tip_slope or [0.14, 0.5]
    if given.check:
        check(rig, given.check, slopes_rad[0])
    elif given.picture:
        draw(rig, given.picture, slopes_rad[0])
    else:
        table(rig, slopes_rad, gate)
    gate.finish(part=bool(given.check or given.picture or given.tip_slope))


if __name__ == "__main__":
    main()
