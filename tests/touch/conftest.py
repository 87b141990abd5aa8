"""Records of touches, simulated once."""

import pytest
from struck_beam import ALIKE, MISTAKEN, OBSTACLES
from touch_records import DAMPED, LINK, Slew, simulate

from rigd.beam import Plant
from rigd.touch import TouchEstimator, TouchModel


@pytest.fixture(scope="session")
def simulated(computed_once):
    """Simulate records of obstacles by name, once for all workers."""

    def records(name, obstacles, slews, duration_s):
        def march():
            return simulate(
                obstacles.values(), slews, duration_s=duration_s, steps=20, modes=20, seed=4
            )

        return dict(zip(obstacles, computed_once(f"touch_{name}", march), strict=True))

    return records


@pytest.fixture(scope="session")
def struck(simulated):
    """Name → record of one second or so, and the truth."""
    return simulated("struck", OBSTACLES, [Slew(1.0)] * len(OBSTACLES), 0.8)


@pytest.fixture(scope="session")
def mistaken(simulated):
    """Name → record of what could be taken for an obstacle at rest, or elsewhere."""
    met, slews = zip(*(MISTAKEN | ALIKE).values(), strict=True)
    return simulated("mistaken", dict(zip(MISTAKEN | ALIKE, met, strict=True)), slews, 0.85)


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
