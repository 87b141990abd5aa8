"""Drag of the air: found where it exists, with no false finding; not searched for elsewhere."""

from dataclasses import replace

import numpy as np
import pytest
from wrong_models import RIGS, Drag, drags

from analysis.identify import select
from analysis.identify._drag import (
    damping_ratio_per_law_coefficient,
    damping_with_amplitude,
    refit_with_air_drag,
)
from analysis.identify.drag_torque import HALF_AIR_DENSITY_KG_PER_M3
from analysis.models import STRUCTURES
from rigd.beam import mode_shape
from rigd.runtime.computations import ForkedComputation

pytestmark = pytest.mark.fit

NOISE_NM = 5e-3
DRAG_M = 2.3e-3


@pytest.fixture(scope="module")
def braked(sessions, plants, link, brake):
    """The first 13.5 s of a session of type III in air, past two modes, made by steps in time."""
    still = sessions("III").cut(0, 13_500)
    more = brake.drag_torque(still.angle_rad, 1000.0, link, plants["III"], DRAG_M)
    return replace(still, torque_nm=still.torque_nm + more)


@pytest.fixture(scope="module")
def uniform(braked, candidates_of):
    return candidates_of(braked.measured(noise_nm=NOISE_NM, seed=61))


@pytest.fixture(scope="module")
def refitted(uniform):
    found = refit_with_air_drag(uniform)
    return found.with_leading_candidate(found.freest)


@pytest.mark.further  # together what the tests below show in parts
def test_only_drag_is_reported(braked):
    verdict = select(braked.measured(noise_nm=NOISE_NM, seed=61)).verdict
    assert (verdict.structure, verdict.adequate) == ("III", True)
    (found,) = verdict.findings
    assert (found.kind, found.unit) == ("air drag", "m")
    low, high = found.interval
    assert abs(found.value - DRAG_M) < 3 * (high - low) / (2 * 1.96)
    assert "C_D d" in found.sentence


def test_drag_leaves_noise_only(uniform, refitted):
    assert not uniform.is_nearly_white(uniform.likeliest_fit)
    assert refitted.is_nearly_white(refitted.likeliest_fit)
    names = [candidate.name for candidate in refitted.candidates]
    assert sorted(names) == sorted(STRUCTURES)


def test_fits_with_drag_reach_another_process(refitted):
    """A report has them computed in a copy of its process, and stores them."""
    with ForkedComputation(lambda: refitted) as copy:
        received = copy.value()
    expected, found = refitted.likeliest_fit, received.likeliest_fit
    np.testing.assert_array_equal(found.residual, expected.residual)
    series_nm = np.sin(0.01 * np.arange(refitted.comparison.torque_nm.size))
    np.testing.assert_array_equal(
        received.comparison.drag.band_spectrum(series_nm),
        refitted.comparison.drag.band_spectrum(series_nm),
    )


def test_size_of_drag_is_right(refitted):
    drag = refitted.drag
    assert abs(drag.drag_m - DRAG_M) < 3 * drag.std_m
    assert drag.std_m < 0.04 * DRAG_M


def test_beam_parameters_with_drag_are_right(refitted, plants, link):
    fit, damping = refitted.freest.fit, plants["III"]
    truth = {
        "zeta": damping.zeta,
        "gamma": damping.gamma,
        "density_over_stiffness": link.density_over_stiffness,
        "bending_stiffness_n_m2": link.bending_stiffness_n_m2,
        "delay_s": 0.0,
    }
    for name, value in truth.items():
        low, high = fit.interval[name]
        middle, half = (low + high) / 2, (high - low) / 2
        assert abs(value - middle) < 3 / 1.96 * half, name


def test_drag_is_not_fitted_without_air(sessions, candidates_of):
    measured = sessions("VI").measured(noise_nm=NOISE_NM, seed=62)
    field = candidates_of(measured)
    assert refit_with_air_drag(field) is field
    assert field.drag is None


def test_damping_grows_with_the_amplitude(refitted, link):
    rows = [at for at in damping_with_amplitude(refitted) if at.mode == 1]
    ratios = [at.damping_ratio for at in rows]
    large = [at.damping_ratio for at in rows if at.tip_amplitude_m > 0.005]
    assert large == sorted(large)
    assert large[0] > ratios[0]
    assert ratios[0] == refitted.best.fit.modes[0].damping_ratio
    # By 4/(3 pi) rho_air/2 C_D d A kappa / rho, with kappa = 0.739 of a clamped beam's first mode.
    fraction = 4 / (3 * 3.14159) * 0.6 * DRAG_M * 0.739 / link.density_kg_per_m
    wanted = rows[-1].tip_amplitude_m * fraction
    assert ratios[-1] - ratios[0] == pytest.approx(wanted, abs=3 * rows[-1].std + 0.02 * wanted)


@pytest.mark.further  # with external damping it is above
def test_size_of_drag_without_external_damping_is_right():
    """With an order at the end of its range, each step reduces the cost by less than predicted."""
    wire = Drag(replace(RIGS["III"], gamma=0.0), 2e-3, 0.0125, cylinder=True)
    (made,) = drags([wire], [9523])
    headline = select(made.measurement()).headline
    drag, speed_m_s = headline.parameters["drag"], headline.drag_speed_m_s
    assert abs(drag.value - wire.true_m(speed_m_s)) < 3.5 * drag.std
    for mode, ratio in zip(headline.modes, wire.rig.damping_ratios.tolist(), strict=True):
        assert abs(mode.damping_ratio.value - ratio) < 3.5 * mode.damping_ratio.std


# Equivalent damping of a mode in air, against the energy that the air takes in a cycle


@pytest.mark.parametrize("mode", [1, 2])
@pytest.mark.parametrize(("number", "power"), [(0, 2.0), (1, 4 / 3)])
def test_air_dissipates_as_equivalent_linear_damping(mode, number, power):
    omega, amplitude, density = 16.0, 0.05, 4.7e-3
    x = (np.arange(2000) + 0.5) / 2000
    turn = 2 * np.pi * (np.arange(720) + 0.5) / 720
    shape = mode_shape(mode, x) / mode_shape(mode, 1.0)
    speed = omega * amplitude * np.outer(shape, np.sin(turn))
    taken = np.mean(HALF_AIR_DENSITY_KG_PER_M3 * np.abs(speed) ** (power + 1))
    ratio = damping_ratio_per_law_coefficient(mode, omega, amplitude, density)[number]
    linear = np.mean(2 * ratio * omega * density * speed**2)
    assert taken == pytest.approx(linear, rel=1e-3)


def test_air_dissipates_nothing_at_rest():
    assert damping_ratio_per_law_coefficient(1, 16.0, 0.0, 4.7e-3) == pytest.approx([0.0, 0.0])
