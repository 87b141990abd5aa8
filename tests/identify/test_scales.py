"""Scales that no session determines: values that change with them, intervals that include them."""

import math

import numpy as np
import pytest

from analysis.identify import fit_record
from analysis.identify.drag_torque import DragLaw, DragResponse
from analysis.identify.scales import (
    SCALE_EXPONENTS,
    density_check,
    parameters_compensate_scales,
    with_scale_uncertainty,
)
from analysis.models import STRUCTURES
from rigd.beam import Beam, Damping, Plant, ResponseGrid
from rigd.estimates import Estimate

LINK = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.090275)
DAMPING = Damping(zeta=7.1e-5, alpha=0.9, gamma=5.5e-2, lambda_=0.594)
TORQUE_SCALE, LENGTH_SCALE = 1.03, 1.02


def scaled(values, torque_scale=1.0, length=1.0):
    """Parameters as a session gives them whose torque or length is too large by a factor."""
    by = {"torque_scale": torque_scale, "length": length}
    return {
        name: value
        * math.prod(by[s] ** power for s, power in SCALE_EXPONENTS.get(name, {}).items())
        for name, value in values.items()
    }


def plant_of(values, length_m):
    stiffness = values["bending_stiffness_n_m2"]
    return Plant(
        Beam(length_m, values["density_over_stiffness"] * stiffness, stiffness),
        Damping(values["zeta"], values["alpha"], values["gamma"], values["lambda"]),
        delay_s=values["delay_s"],
        tool_inertia_kg_m2=values["tool_inertia_kg_m2"],
        stiffness_offsets=(values.get("stiffness_offset_2", 0.0),),
        filter_time_constant_s=values.get("filter_time_constant_s", 0.0),
    )


@pytest.mark.parametrize(
    "extras",
    [{"stiffness_offsets": (0.02,)}, {"filter_time_constant_s": 1e-3}],
)
def test_parameters_change_with_scales_as_stated(extras):
    """Exactly: no frequency response shows a wrong torque scale or length."""
    plant = Plant(LINK, DAMPING, delay_s=2e-4, tool_inertia_kg_m2=1e-5, **extras)
    grid = ResponseGrid(0.02 + 2j * np.pi * np.linspace(0.3, 60.0, 400))
    (true,) = grid.evaluate(plant)
    louder = plant_of(scaled(plant.parameters, torque_scale=TORQUE_SCALE), LINK.length_m)
    np.testing.assert_allclose(grid.evaluate(louder)[0], TORQUE_SCALE * true, rtol=1e-9)
    longer = scaled(plant.parameters, length=LENGTH_SCALE)
    found = grid.evaluate(plant_of(longer, LENGTH_SCALE * LINK.length_m))[0]
    np.testing.assert_allclose(found, true, rtol=1e-9)


def test_drag_changes_with_scales_as_stated():
    time_s = np.arange(4000) / 200.0
    angle_rad = 0.3 * np.sin(2 * np.pi * 2.4 * time_s) * np.sin(np.pi * time_s / 20) ** 2
    plant = Plant(LINK, DAMPING)
    values = {**plant.parameters, "drag": 2e-3}

    def torque(torque_scale=1.0, length=1.0):
        those = scaled(values, torque_scale, length)
        beam = plant_of(those, length * LINK.length_m)
        return DragResponse(angle_rad, 200.0, beam).torque(DragLaw(those["drag"])).torque_nm

    true = torque()
    assert np.abs(true).max() > 0.01
    largest = np.abs(true).max()
    np.testing.assert_allclose(
        torque(torque_scale=TORQUE_SCALE), TORQUE_SCALE * true, atol=1e-6 * largest
    )
    np.testing.assert_allclose(torque(length=LENGTH_SCALE), true, atol=1e-6 * largest)


@pytest.fixture(scope="module")
def fits(sessions):
    """Fit of one session, and of the same with a wrong torque scale and length."""
    session = sessions("VI", tool_inertia_kg_m2=1e-5)
    beam = Beam(LENGTH_SCALE * LINK.length_m, LINK.density_kg_per_m, LINK.bending_stiffness_n_m2)
    louder = type(session)(session.angle_rad, TORQUE_SCALE * session.torque_nm)
    found = (
        fit_record(each, [STRUCTURES["VI"]]).fits[0]
        for each in (session.measured(), louder.measured(beam=beam))
    )
    return tuple(found)


@pytest.mark.fit
def test_fits_to_scaled_data_follow_the_scales(fits):
    right, wrong = fits
    expected = scaled(right.parameters, TORQUE_SCALE, LENGTH_SCALE)
    for name, value in expected.items():
        assert wrong.parameters[name] == pytest.approx(value, rel=1e-4, abs=1e-9), name
    for before, after in zip(right.modes, wrong.modes, strict=True):
        assert after.frequency_hz == pytest.approx(before.frequency_hz, rel=1e-7)
        assert after.damping_ratio == pytest.approx(before.damping_ratio, rel=1e-5)
    assert wrong.cost == pytest.approx(right.cost, rel=0.1)


