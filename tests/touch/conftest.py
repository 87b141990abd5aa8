"""Records of touches, simulated once."""

import pytest
from struck_beam import ALIKE, MISTAKEN, OBSTACLES
from touch_records import DAMPED, LINK, Slew, simulate

from rigd.beam import Plant
from rigd.touch import TouchEstimator, TouchModel


@pytest.fixture(scope="session")
def struck():
    """Name → record of one second or so, and the truth."""
    records = simulate(
        list(OBSTACLES.values()),
        [Slew(1.0)] * len(OBSTACLES),
        duration_s=0.8,
        steps=40,
        modes=20,
        seed=4,
    )
    return dict(zip(OBSTACLES, records, strict=True))


@pytest.fixture(scope="session")
def mistaken():
    """Name → record of what could be taken for an obstacle at rest."""
    obstacles, slews = zip(*MISTAKEN.values(), strict=True)
    records = simulate(obstacles, slews, duration_s=0.85, steps=40, modes=20, seed=4)
    return dict(zip(MISTAKEN, records, strict=True))


@pytest.fixture(scope="session")
def alike():
    """Name → record of two obstacles and of one that is like them."""
    records = simulate(
        list(ALIKE.values()),
        [Slew(0.87, 30.0)] * len(ALIKE),
        duration_s=0.85,
        steps=40,
        modes=20,
        seed=4,
    )
    return dict(zip(ALIKE, records, strict=True))


@pytest.fixture(scope="session")
def model():
    """The beam of the records, known well but not exactly."""
    return TouchModel(
        Plant(LINK, DAMPED),
        std={
            "bending_stiffness_n_m2": 5e-4 * LINK.bending_stiffness_n_m2,
            "density_over_stiffness": 2e-4 * LINK.density_over_stiffness,
            "zeta": 0.05 * DAMPED.zeta,
        },
    )


@pytest.fixture(scope="session")
def estimator(model):
    """Return an estimator for all records."""
    return TouchEstimator(model, 1000.0)
