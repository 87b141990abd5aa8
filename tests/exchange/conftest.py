"""A session of the simulated rig, sessions of given arrays, and files of other programs."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from analysis.cli.app import app
from analysis.exchange import ImportPlan, parse_choice, read_specimen, write_session
from rigd.beam import Beam

PROJECT = Path(__file__).parents[2]
PROFILE = PROJECT / "hw_profiles" / "sim.toml"
BEAM = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.090275)
METADATA = {
    "rate_hz": "1000.0",
    "beam_length_m": repr(BEAM.length_m),
    "beam_density_kg_per_m": repr(BEAM.density_kg_per_m),
    "beam_bending_stiffness_n_m2": repr(BEAM.bending_stiffness_n_m2),
}


@pytest.fixture(scope="session")
def simulated(short_chirps):
    """A short chirp of the simulated rig: 0.5 s of rest, 20 s to 50 Hz, 1 s of ring-down."""
    return short_chirps[0]


@pytest.fixture
def make_session(tmp_path):
    """Write arrays, by the names of a sample's fields, as a session at 1 kHz."""

    def make(name="session.mcap", metadata=(), segments=(), **samples):
        length = len(next(iter(samples.values())))
        samples = {"tick": np.arange(length), **samples}
        path = tmp_path / name
        all_metadata = {**METADATA, **dict(metadata)}
        rate_hz = float(all_metadata["rate_hz"])
        write_session(path, samples, rate_hz, 10**18, all_metadata, dict(segments), ())
        return path

    return make


@pytest.fixture
def make_plan():
    """Plan the import of columns `angle` and `torque` at 1 kHz, unless stated otherwise."""

    def make(angle="angle:rad", torque="torque:N.m", time=None, others=(), **options):
        channels = {
            "angle_rad": parse_choice(angle, "angle"),
            "coupling_torque_nm": parse_choice(torque, "torque"),
            **dict(others),
        }
        if time is not None:
            options["time"] = parse_choice(time, "time")
        elif "rate_hz" not in options:
            options["rate_hz"] = 1000.0
        return ImportPlan(channels, read_specimen(PROFILE), **options)

    return make


@pytest.fixture
def csv_of(tmp_path):
    """Write columns as a CSV file, with all digits."""

    def write(name="record.csv", **columns):
        path = tmp_path / name
        rows = zip(*(np.asarray(values).tolist() for values in columns.values()), strict=True)
        lines = [",".join(columns), *(",".join(map(repr, row)) for row in rows)]
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return path

    return write


@pytest.fixture(scope="session")
def profile():
    return PROFILE


@pytest.fixture
def analyze():
    """Run the command in this process."""

    def run(*arguments):
        return CliRunner().invoke(app, list(map(str, arguments)))

    return run