def test_intervals_include_the_scales_in_quadrature():
    def estimate(value, relative):
        ends = value * math.exp(-1.96 * relative), value * math.exp(1.96 * relative)
        return Estimate(value, relative * value, ends)

    parameters = {
        "zeta": estimate(7e-5, 0.02),
        "gamma": estimate(0.05, 0.003),
        "density_over_stiffness": estimate(0.052, 4e-5),
        "bending_stiffness_n_m2": estimate(0.09, 7e-4),
        "tool_inertia_kg_m2": Estimate(1e-6, 2e-6, (0.0, 1e-6 + 1.96 * 2e-6)),
        "tip_mass_kg": Estimate(1e-3, None, None, "the record does not determine it"),
    }
    found = with_scale_uncertainty(
        parameters, {"torque_scale": 0.01, "length": 0.002, "density": 0.1}
    )
    assert found.keys() == {
        "gamma", "density_over_stiffness", "bending_stiffness_n_m2", "tool_inertia_kg_m2",
    }  # fmt: skip
    relative = {
        "gamma": math.hypot(0.003, 4 * 0.002),
        "density_over_stiffness": math.hypot(4e-5, 4 * 0.002),
        "bending_stiffness_n_m2": math.hypot(7e-4, 0.01, 0.002),
    }
    for name, expected in relative.items():
        quantity = found[name]
        assert quantity.std == pytest.approx(expected * quantity.value)
        low, high = quantity.interval_95
        assert math.log(high / quantity.value) == pytest.approx(1.96 * expected, rel=1e-4)
        assert low * high == pytest.approx(quantity.value**2)
    low, high = found["tool_inertia_kg_m2"].interval_95
    assert low == 0.0
    assert high == pytest.approx(1e-6 + 1.96 * math.hypot(2e-6, 1e-8), rel=1e-4)
    assert with_scale_uncertainty(parameters, {}) == {}
    assert with_scale_uncertainty(parameters, {"density": 0.1}) == {}


@pytest.mark.fit
def test_intervals_with_scales_include_the_truth(fits):
    """Scales that are off by their standard uncertainties, which noise alone never is."""
    _, wrong = fits
    uncertainty = {"torque_scale": 0.03, "length": 0.02}
    parameters = {
        name: Estimate(value, wrong.std[name], wrong.interval[name])
        for name, value in wrong.parameters.items()
    }
    truth = {
        "gamma": 5.5e-2,
        "density_over_stiffness": LINK.density_over_stiffness,
        "bending_stiffness_n_m2": LINK.bending_stiffness_n_m2,
        "tool_inertia_kg_m2": 1e-5,
    }
    found = with_scale_uncertainty(parameters, uncertainty)
    assert found.keys() == truth.keys()
    for name, value in truth.items():
        low, high = found[name].interval_95
        assert low < value < high, name
        narrow_low, narrow_high = parameters[name].interval_95
        assert not narrow_low <= value <= narrow_high, name


@pytest.mark.fit
def test_fixed_parameters_do_not_compensate_a_scale(sessions):
    measurement = sessions("III").measured(noise_nm=1e-2, seed=1)

    def fixed(*names):
        return fit_record(measurement, [STRUCTURES["III"]], fixed_settings=names).fits[0]

    assert parameters_compensate_scales(fixed())
    assert parameters_compensate_scales(fixed("delay_s", "tool_inertia_kg_m2"))  # of no inertia
    assert not parameters_compensate_scales(fixed("bending_stiffness_n_m2"))
    assert not parameters_compensate_scales(fixed("density_over_stiffness"))


@pytest.mark.fit
def test_the_stated_density_checks_the_scales(fits):
    right, wrong = fits
    uncertainty = {"torque_scale": 0.005, "length": 0.001, "density": 0.003}
    good = density_check(right, LINK.density_kg_per_m, uncertainty)
    assert good.found_kg_per_m == pytest.approx(LINK.density_kg_per_m, rel=1e-4)
    assert good.found_std_kg_per_m / good.found_kg_per_m == pytest.approx(
        math.hypot(0.005, 3 * 0.001), rel=0.05
    )
    assert good.agree
    bad = density_check(wrong, LINK.density_kg_per_m, uncertainty)
    ratio = TORQUE_SCALE / LENGTH_SCALE**3
    assert bad.found_kg_per_m / LINK.density_kg_per_m == pytest.approx(ratio, rel=1e-3)
    assert not bad.agree
    assert density_check(right, LINK.density_kg_per_m, {"torque_scale": 0.01}) is None
