"""Modes of published measurements: published values, and results of independent fits.

``bench_published_modes.py [--files FOLDER]``

The impact test is part of the project (tests/data/impact_test). Two more data sets may not be
redistributed here (one has no licence, the other is under the GPL); they are read from FOLDER if
they are there:

* ``SBPA_lame.mat`` of github.com/opatiny/matlab-scripts, in heig-vd/regul/labos/lame-flexible/data:
  a flexible blade with an actuator, driven by a pseudo-random binary signal at 1 kHz. Its author's
  model (reponse_freq_lame.m): 116 rad/s, damping ratio 0.005, delay 0.75 ms, adjusted by hand.
* ``ForcedFrequencyResponses.mat`` of github.com/mattiacenedese/BRBtesting: first bending mode of a
  free Brake-Reuss beam, acceleration over force at eight constant amplitudes (Chen et al. 2022,
  doi.org/10.1016/j.ymssp.2021.108401; Jin et al. 2022, doi.org/10.1016/j.ymssp.2021.108402). At a
  constant amplitude a nonlinear mode responds as a linear one. The second result is from the phase
  alone.
"""

import argparse
import hashlib
from pathlib import Path

import numpy as np
from gate import Gate, Row
from published_data import (
    Resonance,
    blade,
    brake_reuss_beam,
    fit_poles,
    fit_record,
    impact_test,
    periodic_record,
    phase_resonance,
)

SUMS = {
    "SBPA_lame.mat": "b9d3f33a6f39dc32fa31b0896224a69759af8089098823d199e61ea035247dfd",
    "ForcedFrequencyResponses.mat": (
        "e4bfe248b921edbd23153c24a37c3a9e1556fb1bf59fe6d9e63ae8e2177f1100"
    ),
}
# Measured 0.008 and 6.7 (vector fitting), 0.006 and 5.7 (analyzer); the source's own damping ratio
# depends on the band by 5 %.
ROWS = tuple(
    Row(f"impact test, {what} by {who}", most=most, unit="% off the source")
    for what, most in (("frequency", 0.015), ("damping ratio", 9.0))
    for who in ("vector fitting", "the analyzer")
)
AUTHORS_BLADE_MODEL = Resonance(116 / (2 * np.pi), 0.005)


SLOWDOWN = 10
"""Slowdown of the record of the impact test, since the analyzer reads 1 kHz."""


def line(name: str, reference: Resonance, *found: Resonance) -> str:
    """Return a row of the table."""
    cells = [name, f"{reference.frequency_hz:.3f}"]
    cells += [
        f"{each.frequency_hz:.3f} ({each.frequency_hz / reference.frequency_hz - 1:+.3%})"
        for each in found
    ]
    cells += [""] * (2 - len(found))
    cells.append(f"{reference.damping_ratio:.3%}")
    cells += [
        f"{each.damping_ratio:.3%} ({each.damping_ratio / reference.damping_ratio - 1:+.1%})"
        for each in found
    ]
    cells += [""] * (2 - len(found))
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--files", type=Path, help="folder with the files that are not shipped")
    gate = Gate(ROWS, parser)
    folder: Path | None = gate.given.files
    print(
        "| data | frequency: source (Hz) | vector fitting (Hz) | analyzer (Hz) "
        "| damping ratio: source | vector fitting | analyzer |"
    )
    print("|---|---|---|---|---|---|---|")
    deviations: dict[str, list[float]] = {row.name: [] for row in ROWS}
    measured, published = impact_test()
    for mode in published:
        band = measured.within(mode.first_hz, mode.last_hz)
        (found,) = fit_poles(band, [212.0], 5)
        band_hz = (mode.first_hz / SLOWDOWN, mode.last_hz / SLOWDOWN)
        record = periodic_record(band, 250.0, 2, slowdown=SLOWDOWN)
        (slow,) = fit_record(record, band_hz, [212.0 / SLOWDOWN])
        own = Resonance(SLOWDOWN * slow.frequency_hz, slow.damping_ratio)
        name = f"impact test, {mode.first_hz:g}-{mode.last_hz:g} Hz"
        print(line(name, mode.resonance, found, own))
        for who, each in (("vector fitting", found), ("the analyzer", own)):
            for what, ratio in (
                ("frequency", each.frequency_hz / mode.resonance.frequency_hz),
                ("damping ratio", each.damping_ratio / mode.resonance.damping_ratio),
            ):
                deviations[f"impact test, {what} by {who}"].append(100 * abs(ratio - 1))
    for name in SUMS if folder else ():
        path = folder / name
        if not path.exists():
            print(f"{path} is missing: see --help.")
            continue
        if hashlib.sha256(path.read_bytes()).hexdigest() != SUMS[name]:
            print(f"{path} is another version than the one that was compared.")
        if name == "SBPA_lame.mat":
            record, response = blade(path)
            for first_hz, last_hz in ((10.0, 30.0), (5.0, 35.0), (1.0, 50.0)):
                (found,) = fit_poles(response.within(first_hz, last_hz), [18.5], 5)
                (own,) = fit_record(record, (first_hz, last_hz), [18.5])
                label = f"blade, {first_hz:g}-{last_hz:g} Hz"
                print(line(label, AUTHORS_BLADE_MODEL, found, own))
        else:
            for level in brake_reuss_beam(path):
                (found,) = fit_poles(level, [80.0], 1)
                print(line(level.name, phase_resonance(level), found))
    for name, percent in deviations.items():
        gate.measured(name, max(percent, default=np.nan))
    gate.finish()


if __name__ == "__main__":
    main()
