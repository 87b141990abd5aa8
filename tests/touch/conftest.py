"""Simulated records of touches, and an estimator for them, shared by the tests."""

import pytest
from struck_beam import ALIKE, MISTAKEN, OBSTACLES
from touch_records import DAMPED, LINK, Slew, simulate

from rigd.beam import Plant
from rigd.touch import TouchEstimator, TouchModel


@pytest.fixture(scope="session")
def simulated_records(computed_once):
    """Function that simulates a record per obstacle, by name, once for all workers."""

    def records(name, obstacles, slews, duration_s):
        def simulate_all():
            return simulate(
                obstacles.values(), slews, duration_s=duration_s, steps=20, modes=20, seed=4
            )

        return dict(zip(obstacles, computed_once(f"touch_{name}", simulate_all), strict=True))

    return records


@pytest.fixture(scope="session")
def records_by_name(simulated_records):
    """Records of 0.8 s with the true touch, by the name of the obstacle."""
    return simulated_records("struck", OBSTACLES, [Slew(1.0)] * len(OBSTACLES), 0.8)


@pytest.fixture(scope="session")
def ambiguous_records(simulated_records):
    """Records of obstacles that resemble one at rest or at another position, by name."""
    obstacles, slews = zip(*(MISTAKEN | ALIKE).values(), strict=True)
    return simulated_records(
        "mistaken", dict(zip(MISTAKEN | ALIKE, obstacles, strict=True)), slews, 0.85
    )


@pytest.fixture(scope="session")
def model():
    """Model of the simulated beam, with small uncertainties of its parameters."""
    return TouchModel(
        Plant(LINK, DAMPED),
        std_by_parameter={
            "bending_stiffness_n_m2": 5e-4 * LINK.bending_stiffness_n_m2,
            "density_over_stiffness": 2e-4 * LINK.density_over_stiffness,
            "zeta": 0.05 * DAMPED.zeta,
        },
    )


@pytest.fixture(scope="session")
def estimator(model):
    """Estimator for all tests."""
    return TouchEstimator(model, 1000.0)
