"""Thinned points stand for all of them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from analysis.models import weights
from analysis.paper import representative_points
from rigd.beam import transfer


@given(n=st.integers(3, 900), count=st.integers(2, 900), seed=st.integers(0, 2**32 - 1))
def test_weights_are_distributed(n, count, seed):
    rng = np.random.default_rng(seed)
    measured = rng.normal(size=n) + 1j * rng.normal(size=n)
    every = rng.random(n)
    every /= every.sum()
    index, weight_sums = representative_points(measured, every, count)
    assert index.size == weight_sums.size <= max(count, 1)
    assert (np.diff(index) > 0).all()
    # Every point counts for the chosen one that is nearest, of two the later.
    distance = np.abs(np.arange(n)[:, None] - index[::-1])
    owner = index.size - 1 - np.argmin(distance, axis=1)
    np.testing.assert_allclose(weight_sums, np.bincount(owner, every, index.size), rtol=1e-9)
    assert weight_sums.sum() == pytest.approx(1.0)
    assert (weight_sums > 0).all()
    if count >= n:
        np.testing.assert_array_equal(index, np.arange(n))


def test_flat_zero_response_is_thinned_evenly():
    index, _ = representative_points(np.zeros(1000, dtype=complex), np.full(1000, 1e-3), 100)
    assert np.diff(index).max() <= 11


@pytest.mark.parametrize("weighting", ["const", "omega"])
def test_costs_of_models_are_preserved(noisy_frf, link, paper_dampings, weighting):
    """Within 5 % of the whole cost, for all models that the paper fitted."""
    every = weights(2 * np.pi * noisy_frf.frequency_hz, weighting)
    index, weight_sums = representative_points(noisy_frf.response, every, 800)
    s = 2j * np.pi * noisy_frf.frequency_hz
    for damping in paper_dampings.values():
        square = np.abs(transfer(s, link, damping) - noisy_frf.response) ** 2
        assert weight_sums @ square[index] == pytest.approx(every @ square, rel=0.05)
