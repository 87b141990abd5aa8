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
    there=None,
)


def test_a_record_is_taken_over():
    measurement = Measurement.from_record(RECORD)
    assert measurement.name == "session.mcap"
    assert measurement.delay_s == pytest.approx(3e-4)  # by how much the torque is older
    assert measurement.tool_inertia_kg_m2 == 1e-5
    assert measurement.uniformity == 2e-3
    assert measurement.nominal.filter_time_constant_s == 2e-3
    assert measurement.nominal.second_order_filter_time_constant_s == 0.0
    assert measurement.reference_rad is RECORD.reference_rad
    assert measurement.angle_known.all()
    assert measurement.torque_known.all()
    assert measurement.known_torque_fraction == 1.0
    assert measurement.angle_from_rest(50.0) == pytest.approx(RECORD.angle_rad - 0.1)


def test_a_motor_that_was_held_excites_nothing():
    held = SimpleNamespace(**vars(RECORD) | {"metadata": {"excitation": "hold"}})
    with pytest.raises(MeasurementError, match="the motor was held"):
        Measurement.from_record(held)


def test_its_masks_and_its_first_angle():
    known = np.arange(300) % 10 != 3
    masks = {"angle_known": known, "torque_known": known}
    measurement = Measurement.from_record(
        SimpleNamespace(**vars(RECORD) | masks | {"rest_angle_rad": None})
    )
    assert measurement.known_torque_fraction == pytest.approx(0.9)
    assert measurement.angle_from_rest(50.0)[0] == 0.0
    assert measurement.angle_from_rest(50.0) == pytest.approx(RECORD.angle_rad - 0.1, abs=1e-4)
