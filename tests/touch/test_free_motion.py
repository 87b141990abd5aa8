"""Free motion of the beam: what does not depend on how it is computed."""

import numpy as np
import pytest
from struck_beam import cut

from rigd.touch import FreeBeam


@pytest.fixture(scope="module")
def motions(model, struck):
    """Of one record, at many places, and at three of them alone."""
    record = cut(struck["middle"], 50)
    x_m = np.linspace(0.1, 1.0, 128) * model.plant.beam.length_m
    beam = FreeBeam(model, x_m, record.rate_hz, record.angle_rad.size)
    some = [0, 70, -1]
    quiet = record.detected - 13
    alone = beam.at_positions(x_m[some])
    of_many = beam.motion(record, quiet, quiet)
    return some, of_many, alone.motion(record, quiet, quiet, of_many.angle_transform), record


def test_places_between_the_nodes_move_as_they_do_alone(motions):
    some, of_many, alone, _ = motions
    assert alone.displacement_m == pytest.approx(of_many.displacement_m[some], abs=1e-12)


def test_an_angle_that_is_transformed_already_gives_the_same_innovations(motions, model):
    _, of_many, alone, record = motions
    anew = FreeBeam(model, np.array([0.5]), record.rate_hz, record.angle_rad.size).motion(
        record, record.detected - 13, record.detected - 13
    )
    for each in (alone, anew):
        assert each.innovations == pytest.approx(of_many.innovations, abs=1e-12)
