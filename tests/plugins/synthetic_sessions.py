"""Synthetic sessions: the paper's chirp through a motor loop and the exact model."""

from functools import partial

import numpy as np
import pytest

from analysis.models import WelchSettings
from analysis.paper.welch_analysis import analyse
from analysis.record import load_record
from rigd.testing import Signals, chirp_signals, write_session

RATE_HZ = 1000.0


@pytest.fixture(scope="session")
def paper_signals():
    return chirp_signals()


@pytest.fixture(scope="session", name="write_session")
def write_session_():
    return write_session


@pytest.fixture(scope="session")
def signals_of():
    return partial(Signals, metadata=CHIRP)


@pytest.fixture(scope="session")
def make_signals():
    return chirp_signals


@pytest.fixture(scope="session")
def paper_file(made_once):
    def make(folder):
        write_session(folder / "paper.mcap", chirp_signals())

    return made_once("paper_file", make) / "paper.mcap"


@pytest.fixture(scope="session")
def paper_analysis(paper_file, computed_once):
    """Three types of the paper's session, enough to show every kind of cell."""
    settings = WelchSettings(types=("I", "III", "VI"))
    return computed_once("paper_analysis", lambda: analyse(load_record(paper_file), settings))


CHIRP = {"excitation": "chirp", "start_hz": "0.05", "stop_hz": "50.0"}


@pytest.fixture
def short_signals():
    """Five seconds of a sine, for tests of the record, not of the estimate."""
    n = 5000
    t = np.arange(n) / RATE_HZ
    return Signals(
        reference_rad=0.01 * np.sin(2 * np.pi * t),
        angle_rad=0.01 * np.sin(2 * np.pi * t - 0.1),
        torque_nm=0.02 * np.cos(2 * np.pi * t),
        segments={"rest": (0, 500), "sweep": (500, 4500), "ring_down": (4500, n)},
        metadata=CHIRP,
    )
