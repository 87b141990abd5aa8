"""Sessions that end themselves, on simulated rigs that differ from their profile.

Each rig has a beam whose density and stiffness differ from the profile's by up to a fifth, one of
the seven structures of damping with modes of 0.1 to 3 %, and torque noise of 3 to 20 mN·m. Four in
five differ from a uniform beam in a vacuum: they have an elastic clamp, a mass at the tip, both, or
air drag. With ``--uneven`` density and stiffness vary along the beam by 0.3 to 5 %, half of the
beams are in air, and the rig is that of `finite_element_rig.py`.

The target of each session is the precision of damping that the modal model of a chirp of 136 s has
within the same range of slopes. The command is ``rigd run until --fast``, and every number stated
without a flag is compared with the truth.

    python benchmarks/bench_until.py --rigs 100 --jsonl results.jsonl
    python benchmarks/bench_until.py --rigs 20 --uneven
    python benchmarks/bench_until.py --table results.jsonl
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import finite_element_rig
import numpy as np
from defect_records import DampingLaw
from finite_element_beam import FiniteElementBeam
from gate import Gate, Row, percent
from numpy.typing import NDArray
from random_defects import scaled_smoothly

from rigd.beam import Beam, Damping, Plant, modes
from rigd.beam.tip import SMALL_TIP_SLOPE_RAD, tip_motion
from rigd.excitation import BeamEstimate, chirp
from rigd.excitation.experiment_design import expected_precisions
from rigd.excitation.targets import parse_target
from rigd.profile import load_profile
from rigd.runner.planning import RigPreview

Real = NDArray[np.float64]

RATE_HZ = 1000.0
STRUCTURES = {
    "I": "i", "II": "e", "III": "ie", "IV": "I", "V": "E", "VI": "IE", "VII": "iE",
}  # fmt: skip
"""Types of damping: internal and external, capitals for a fractional order."""
EXTRAS = ("uniform", "clamp", "mass", "clamp and mass", "drag")
BAND_HZ = 50.0
_ABSENT = 1e-7
"""A negligible coefficient of damping."""
ROWS = (
    # Measured 0, 12 of 12 and 28 of 28; with 40 rigs 90 % of the damping ratios, 94 % of the
    # frequencies: docs/validation/until.md.
    Row("sessions that failed", most=0, unit="%"),
    Row("sessions that reached the target", least=75, unit="%"),
    Row("95 % intervals of modes that hold the truth", least=80, unit="%"),
)
HIGHEST_HZ = 450.0
"""Highest mode of a beam of finite elements."""
DRAG_POINTS = 64
PROFILE = Path(__file__).parents[1] / "hw_profiles" / "sim.toml"


@dataclass(frozen=True, slots=True)
class Rig:
    """True properties of a simulated rig."""

    number: int
    structure: str
    density_ratio: float
    stiffness_ratio: float
    zeta: float
    alpha: float
    gamma: float
    lambda_: float
    noise_nm: float
    clamp_compliance_rad_per_nm: float = 0.0
    tip_mass_kg: float = 0.0
    air_drag_m: float = 0.0
    uneven_percent: float = 0.0
    """Standard deviation of density and of stiffness along the beam."""

    @property
    def damping(self) -> Damping:
        """Damping of the beam."""
        return Damping(self.zeta, self.alpha, self.gamma, self.lambda_)

    def beam(self) -> Beam:
        """Return the beam without clamp and tip mass."""
        stated = load_profile("sim").rig.beam
        return replace(
            stated,
            density_kg_per_m=self.density_ratio * stated.density_kg_per_m,
            bending_stiffness_n_m2=self.stiffness_ratio * stated.bending_stiffness_n_m2,
        )

    def truth(self) -> dict[str, dict[str, float]]:
        """Return frequencies and damping ratios of the modes in the band."""
        if self.uneven_percent:
            beam = self.modal_beam()
            pairs = zip(beam.omega_rad_s, beam.damping_ratio, strict=True)
            return {
                f"{name} {number}": float(value)
                for number, (omega, ratio) in enumerate(pairs, start=1)
                if omega < 2 * np.pi * BAND_HZ
                for name, value in (
                    ("frequency", omega * np.sqrt(1 - ratio**2) / (2 * np.pi)),
                    ("damping", ratio),
                )
            }
        plant = Plant(
            self.beam(),
            self.damping,
            root_compliance_rad_per_nm=self.clamp_compliance_rad_per_nm,
            tip_mass_kg=self.tip_mass_kg,
        )
        found = {}
        for pole in plant.mode_poles(4, ()):
            frequency_hz = pole.at_rad_s.imag / (2 * np.pi)
            if 0 < frequency_hz < BAND_HZ:
                found[f"frequency {pole.mode}"] = frequency_hz
                found[f"damping {pole.mode}"] = -pole.at_rad_s.real / abs(pole.at_rad_s)
        return found

    def modal_beam(self) -> finite_element_rig.ModalBeam:
        """Return a beam of finite elements whose density and stiffness vary along it.

        Its modes have the damping ratios of a uniform beam.
        """
        stated, rng = self.beam(), np.random.default_rng([self.number, 1])
        waves = np.arange(1, 6, dtype=float)
        wandering = []
        for value in (stated.density_kg_per_m, stated.bending_stiffness_n_m2):
            cosines, sines = rng.normal(size=(2, waves.size)) / waves
            scale = 0.01 * self.uneven_percent / np.sqrt(np.sum(cosines**2 + sines**2) / 2)
            wandering.append(scaled_smoothly(value, waves, scale * cosines, scale * sines))
        law = DampingLaw(0.0, 1.0, 0.0, 1.0)
        beam = FiniteElementBeam(stated.length_m, *wandering, law.elastic, law.medium)
        omega, participation = beam.participations()
        within = omega < 2 * np.pi * HIGHEST_HZ
        position_m = (np.arange(DRAG_POINTS) + 0.5) * stated.length_m / DRAG_POINTS
        shape = beam.shapes_at(position_m)[within]
        density = wandering[0](position_m)
        spacing_m = stated.length_m / DRAG_POINTS
        ratios = [mode.damping_ratio for mode in modes(stated, self.damping, int(within.sum()))]
        return finite_element_rig.ModalBeam(
            omega[within],
            np.clip(ratios, 1e-4, 0.1),
            participation[within],
            spacing_m * shape @ density,
            float(spacing_m * density @ position_m**2),
            beam.mass_moment_kg_m,
            position_m,
            shape,
            self.air_drag_m,
        )


def draw_uneven(number: int, seed: int) -> Rig:
    """Draw a rig whose beam is not uniform; every second one is in air."""
    rng = np.random.default_rng([seed, number, 2])
    rig = replace(
        draw(number, seed), clamp_compliance_rad_per_nm=0.0, tip_mass_kg=0.0, air_drag_m=0.0
    )
    uneven_percent = float(np.exp(rng.uniform(np.log(0.3), np.log(5.0))))
    drag_m = float(rng.uniform(3e-4, 2.3e-3)) if number % 2 else 0.0
    return replace(rig, uneven_percent=uneven_percent, air_drag_m=drag_m)


def draw(number: int, seed: int) -> Rig:
    """Draw a rig whose modes have 0.1 to 3 % damping."""
    rng = np.random.default_rng([seed, number])
    structure = list(STRUCTURES)[number % len(STRUCTURES)]
    kinds = STRUCTURES[structure]
    while True:
        density, stiffness = rng.uniform(0.8, 1.2, 2)
        alpha = rng.uniform(0.6, 0.95) if "I" in kinds else 1.0
        lambda_ = rng.uniform(0.3, 0.9) if "E" in kinds else 1.0
        zeta = 10 ** rng.uniform(-6, -2.5) if kinds.lower().startswith("i") else 0.0
        gamma = 10 ** rng.uniform(-3, 0) if kinds.lower().endswith("e") else 0.0
        rig = Rig(
            number, structure, density, stiffness, zeta, alpha, gamma, lambda_,
            noise_nm=float(np.exp(rng.uniform(np.log(3e-3), np.log(20e-3)))),
        )  # fmt: skip
        found = [mode for mode in modes(rig.beam(), rig.damping, 3) if mode.frequency_hz > 0]
        if len(found) == 3 and all(1e-3 < mode.damping_ratio < 3e-2 for mode in found):
            break
    kind = EXTRAS[rng.integers(len(EXTRAS))]
    if "clamp" in kind:
        rig = replace(rig, clamp_compliance_rad_per_nm=float(rng.uniform(5e-3, 3e-2)))
    if "mass" in kind:
        rig = replace(rig, tip_mass_kg=float(rng.uniform(2e-5, 2e-4)))
    if "drag" in kind:
        rig = replace(rig, air_drag_m=float(rng.uniform(3e-4, 2.3e-3)))
    return rig


def chirp_precision(rig: Rig) -> float:
    """Return the largest relative standard deviation of damping that the chirp would give.

    The angle is that of the closed loop, which hardly follows beyond mode 2. Its amplitude is the
    paper's, or less to keep the slope of the tip within the range of designed segments.
    """
    beam, damping = rig.beam(), rig.damping
    loop = RigPreview(load_profile("sim")).plant_with(Plant(beam, damping))
    angle_rad = loop.respond(chirp(rate_hz=RATE_HZ).reference_rad).angle_rad
    slope = tip_motion(Plant(beam, damping), angle_rad, RATE_HZ).slope_rad
    angle_rad = angle_rad * min(1.0, 0.9 * SMALL_TIP_SLOPE_RAD / slope)
    present = replace(damping, zeta=rig.zeta or _ABSENT, gamma=rig.gamma or _ABSENT)
    noise = 2 * rig.noise_nm**2 / RATE_HZ
    estimate = BeamEstimate.from_plant(Plant(beam, present), noise).with_modal_parameters()
    precisions = expected_precisions(
        angle_rad, estimate, [parse_target("damping", "100%")], RATE_HZ
    )
    return max(each.std / each.value for each in precisions)


def profile_of(rig: Rig, folder: Path) -> Path:
    """Write the shipped profile with the simulation of a rig, and return its path."""
    text = PROFILE.read_text("utf-8")
    for key, value in (
        ("torque_noise_nm", rig.noise_nm), ("rest_torque_nm", 2.5 * rig.noise_nm),
        ("zeta", rig.zeta), ("alpha", rig.alpha), ("gamma", rig.gamma), ("lambda", rig.lambda_),
    ):  # fmt: skip
        text, count = re.subn(rf"(?m)^({key} = \{{ value = )[^,]+", rf"\g<1>{value!r}", text)
        assert count == 1, key
    more = {
        "density_ratio": rig.density_ratio,
        "stiffness_ratio": rig.stiffness_ratio,
        "clamp_compliance_rad_per_nm": rig.clamp_compliance_rad_per_nm,
        "tip_mass_kg": rig.tip_mass_kg,
        "air_drag_m": rig.air_drag_m,
    }
    if rig.uneven_percent:
        more = {}
        name = finite_element_rig.NAME
        text = re.sub(r'(?m)^(drive|sensor) = "sim"', rf'\1 = "{name}"', text)
        rig.modal_beam().write(folder / "beam.npz")
        text += f'\n[{name}]\nfile = "{folder / "beam.npz"}"\n'
    lines = [f'{k} = {{ value = {float(v)!r}, source = "assumed" }}' for k, v in more.items() if v]
    text = text.replace("[simulation]\n", "[simulation]\n" + "\n".join(lines) + "\n")
    path = folder / f"rig{rig.number}.toml"
    path.write_text(text, "utf-8")
    return path


def run(rig: Rig, at_most_s: float, options: list[str]) -> dict[str, Any]:
    """Run a session on a rig and return its result."""
    target = chirp_precision(rig)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        command = [
            str(Path(sys.executable).with_name("rigd")), "run", "until",
            "--damping", f"{100 * target:.4g}%", "--at-most", str(at_most_s), "--fast", "--no-look",
            "--json", "--seed", str(rig.number), "--profile", str(profile_of(rig, folder)),
            "--output", name, *options,
        ]  # fmt: skip
        finite_element_rig.install(folder)
        path = os.pathsep.join([name, str(Path(__file__).parent)])
        environment = os.environ | {"XDG_RUNTIME_DIR": name, "PYTHONPATH": path}
        done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
        try:
            [session] = json.loads(done.stdout)["sessions"]
        except (ValueError, KeyError):
            return {"rig": asdict(rig), "target": target, "failed": done.stderr[-2000:]}
    fit = session["fit"]
    return {
        "rig": asdict(rig),
        "target": target,
        "duration_s": session["recorded"] / RATE_HZ,
        "outcome": session["outcome"],
        "reason": session["reason"],
        "search": fit["search"],
        "modes": fit["modes"],
        "parameters": fit.get("parameters", {}),
        "findings": fit.get("findings", []),
        "type": fit.get("type"),
        "course": [line for line in done.stderr.splitlines() if re.match(r" *[\d.]+ s ", line)],
    }


# Evaluation of the results


def intervals(result: dict[str, Any]) -> Iterator[tuple[str, float, float, float, float]]:
    """Yield quantity, truth, value, and the ends of each interval without a flag."""
    rig = Rig(**result["rig"])
    truth = rig.truth()
    for mode in result["modes"]:
        for key, name in (("frequency_hz", "frequency"), ("damping_ratio", "damping")):
            estimate = mode[key]
            true = truth.get(f"{name} {mode['mode']}")
            if (
                mode["shown"]
                and true is not None
                and not estimate["flag"]
                and estimate["interval_95"]
            ):
                yield f"{name} {mode['mode']}", true, estimate["value"], *estimate["interval_95"]
    if rig.uneven_percent:
        return  # its damping acts on the motion relative to the hub and has no order
    values = {"zeta": rig.zeta, "alpha": rig.alpha, "gamma": rig.gamma, "lambda": rig.lambda_}
    there = {"zeta": rig.zeta, "alpha": rig.zeta, "gamma": rig.gamma, "lambda": rig.gamma}
    for name, estimate in result["parameters"].items():
        if there.get(name) and estimate["interval_95"] and not estimate["flag"]:
            yield name, values[name], estimate["value"], *estimate["interval_95"]


def table(results: list[dict[str, Any]]) -> Iterator[str]:
    """Yield lines of times, coverage and bias."""
    failed = [each for each in results if "failed" in each]
    done = [each for each in results if "failed" not in each]
    reached = [each for each in done if each["search"]["reached"]]
    times = np.array([each["duration_s"] for each in reached])
    yield f"{len(results)} rigs, {len(failed)} failed, {len(reached)} reached the target"
    if times.size:
        percentiles = " ".join(f"{p} %: {np.percentile(times, p):.1f} s" for p in (10, 50, 90, 100))
        yield f"time to the target: {percentiles}; target {', '.join(_target_range(reached))}"
    for each in done:
        if not each["search"]["reached"]:
            rig = each["rig"]
            yield (
                f"  rig {rig['number']} (type {rig['structure']}, {1e3 * rig['noise_nm']:.0f} mN·m,"
                f" {each['duration_s']:.0f} s): {each['search']['reason']}"
            )
    ratios = np.array(list(predicted(done)))
    if ratios.size:
        low, median, high = np.percentile(ratios, (10, 50, 90))
        yield (
            f"stated over expected deviations: median {median:.2f}, 80 % from {low:.2f} to "
            f"{high:.2f} ({ratios.size})"
        )
    for kinds in (("damping",), ("frequency",), ("zeta", "alpha", "gamma", "lambda")):
        scores, hits = [], []
        for each in done:
            for name, true, value, low, high in intervals(each):
                if name.split()[0] in kinds:
                    hits.append(low <= true <= high)
                    scores.append((value - true) / ((high - low) / 3.92))
        if hits:
            yield (
                f"{' '.join(kinds)}: {sum(hits)} of {len(hits)} intervals hold the truth "
                f"({100 * np.mean(hits):.1f} %), bias {np.mean(scores):+.2f} std, "
                f"scatter {np.std(scores):.2f}, worst {max(map(abs, scores)):.1f}"
            )


def predicted(results: list[dict[str, Any]]) -> Iterator[float]:
    """Yield stated over predicted standard deviations, one for each quantity and segment."""
    for each in results:
        segments = [segment for segment in each["search"]["pieces"] if "expected" in segment]
        # A segment is chosen from the samples before the previous segment.
        for segment, later in zip(segments, segments[2:], strict=False):
            for one in segment["expected"]:
                if later["stated"].get(one["name"]):
                    yield later["stated"][one["name"]] / one["std"]


def _target_range(results: list[dict[str, Any]]) -> Iterator[str]:
    targets = [100 * each["target"] for each in results]
    for name, value in zip(
        ("least", "median", "most"), np.percentile(targets, (0, 50, 100)), strict=True
    ):
        yield f"{name} {value:.2g} %"


def main() -> None:
    """Run the sessions, or read them, print the results and check the limits."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rigs", type=int, default=4)
    parser.add_argument("--first", type=int, default=0, help="number of the first rig")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--uneven", action="store_true", help="beams that are not uniform")
    parser.add_argument("--at-most", type=float, default=120.0)
    parser.add_argument("--jsonl", type=Path, help="where each result is added")
    parser.add_argument("--table", type=Path, help="show what is there, run nothing")
    parser.add_argument("options", nargs="*", help="more options of rigd run until, after --")
    gate = Gate(ROWS, parser)
    chosen = gate.given
    drawn = draw_uneven if chosen.uneven else draw
    results = []
    if chosen.table:
        results = [json.loads(line) for line in chosen.table.read_text("utf-8").splitlines()]
    else:
        for number in range(chosen.first, chosen.first + chosen.rigs):
            result = run(drawn(number, chosen.seed), chosen.at_most, chosen.options)
            results.append(result)
            if chosen.jsonl:
                with chosen.jsonl.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(result) + "\n")
            outcome = result.get("failed") or f"{result['duration_s']:.1f} s, {result['reason']}"
            print(f"rig {number}: target {100 * result['target']:.2g} %, {outcome}", flush=True)
    print("\n".join(table(results)))
    failed = sum("failed" in each for each in results)
    done = [each for each in results if "failed" not in each]
    reached = sum(bool(each["search"]["reached"]) for each in done)
    gate.measured("sessions that failed", percent(failed, len(results)))
    gate.measured("sessions that reached the target", percent(reached, len(results)))
    held = [
        low <= true <= high
        for each in done
        for name, true, _, low, high in intervals(each)
        if name.startswith(("damping", "frequency"))
    ]
    gate.measured("95 % intervals of modes that hold the truth", percent(sum(held), len(held)))
    gate.finish()


if __name__ == "__main__":
    main()
