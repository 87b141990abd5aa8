"""A record in which nothing was excited is refused for that, before segments are discussed."""

from types import SimpleNamespace

import numpy as np
import pytest

from analysis.models import WelchSettings
from analysis.paper import FrequencyResponseError
from analysis.paper.welch_analysis import analyse

pytestmark = pytest.mark.fit


@pytest.mark.parametrize(
    ("metadata", "angle_rad", "words"),
    [
        ({"excitation": "hold"}, np.tile([0.0, 7e-5], 500), "the motor was held"),
        ({}, np.full(1000, 0.1), "the angle never changes"),
    ],
)
def test_simplest_reason_comes_first(metadata, angle_rad, words):
    """The record is too short for a Welch segment as well."""
    record = SimpleNamespace(
        path="a.mcap",
        metadata=metadata,
        angle_rad=angle_rad,
        angle_known=np.ones(angle_rad.size, dtype=bool),
        rate_hz=1000.0,
        sweep_samples=angle_rad.size,
    )
    with pytest.raises(
        FrequencyResponseError, match=rf"^a\.mcap: nothing was excited: {words}"
    ) as raised:
        analyse(record, WelchSettings())
    assert "segment" not in str(raised.value)
