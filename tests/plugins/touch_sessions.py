"""A session whose antenna strikes an obstacle, simulated by other code than the estimator's."""

import pickle
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from touch_records import (
    DAMPED,
    LINK,
    RATE_HZ,
    SHEAR_NOISE_N,
    TORQUE_NOISE_NM,
    Obstacle,
    Slew,
    Struck,
    simulate,
)

from rigd.session import SessionWriter
from rigd.session.layout import SAMPLE_SIZE, Status, pack_sample_into

REST = 600
OBSTACLE = Obstacle(x_m=0.62, angle_rad=0.6, stiffness_n_per_m=3000)
NOTICED = 5
"""Ticks from the touch to the one in which a loop would detect it."""

PROFILE = f"""
[beam.damping]
zeta = {{ value = {DAMPED.zeta}, source = "paper" }}
alpha = {{ value = {DAMPED.alpha}, source = "paper" }}
gamma = {{ value = {DAMPED.gamma}, source = "paper" }}
lambda = {{ value = {DAMPED.lambda_}, source = "paper" }}
"""


@dataclass
class TouchFile:
    """A session file and the truth."""

    path: Path
    obstacle: Obstacle
    time_s: float
    peak_n: float
    write: Callable[..., Path]


def written(path, struck, *, marked=True, metadata=None, profile=PROFILE, length=None, gap=()):
    """Write the record behind a rest; ticks of `gap` are missing."""
    random = np.random.default_rng(5)
    torque = np.concatenate([TORQUE_NOISE_NM * random.normal(size=REST), struck.torque_nm])
    shear = np.concatenate([SHEAR_NOISE_N * random.normal(size=REST), struck.shear_n])
    angle = np.concatenate([np.zeros(REST), struck.angle_rad])
    noticed = REST + int(struck.touch_s * RATE_HZ) + NOTICED
    block = bytearray()
    for tick in range(length or angle.size):
        if tick in gap:
            continue
        message = bytearray(SAMPLE_SIZE)
        status = Status.TOUCHED if marked and tick == noticed else 0
        pack_sample_into(
            message, 0, tick * 1_000_000, tick, angle[tick], angle[tick], 0.0, torque[tick], 0.0,
            shear[tick], 0.0, 0.0, 0.0, torque[tick], status, 0, 0,
        )  # fmt: skip
        block += message
    stated = {
        "rate_hz": f"{RATE_HZ}",
        "beam_length_m": f"{LINK.length_m}",
        "beam_density_kg_per_m": f"{LINK.density_kg_per_m}",
        "beam_bending_stiffness_n_m2": f"{LINK.bending_stiffness_n_m2}",
        "shear_projection": "0,1,0,0,0,0",
    }
    writer = SessionWriter(path)
    writer.begin(
        1_800_000_000 * 10**9,
        stated | (metadata or {}),
        {"rest": (0, REST), "sweep": (REST, angle.size)},
        {"profile.toml": profile.encode()} if profile else {},
    )
    writer.write_samples(block)
    return writer.close({"outcome": "complete"})


@pytest.fixture(scope="session")
def touch_file(made_once):
    def make(folder):
        (made,) = simulate([OBSTACLE], [Slew(1.0)], duration_s=0.95, steps=40, modes=24, seed=7)
        written(folder / "touch.mcap", made)
        (folder / "struck.pickle").write_bytes(pickle.dumps(made))

    path = made_once("touches", make) / "touch.mcap"
    struck: Struck = pickle.loads(path.with_name("struck.pickle").read_bytes())

    def write(other, **changes):
        return written(other, struck, **changes)

    return TouchFile(path, OBSTACLE, REST / RATE_HZ + struck.touch_s, struck.peak_n, write)


@pytest.fixture(scope="session")
def touch_analysis():
    """One for all, whose preparation takes the longest."""
    from analysis.touch import TouchAnalysis

    return TouchAnalysis()


@pytest.fixture(scope="session")
def touched(touch_file, touch_analysis):
    """Return the analysis of the file."""
    return touch_analysis.analyse_session(touch_file.path)
