"""Narrow sweeps around the modes against the chirp: standard deviations after 136 s of each.

The peer is the paper's chirp (0.025 rad, 0.05-50 Hz in 120 s, 1 s of rest before and 15 s of
ring-down after). It is fitted first, as an operator would; the modes of its first session's fit go
into the JSON document from which the narrow sweeps are made. For both, sessions with different
noise are fitted by the whole-record estimator with rho/EI, EI, delay and tool inertia free. The
program prints for each parameter the formal standard deviations (medians over the sessions), their
ratio, and the ratio of the scatter over the sessions.

Without ``--engine`` the sessions are made in the frequency domain: the reference through the loop
1/(1 + s/80)^2, exact torque, encoder steps of 7e-5 rad, torque noise of 1e-2 N·m and steps of
1.25e-4 N·m. With ``--engine`` they are runs of ``rigd run --fast`` on the profile ``sim``.
``--amplitude`` is that of the narrow sweeps, in which the slope of the tip stays within
``--tip-slope``; ``--chirp-amplitude`` is that of the chirp. In the paper's chirp the slope reaches
0.6 rad, in one of 0.0058 rad 0.14 rad.
"""

import argparse
import json
import math
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from bench_record_fit import LINK, PLANTS, RATE_HZ, Session
from gate import Gate, Row
from numpy.typing import NDArray

from analysis.identify import Measurement, RecordFit, fit_record
from analysis.models import STRUCTURES
from rigd.beam import Plant, transfer
from rigd.beam.tip import SMALL_TIP_SLOPE_RAD
from rigd.excitation import chirp, modes
from rigd.profile import Profile, load_profile
from rigd.runner.planning import RigPreview

POLE_RAD_S = 80.0
ROWS = tuple(
    row
    for name, amplitude_rad, most in (
        # Measured 0.66 and 0.92 of the paper's chirp, whose slopes are four times as large:
        # docs/validation/better_experiments.md.
        ("VI", 0.025, 0.8),
        ("VI", 0.1, 0.8),
        ("III", 0.025, 1.1),
        ("III", 0.1, 1.1),
    )
    for row in (
        Row(
            f"{name}, to {amplitude_rad:g} rad: std of damping", most=most, unit="times the chirp's"
        ),
        Row(f"{name}, to {amplitude_rad:g} rad: mean error", most=1, unit="of what chance allows"),
    )
)


def response(plant: Plant, reference_rad: NDArray[np.float64]) -> Session:
    """Return the exact response to a reference, from rest."""
    n = reference_rad.size
    padded = 4 * n
    decay = np.exp(-5.0 * np.arange(n) / n)
    s = 5.0 * RATE_HZ / n + 2j * np.pi * np.fft.rfftfreq(padded, 1 / RATE_HZ)
    angle = np.fft.rfft(reference_rad * decay, padded) / (1 + s / POLE_RAD_S) ** 2
    torque = angle * (transfer(s, plant.beam, plant.damping) + plant.tool_inertia_kg_m2 * s**2)
    torque *= np.exp(-s * plant.delay_s)
    return Session(plant, *(np.fft.irfft(x, padded)[:n] / decay for x in (angle, torque)))


def write_modes(fit: RecordFit, path: Path) -> None:
    """Write the modes of a fit as a document with the keys of `analyze --json`."""
    found = [
        {
            "frequency_hz": mode.frequency_hz,
            "frequency_std_hz": mode.frequency_std_hz,
            "damping_ratio": mode.damping_ratio,
        }
        for mode in fit.modes
    ]
    path.write_text(json.dumps({"modes": found}), encoding="utf-8")


def fitted(measurements: list[Measurement], name: str) -> list[RecordFit]:
    """Fit one structure to each measurement."""
    return [fit_record(m, [STRUCTURES[name]]).fits[0] for m in measurements]


def recorded(kind: list[str], profile: Path, count: int, folder: Path) -> list[Measurement]:
    """Run sessions in the engine and load them."""
    from analysis.record import load_record

    measurements = []
    for seed in range(count):
        command = [
            sys.executable,
            "-m",
            "rigd",
            "run",
            *kind,
            "--no-look",
            "--profile",
            str(profile),
            "--fast",
        ]
        command += ["--seed", str(seed + 1), "--output", str(folder), "--json"]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        path = Path(json.loads(done.stdout)["sessions"][0]["path"])
        measurements.append(Measurement.from_record(load_record(path)))
        path.unlink()
    return measurements


