"""Free motion of the beam, computed in several equivalent ways."""

import numpy as np
import pytest
from struck_beam import cut

from rigd.touch import FreeBeam


@pytest.fixture(scope="module")
def motions(model, records_by_name):
    """Free motion in one record, computed at many positions and at three of them only."""
    record = cut(records_by_name["middle"], 50)
    x_m = np.linspace(0.1, 1.0, 128) * model.plant.beam.length_m
    beam = FreeBeam(model, x_m, record.rate_hz, record.angle_rad.size)
    selected = [0, 70, -1]
    quiet = record.detection_index - 13
    direct = beam.at_positions(x_m[selected])
    interpolated = beam.motion(record, quiet, quiet)
    return (
        selected,
        interpolated,
        direct.motion(record, quiet, quiet, interpolated.angle_transform),
        record,
    )


def test_interpolated_displacement_equals_direct_computation(motions):
    selected, interpolated, direct, _ = motions
    assert direct.displacement_m == pytest.approx(interpolated.displacement_m[selected], abs=1e-12)


def test_same_innovations_with_precomputed_transform(motions, model):
    _, interpolated, direct, record = motions
    recomputed = FreeBeam(model, np.array([0.5]), record.rate_hz, record.angle_rad.size).motion(
        record, record.detection_index - 13, record.detection_index - 13
    )
    for motion in (direct, recomputed):
        assert motion.innovations == pytest.approx(interpolated.innovations, abs=1e-12)
