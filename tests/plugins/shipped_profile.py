import csv
from dataclasses import replace
from pathlib import Path

import pytest

from rigd.beam import Damping
from rigd.control import LoopModel
from rigd.profile import Profile, load_profile

ROOT = Path(__file__).resolve().parents[2]


def load_shipped(name: str) -> Profile:
    """Return a shipped profile whose simulated noise is the same in each run of the tests."""
    profile = load_profile(name)
    assert profile.rig.simulation is not None
    simulation = replace(profile.rig.simulation, seed=1)
    return replace(profile, rig=replace(profile.rig, simulation=simulation))


@pytest.fixture(scope="session")
def profile() -> Profile:
    return load_shipped("sim")


@pytest.fixture(scope="session")
def loop_model(profile: Profile) -> LoopModel:
    return profile.loop_model()


@pytest.fixture(scope="session")
def motor_alone(loop_model: LoopModel) -> LoopModel:
    return replace(loop_model, plant=None, actuation_delay_s=0.0)


def table3() -> dict[str, Damping]:
    """Mean parameters of the paper's Table 3: "VI-omega" → damping."""
    means: dict[str, dict[str, float]] = {}
    with (ROOT / "tests/data/paper_table3.csv").open() as file:
        for row in csv.DictReader(file):
            name = row["parameter"].replace("lambda", "lambda_")
            means.setdefault(f"{row['type']}-{row['weighting']}", {})[name] = float(row["mean"])
    return {name: Damping(**values) for name, values in means.items()}


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "paper_damping" in metafunc.fixturenames:
        sets = table3()
        metafunc.parametrize("paper_damping", sets.values(), ids=list(sets))


@pytest.fixture
def sim_toml() -> str:
    return (ROOT / "hw_profiles/sim.toml").read_text(encoding="utf-8")
