"""The fitted model is the beam plus the clamp."""

import numpy as np

from analysis.models import FrequencyResponseModel
from rigd.beam import transfer, transfer_and_gradient


def test_clamp_adds_its_inertia(link, plant, paper_grid_hz):
    s = 2j * np.pi * paper_grid_hz
    model = FrequencyResponseModel(paper_grid_hz, link, tool_inertia_kg_m2=1e-5)
    expected = transfer(s, link, plant) + 1e-5 * s**2
    np.testing.assert_allclose(model.evaluate(plant), expected, rtol=1e-12)
    response, gradient = model.evaluate_with_gradient(plant, ("alpha", "gamma"))
    np.testing.assert_allclose(response, expected, rtol=1e-10)
    np.testing.assert_allclose(
        gradient, transfer_and_gradient(s, link, plant, ("alpha", "gamma"))[1], rtol=1e-12
    )


def test_clamp_moves_an_antiresonance(link, plant):
    frequency_hz = np.arange(25.0, 40.0, 0.01)
    dips = []
    for tool_inertia_kg_m2 in (0.0, 1e-5):
        model = FrequencyResponseModel(frequency_hz, link, tool_inertia_kg_m2)
        dips.append(frequency_hz[np.argmin(np.abs(model.evaluate(plant)))])
    # Without the clamp: tan z = tanh z, z = 7.0686 in (z / L)² sqrt(EI / rho).
    np.testing.assert_allclose(dips, [36.29, 31.78], atol=0.02)