def compare(
    name: str, truth: Plant, peer: list[RecordFit], narrow: list[RecordFit]
) -> tuple[float, float]:
    """Print the standard deviations of both and their ratios.

    Return the standard deviation of the damping over that of the chirp, and the largest mean error
    of the damping over its limit.
    """
    count = len(peer)
    print(f"\nType {name}, {count} sessions of each kind")
    print("parameter                    truth  std chirp  std modes  ratio  ratio of scatter  bias")
    ratios, biases = [], []
    for parameter, value in truth.parameters.items():
        stds = [
            np.array([fit.std[parameter] or math.nan for fit in fits]) for fits in (peer, narrow)
        ]
        if any(np.isnan(std).all() for std in stds):
            continue
        of_peer, of_narrow = (float(np.nanmedian(std)) for std in stds)
        found = [np.array([fit.parameters[parameter] for fit in fits]) for fits in (peer, narrow)]
        scatter = found[0].std(ddof=1) / found[1].std(ddof=1)
        bias = (found[1].mean() - value) / of_narrow
        print(
            f"{parameter:24} {value:9.3g} {of_peer:10.2e} {of_narrow:10.2e} "
            f"{of_peer / of_narrow:6.2f} {scatter:17.2f} {bias:5.2f}"
        )
        if parameter in ("zeta", "alpha", "gamma", "lambda"):
            ratios.append((of_peer / of_narrow, scatter))
            biases.append(abs(bias) / (0.25 + 3 / math.sqrt(count)))
    formal, empirical = np.exp(np.mean(np.log(ratios), axis=0))
    print(f"Damping, geometric mean: {formal:.2f} formal, {empirical:.2f} by scatter", flush=True)
    return float(1 / formal), float(np.max(biases))


def profile_of(name: str) -> Profile:
    """Return the profile of the simulated rig with the damping of a plant."""
    profile = load_profile("sim")
    return replace(profile, rig=replace(profile.rig, damping=PLANTS[name]))


def main() -> None:
    """Compare for the requested plants and amplitudes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sessions", type=int, default=6, help="of each kind")
    parser.add_argument("--plant", choices=PLANTS, action="append", help="only this one")
    parser.add_argument("--amplitude", type=float, action="append", help="of the narrow sweeps")
    parser.add_argument("--tip-slope", type=float, default=SMALL_TIP_SLOPE_RAD, help="of them")
    parser.add_argument("--chirp-amplitude", type=float, default=0.025, help="of the peer")
    parser.add_argument("--widths", type=float, default=1.0, help="to either side of a mode")
    parser.add_argument("--engine", action="store_true", help="rigd run --fast, type VI only")
    gate = Gate(ROWS, parser)
    given = gate.given
    plants = ["VI"] if given.engine else given.plant or ["VI", "III"]
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        document = folder / "fits.json"
        for name in plants:
            truth = Plant(LINK, PLANTS[name])
            if given.engine:
                kind = ["chirp", "--amplitude", str(given.chirp_amplitude)]
                peer = fitted(recorded(kind, Path("sim"), given.sessions, folder), name)
            else:
                sweep = chirp(rate_hz=RATE_HZ, amplitude_rad=given.chirp_amplitude)
                session = response(truth, sweep.reference_rad)
                peer = fitted([session.measured(seed) for seed in range(given.sessions)], name)
            write_modes(peer[0], document)
            for amplitude_rad in given.amplitude or [0.025, 0.1]:
                options = {"amplitude_rad": amplitude_rad, "widths": given.widths}
                options["tip_slope_rad"] = given.tip_slope
                rig = RigPreview(profile_of(name))
                excitation = modes(rate_hz=RATE_HZ, path=document, rig=rig, **options)
                print(f"\nUp to {amplitude_rad:g} rad: {excitation.parameters['bands']}")
                if given.engine:
                    command = ["modes", str(document), "--amplitude", str(amplitude_rad)]
                    command += ["--widths", str(given.widths)]
                    command += ["--tip-slope", str(given.tip_slope)]
                    sessions = recorded(command, Path("sim"), given.sessions, folder)
                else:
                    session = response(truth, excitation.reference_rad)
                    sessions = [session.measured(100 + seed) for seed in range(given.sessions)]
                std, bias = compare(name, truth, peer, fitted(sessions, name))
                of = f"{name}, to {amplitude_rad:g} rad"
                if f"{of}: std of damping" in gate.rows:
                    gate.measured(f"{of}: std of damping", std)
                    gate.measured(f"{of}: mean error", bias)
    gate.finish(part=bool(given.engine or given.plant or given.amplitude))


if __name__ == "__main__":
    main()
