"""Which numbers a tolerance of the geometry lets stand where the beam is not uniform."""

import numpy as np
import pytest

from analysis.identify.modal_headline import NOT_UNIFORM_REASON, effective_reason
from analysis.identify.tolerant_estimate import TolerantEstimate
from analysis.identify.uniform_beam import PARAMETERS
from rigd.beam import Damping, Plant
from rigd.testing import PAPER_BEAM


@pytest.fixture
def estimate_with():
    """Estimate whose lambda has an interval, and a rise of chi-square at 1 by the losses alone."""

    def make(interval, deviance, stated_uniformity=3e-3):
        plant = Plant(PAPER_BEAM, Damping(1e-4, 1.0, 0.05, 0.6))
        values = plant.parameters
        return TolerantEstimate(
            basis="geometry",
            uniformity=3e-3,
            stated_uniformity=stated_uniformity,
            p_value=0.2,
            plant=plant,
            values=values,
            std=dict.fromkeys(PARAMETERS, 0.1),
            interval={name: (values[name], values[name]) for name in PARAMETERS}
            | {"lambda": interval},
            covariance=np.eye(len(PARAMETERS)),
            first_rad_s=16.0,
            deviance_of_order_one={"alpha": 0.0, "lambda": deviance},
            deviance_without_damping={"zeta": 1e3, "gamma": 1e3},
        )

    return make


@pytest.mark.parametrize(
    ("interval", "deviance", "rests"),
    [((0.05, 0.15), 0.25, True), ((0.5, 0.7), 30.0, False), ((0.9, 1.1), 0.0, False)],
)
def test_order_from_frequencies_alone_flags_internal_damping(
    estimate_with, interval, deviance, rests
):
    estimate = estimate_with(interval, deviance)
    assert estimate.rests_on_frequencies is rests
    for name in ("zeta", "alpha"):
        reason = effective_reason(estimate, name, refused=True)
        assert reason == (NOT_UNIFORM_REASON if rests else None)
        assert effective_reason(estimate, name, refused=False) is None
    assert effective_reason(estimate, "lambda", refused=True) == NOT_UNIFORM_REASON


@pytest.mark.parametrize(("deviance", "rests"), [(2.5, True), (5.0, False)])
def test_losses_must_exclude_order_one_beyond_stated_tolerance(estimate_with, deviance, rests):
    interval = (1.2, 1.6)
    assert estimate_with(interval, deviance, stated_uniformity=1e-3).rests_on_frequencies is rests
    assert not estimate_with(interval, deviance).rests_on_frequencies
