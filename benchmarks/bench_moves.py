"""Residual vibration: shortest moves through the real engine, and quintics of the same duration.

For each of N rigs (``--rigs``, 1), whose stiffness, density and damping lie within 10 % of the
profile's, one short session (``--identify`` s of chirp) is run and analysed, and moves of 0.1, 0.5
and 1.2 rad of both kinds are planned with the identified beam. Friction, sensor noise and encoder
steps are those of the profile ``sim``. A quintic of the same duration is run for each. The residual
torque is the root sum of squares of the amplitudes of the first three modes, fitted with the true
poles to 4 s of the ring-down, together with decaying exponentials for the memory of fractional
damping, which is no vibration.

The sensor noise alone gives an amplitude: it is first measured with the motor holding, and each
move is also run without noise.

Printed per move: duration, in ms and in periods of mode 1; the residual torque with sensor noise
and without, and that of the quintic without, in mN·m; the ratio of the last two; the peak torque
over that of the motor; the processor time of planning.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from gate import Gate, Row
from numpy.typing import NDArray

from rigd.beam import Plant, clamped_free_eigenvalues, poles
from rigd.excitation.moves import quintic
from rigd.profile import Profile, load_profile
from rigd.runner.planning import excitation_for, plan_session
from rigd.session import read_session
from rigd.testing import write_profile

Real = NDArray[np.float64]
ANGLES_RAD = (0.1, 0.5, 1.2)
WIDE = {"limits.tip_slope_rad": 1.5}
"""Moves of half a radian or more bend the beam beyond the range of a linear model."""
ROWS = (
    # Measured 0.7 and 1.2 %, 90 % and less than a second: docs/validation/moves.md.
    Row("vibration left, shortest", most=2, unit="% of a quintic's"),
    Row("vibration left, robust", most=3, unit="% of a quintic's"),
    Row("peak torque", most=100, unit="% of the motor's"),
    Row("planning", most=10, unit="s of processor"),
)
_FITTED_S = (0.1, 4.1)
_MODES = 3
_FADING_PER_S = np.append(0.0, np.geomspace(0.25, 32.0, 8))


def rig(folder: Path, number: int) -> tuple[Path, Path]:
    """Write profiles of a rig whose beam differs from the shipped profile, except for the first.

    Return the paths of the profile with sensor noise, and without.
    """
    nominal = load_profile("sim").rig
    off = np.random.default_rng(number).uniform(0.9, 1.1, 4) if number else np.ones(4)
    values = {
        "name": f"rig-{number}",
        "beam.bending_stiffness_n_m2": nominal.beam.bending_stiffness_n_m2 * off[0],
        "beam.density_kg_per_m": nominal.beam.density_kg_per_m * off[1],
        "beam.damping.zeta": nominal.damping.zeta * off[2],
        "beam.damping.gamma": nominal.damping.gamma * off[3],
    }
    values = {key: value if key == "name" else float(value) for key, value in values.items()}
    silent = {"simulation.torque_noise_nm": 0.0, "simulation.force_noise_n": 0.0}
    profiles = []
    for kind, other in (("noisy", {}), ("silent", silent)):
        where = folder / f"{kind}-{number}"
        where.mkdir()
        profiles.append(write_profile(where, values | WIDE | other))
    return profiles[0], profiles[1]


def run(profile: Path, *arguments: str) -> Path:
    """Run a session under the virtual clock; return its file."""
    command = [sys.executable, "-m", "rigd", "run", *arguments, "--profile", str(profile)]
    command += ["--fast", "--seed", "1", "--json", "--no-look", "--output", str(profile.parent)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(done.stderr)
    return Path(json.loads(done.stdout)["sessions"][0]["path"])


def own_poles(profile: Profile) -> NDArray[np.complex128]:
    """Return the poles of the first modes of the simulated beam."""
    rig = profile.rig
    assert rig.simulation is not None
    own = Plant(
        rig.beam,
        rig.damping,
        tip_mass_kg=rig.simulation.tip_mass_kg,
        root_compliance_rad_per_nm=rig.simulation.clamp_compliance_rad_per_nm,
    )
    return own.poles(clamped_free_eigenvalues(_MODES))[:, 0]


def left_nm(session: Path, profile: Profile) -> tuple[float, float]:
    """Return the residual torque of the modes after the sweep, and the peak torque of the motor."""
    found = read_session(session)
    end = found.segments["sweep"][1]
    rate_hz = profile.rig.rate_hz
    torque = found.samples["coupling_torque_nm"]
    first, last = (end + round(rate_hz * s) for s in _FITTED_S)
    t = np.arange(last - first) / rate_hz
    ringing = own_poles(profile)
    waves = np.exp(np.outer(t, ringing))
    slow = np.exp(-np.outer(t, _FADING_PER_S))
    columns = np.column_stack([waves.real, waves.imag, slow])
    fitted = np.linalg.lstsq(columns, torque[first:last], rcond=None)[0]
    amplitude = np.hypot(fitted[:_MODES], fitted[_MODES : 2 * _MODES])
    # Amplitudes at the end of the move.
    amplitude *= np.exp(-ringing.real * _FITTED_S[0])
    peak = float(np.abs(found.samples["torque_command_nm"]).max())
    return float(np.sqrt((amplitude**2).sum())), peak


def main() -> None:
    """Print a table of all moves."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rigs", type=int, default=1)
    parser.add_argument("--identify", type=float, default=20.0)
    gate = Gate(ROWS, parser)
    options = gate.given
    os.environ["RIGD_NO_LOOK"] = "1"
    import scipy.optimize  # noqa: F401 - not part of the time of planning

    print("rig    angle  kind        time  periods  noisy  silent  quintic    ratio  peak  plan")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        moves = [
            move
            for number in range(options.rigs)
            for move in one_rig(*rig(folder, number), options.identify)
        ]
    for kind in ("shortest", "robust"):
        left = max(left for of, left, _, _ in moves if of == kind)
        gate.measured(f"vibration left, {kind}", 100 * left)
    gate.measured("peak torque", 100 * max(peak for _, _, peak, _ in moves))
    gate.measured("planning", max(plan_s for *_, plan_s in moves))
    gate.finish()


