from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from analysis.identify import Measurement, MeasurementError
from rigd.beam import Beam

RECORD = SimpleNamespace(
    path=Path("session.mcap"),
    angle_rad=np.linspace(0.1, 0.2, 300),
    torque_nm=np.ones(300),
    angle_known=np.ones(300, dtype=bool),
    torque_known=np.ones(300, dtype=bool),
    rate_hz=1000.0,
    beam=Beam(0.98, 4.7e-3, 0.090275),
    rest_angle_rad=0.1,
    torque_delay_s=5e-4,
    angle_delay_s=2e-4,
    tool_inertia_kg_m2=1e-5,
    torque_filter_s=(2e-3, 0.0),
    reference_rad=np.linspace(0.1, 0.2, 300),
    metadata={"excitation": "chirp"},
    uniformity=2e-3,
    torque_extremes=(),
    tip_mass_kg=None,
    axis_tilt_deg=None,
    outward_sweep=None,
    part_s=None,
)


def test_record_is_read():
    measurement = Measurement.from_record(RECORD)
    assert measurement.name == "session.mcap"
    assert measurement.delay_s == pytest.approx(3e-4)  # by how much the torque is older
    assert measurement.tool_inertia_kg_m2 == 1e-5
    assert measurement.uniformity == 2e-3
    assert measurement.nominal_plant.filter_time_constant_s == 2e-3
    assert measurement.nominal_plant.second_order_filter_time_constant_s == 0.0
    assert measurement.reference_rad is RECORD.reference_rad
    assert measurement.angle_known.all()
    assert measurement.torque_known.all()
    assert measurement.known_torque_fraction == 1.0
    assert measurement.angle_from_rest_rad(50.0) == pytest.approx(RECORD.angle_rad - 0.1)


COUNT_RAD = 7e-5


def counts_used(counts, reference_rad):
    """Angle in counts that a fit uses for an encoder's readings."""
    record = {"angle_rad": counts * COUNT_RAD, "reference_rad": reference_rad}
    return Measurement.from_record(SimpleNamespace(**vars(RECORD) | record)).angle_rad / COUNT_RAD


def test_resting_encoder_between_two_counts_is_at_the_edge():
    counts = np.repeat([0, 5, 5, 6, 5, 6, 5, 6, 6, 6], 30)
    expected = counts.astype(float)
    expected[90:210] = 5.5
    assert counts_used(counts, np.zeros(300)) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("pattern", "reference_rad"),
    [
        ([0, 5, 5, 6, 5, 6, 5, 6, 6, 6], np.linspace(0.0, 1e-3, 300)),  # follows a reference
        ([0, 5, 5, 7, 5, 7, 5, 7, 7, 6], np.zeros(300)),  # moves by more than a count
        ([0, 5, 5, 6, 7, 6, 5, 6, 7, 6], np.zeros(300)),  # passes several counts
        ([0, 5, 5, 6, 5, 6, 6, 6, 6, 6], np.zeros(300)),  # returns twice only
    ],
)
def test_moving_encoder_is_read_unchanged(pattern, reference_rad):
    counts = np.repeat(pattern, 30)
    assert counts_used(counts, reference_rad) == pytest.approx(counts)


def test_held_motor_excites_nothing():
    held = SimpleNamespace(**vars(RECORD) | {"metadata": {"excitation": "hold"}})
    with pytest.raises(MeasurementError, match="the motor was held"):
        Measurement.from_record(held)


def test_masks_and_first_angle():
    known = np.arange(300) % 10 != 3
    masks = {"angle_known": known, "torque_known": known}
    measurement = Measurement.from_record(
        SimpleNamespace(**vars(RECORD) | masks | {"rest_angle_rad": None})
    )
    assert measurement.known_torque_fraction == pytest.approx(0.9)
    assert measurement.angle_from_rest_rad(50.0)[0] == 0.0
    assert measurement.angle_from_rest_rad(50.0) == pytest.approx(RECORD.angle_rad - 0.1, abs=1e-4)
