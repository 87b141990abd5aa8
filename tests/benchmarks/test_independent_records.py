"""Independent records, with which headlines are scored, agree with Eq. 25."""

import numpy as np
import pytest
from cases import further
from independent_records import (
    DENSITY_KG_PER_M,
    LENGTH_M,
    RATE_HZ,
    STIFFNESS_N_M2,
    Exact,
    Truth,
    characteristic,
    exact,
)

from analysis.identify import Measurement, fit_record
from analysis.models import STRUCTURES
from rigd.beam import Beam, Damping, modes, transfer

LINK = Beam(LENGTH_M, DENSITY_KG_PER_M, STIFFNESS_N_M2)
PAPER = {"zeta": 7.1e-5, "alpha": 0.996, "gamma": 5.5e-2, "lambda_": 0.594}
UNDECLARED = {
    "density_over_stiffness": 1.01 * LINK.density_over_stiffness,
    "bending_stiffness_n_m2": 1.02 * STIFFNESS_N_M2,
    "delay_s": 3e-4,
    "tool_inertia_kg_m2": 1e-5,
}


def test_the_roots_of_the_clamped_free_beam():
    # R. D. Blevins, Formulas for Natural Frequency and Mode Shape (1979), table 8-1.
    found = [characteristic(number) for number in (1, 2, 3, 4)]
    assert found == pytest.approx([1.87510407, 4.69409113, 7.85475744, 10.99554073], abs=1e-8)


@pytest.mark.parametrize("alpha", [0.8, 1.0, 1.005])
def test_closed_form_agrees_with_the_series_that_the_rig_uses(alpha: float):
    truth = Truth(**(PAPER | {"alpha": alpha}))
    s = 0.05 + 2j * np.pi * np.geomspace(1e-3, 2000, 200)
    theirs = transfer(s, LINK, Damping(**(PAPER | {"alpha": alpha})))
    assert np.abs(truth.torque_per_angle(s) / theirs - 1).max() < 1e-10


def test_poles_are_zeros_of_the_denominator():
    truth = Truth(**PAPER)
    for found in modes(LINK, Damping(**PAPER), 3):
        assert truth.frequency_hz(found.number) == pytest.approx(found.frequency_hz, rel=1e-10)
        assert truth.damping_ratio(found.number) == pytest.approx(found.damping_ratio, rel=1e-8)


def test_stiffer_mode_resonates_higher():
    plain, uneven = Truth(**PAPER), Truth(**PAPER, offsets=(0.006, -0.013))
    ratios = [uneven.frequency_hz(n) / plain.frequency_hz(n) for n in (1, 2, 3, 4)]
    assert ratios == pytest.approx([1.0, 1.006**0.5, 0.987**0.5, 1.0], abs=2e-5)
    # The response is large at the new pole, and not at the old one.
    at, before = (np.array([1j * abs(truth.pole(3))]) for truth in (uneven, plain))
    assert abs(uneven.torque_per_angle(at)[0]) > 1.1 * abs(uneven.torque_per_angle(before)[0])


def test_twice_the_damping_ratio_of_a_mode_is_its_loss_factor():
    truth = Truth(**PAPER)
    for number in (1, 2, 3):
        factor = truth.loss_factor(np.array([truth.frequency_hz(number)]))[0]
        # To the order of the loss itself, which is 2 % at most.
        assert factor == pytest.approx(2 * truth.damping_ratio(number), rel=0.02)


def test_losses_of_either_damping_add_up():
    truth = Truth(**PAPER)
    omega = 16.0
    parts = truth.internal_loss(omega) + truth.external_loss(omega)
    assert parts == pytest.approx(truth.loss_factor(np.array([omega / (2 * np.pi)]))[0], rel=0.02)
    assert truth.external_loss(omega) == pytest.approx(
        5.5e-2 * 16**0.594 * np.sin(0.297 * np.pi) / (LINK.density_over_stiffness * 256)
    )


@pytest.fixture(scope="module")
def still() -> Exact:
    return exact(Truth(**PAPER))


@pytest.mark.fit
@pytest.mark.parametrize("declared", [further(True), False])
def test_an_estimator_finds_the_truth(still: Exact, declared: bool):
    made = still if declared else exact(Truth(**PAPER, **UNDECLARED))
    truth = made.truth
    assert made.angle_rad.size == made.torque_nm.size == made.reference_rad.size == 136_000
    assert not made.reference_rad[:1000].any()
    assert np.abs(made.angle_rad[:1000]).max() < 1e-9
    angle_rad, torque_nm = made.noisy(1e-3, seed=1)
    everywhere = np.ones(angle_rad.size, dtype=bool)
    measured = Measurement(
        "exact", angle_rad, torque_nm, RATE_HZ, LINK, everywhere, everywhere, 0.0
    )
    (fit,) = fit_record(measured, [STRUCTURES["VI"]]).fits
    for name, true in truth.parameters.items():
        std = fit.std[name]
        assert std
        assert abs(fit.parameters[name] - true) < 4.5 * std, name


def test_noise_is_white_and_differs_by_seed(still: Exact):
    (angle_rad, one), (_, other) = still.noisy(1e-2, seed=1), still.noisy(1e-2, seed=2)
    noise = one - still.torque_nm
    assert noise.std() == pytest.approx(1e-2, rel=0.01)
    assert abs(np.corrcoef(noise[1:], noise[:-1])[0, 1]) < 0.01
    assert abs(np.corrcoef(noise, other - still.torque_nm)[0, 1]) < 0.01
    assert np.abs(angle_rad - still.angle_rad).max() <= 3.5e-5 * (1 + 1e-9)


def test_shaken_beam_rings_at_the_start(still: Exact):
    ringing = exact(Truth(**PAPER), ringing=True)
    assert np.abs(still.torque_nm[:900]).max() < 1e-9
    before = np.abs(ringing.torque_nm[:900]).max()
    assert 0.02 < before < 0.5
    # Ringing decays: at the end both are alike.
    assert np.abs(ringing.torque_nm - still.torque_nm)[-15_000:].max() < 1e-3 * before