def one_rig(
    path: Path, silent: Path, identify_s: float
) -> Iterator[tuple[str, float, float, float]]:
    """Identify a rig and move it.

    Yield the kind of each move, its residual vibration over that of a quintic, its peak torque over
    that of the motor, and the processor time of planning.
    """
    profile = load_profile(path)
    held = [
        left_nm(run(path, "hold", "--duration", "1", "--ring-down", "5", "--seed", seed), profile)
        for seed in "3456"
    ]
    print(f"{profile.name}  hold {1e3 * np.mean(held, axis=0)[0]:.2f} mN·m", flush=True)
    chirp = run(path, "chirp", "--duration", f"{identify_s:g}", "--ring-down", "5")
    model = path.parent / "model.json"
    subprocess.run(
        [sys.executable, "-m", "analysis", str(chirp), "--json", str(model)],
        check=True,
        capture_output=True,
    )
    period_s = 2 * np.pi / abs(poles(profile.rig.beam, profile.rig.damping, 1)[0, 0])
    for angle_rad in ANGLES_RAD:
        for robust in (0, 1):
            parameters = {"by_rad": angle_rad, "path": model, "robust": robust}
            start_s = time.process_time()
            move = excitation_for(profile, "move", parameters)
            plan_s = time.process_time() - start_s
            plan_session(profile, move)
            flag = ("--robust",) if robust else ()
            move_it = ("move", f"{angle_rad:g}", "--model", str(model), *flag)
            noisy, peak_nm = left_nm(run(path, *move_it), profile)
            left, _ = left_nm(run(silent, *move_it), profile)
            duration_s = float(move.parameters["duration_s"])
            usual = path.parent / "quintic.csv"
            shape = angle_rad * quintic(duration_s, profile.rig.rate_hz)
            usual.write_text("angle_rad\n" + "\n".join(map(repr, shape.tolist())))
            before, _ = left_nm(
                run(silent, "file", str(usual), "--ring-down", "5", "--force"), profile
            )
            peak = peak_nm / profile.rig.motor.peak_torque_nm
            yield "robust" if robust else "shortest", left / before, peak, plan_s
            print(
                f"{profile.name} {angle_rad:6.1f}  {'robust' if robust else 'shortest':8} "
                f"{1e3 * duration_s:4.0f} ms {duration_s / period_s:8.3f} {1e3 * noisy:6.2f} "
                f"{1e3 * left:7.2f} {1e3 * before:8.1f} {100 * left / before:6.2f} % "
                f"{peak:5.2f} {plan_s:4.2f} s",
                flush=True,
            )


if __name__ == "__main__":
    main()
