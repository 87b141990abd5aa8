"""Torque by drag of the air: against steps in time, its derivatives, and the published case."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from cases import further

from analysis.identify import Comparison, Measurement
from analysis.identify.drag_torque import DragError, DragLaw, DragResponse
from rigd.beam import Beam, Damping, Plant, transfer

pytestmark = pytest.mark.fit

LINK = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.090275)
RATE_HZ = 1000.0
ROD_M = 2e-3
AIR_M2_PER_S = 1.5e-5
WHITE = DragLaw(ROD_M, 10 * ROD_M ** (1 / 3) * AIR_M2_PER_S ** (2 / 3))
"""``C_D = 1 + 10 Re^(-2/3)`` of a rod of 2 mm."""


def swept(duration_s, stop_hz, amplitude_rad=0.025, rest_s=1.0, after_s=3.0):
    """Angle of a motor that follows a sweep through two poles at 80 rad/s."""
    n = round((rest_s + duration_s + after_s) * RATE_HZ)
    t = np.arange(n) / RATE_HZ - rest_s
    phase = 2 * np.pi * (0.05 * t + (stop_hz - 0.05) * t**2 / (2 * duration_s))
    reference_rad = np.where((t >= 0) & (t < duration_s), amplitude_rad * np.sin(phase), 0.0)
    decay = np.exp(-6 * np.arange(n) / n)
    s = 6 * RATE_HZ / n + 2j * np.pi * np.fft.rfftfreq(2 * n, 1 / RATE_HZ)
    return (
        np.fft.irfft(np.fft.rfft(reference_rad * decay, 2 * n) / (1 + s / 80) ** 2, 2 * n)[:n]
        / decay
    )


def compared(angle_rad):
    known = np.ones(angle_rad.size, dtype=bool)
    zero = np.zeros(angle_rad.size)
    return Comparison.from_measurement(
        Measurement("m", angle_rad, zero, RATE_HZ, LINK, known, known, 0.0), (0.0, 50.0)
    )


def response(comparison, plant):
    return DragResponse(comparison.angle_rad, comparison.decimation.rate_hz, plant)


def deviation(one, other):
    return np.linalg.norm(one - other) / np.linalg.norm(other)


@pytest.mark.parametrize("law", [further(DragLaw(2.3e-3)), WHITE])
def test_torque_agrees_with_time_stepping(brake, law):
    angle_rad = swept(8.0, 20.0)
    damping = Damping(zeta=5.4e-5, alpha=1.0, gamma=0.02, lambda_=1.0)
    comparison = compared(angle_rad)
    found = (
        response(comparison, Plant(LINK, damping))
        .torque(law)
        .torque_nm[comparison.retained_samples]
    )
    stepped = brake.drag_torque(
        angle_rad, RATE_HZ, LINK, damping, law.constant_m, law.decreasing_coefficient
    )
    truth = comparison.decimation.apply(stepped)[comparison.retained_samples]
    assert np.abs(truth).max() > 0.02
    spectra = comparison.spectrum(found), comparison.spectrum(truth)
    assert deviation(*spectra) < 2e-3


@pytest.mark.further  # another law and record than above
def test_a_rod_in_air_halves_the_peaks_of_the_papers_chirp():
    """The rod of this stiffness and density, without other external damping."""
    comparison = compared(swept(120.0, 50.0, after_s=15.0))
    plant = Plant(LINK, Damping(zeta=5.4e-5, alpha=1.0, gamma=0.0, lambda_=1.0))
    linear = comparison.torque_predictor.torque(plant)[0]
    braked = (
        linear + response(comparison, plant).torque(WHITE).torque_nm[comparison.retained_samples]
    )
    assert np.abs(linear).max() == pytest.approx(0.331, rel=0.03)
    assert np.abs(braked).max() == pytest.approx(0.161, rel=0.03)


@pytest.fixture(scope="module")
def short():
    return compared(swept(8.0, 20.0))


def plant(zeta=5.4e-5, gamma=0.02, density=4.7e-3, delay_s=0.0, lambda_=1.0):
    damping = Damping(zeta=zeta, alpha=1.0, gamma=gamma, lambda_=lambda_)
    beam = Beam(LINK.length_m, density, LINK.bending_stiffness_n_m2)
    return Plant(beam, damping, delay_s)


LAW = DragLaw(2e-3, 5e-4)


@pytest.mark.parametrize("index", [0, 1])
def test_derivatives_by_the_law(short, index):
    numbers = np.array([LAW.constant_m, LAW.decreasing_coefficient])
    step = 1e-3 * numbers * np.eye(2)[index]
    beam = response(short, plant())
    above, below = (beam.torque(DragLaw(*(numbers + sign * step))).torque_nm for sign in (1, -1))
    exact = beam.torque(LAW).law_derivatives[index]
    assert deviation((above - below) / (2 * step[index]), exact) < 1e-4


@pytest.mark.parametrize(
    ("name", "value", "step", "tolerance"),
    [
        ("zeta", 5.4e-5, 2e-6, 5e-3),
        further("gamma", 0.02, 1e-3, 5e-3),
        ("density", 4.7e-3, 4.7e-8, 1e-3),
        further("delay_s", 0.0, 1e-5, 1e-4),
    ],
)
def test_derivatives_by_the_beam_go_through_its_poles(short, name, value, step, tolerance):
    plants = [plant(**{name: value + sign * step}) for sign in (1, -1)]
    above, below = (response(short, p).torque(LAW).torque_nm for p in plants)
    here = response(short, plant()).torque(LAW, (1, 2, 3))
    poles = [p.mode_poles(3, ()) for p in plants]
    foreseen = np.zeros(above.size)
    for one, other in zip(*poles, strict=True):
        distance_rad_s = one.at_rad_s - other.at_rad_s
        foreseen += (
            np.array([distance_rad_s.real, distance_rad_s.imag]) @ here.pole_derivatives[one.mode]
        )
    if name == "gamma":
        foreseen += 2 * step * here.external_damping_derivatives[:, 1].sum(axis=0)
    if name == "density":
        foreseen += 2 * step / value * here.ln_density_derivative
    if name == "delay_s":
        foreseen += 2 * step * here.delay_derivative
    assert deviation(foreseen, above - below) < tolerance


def test_a_small_drag_is_the_first_order(short):
    beam = response(short, plant())
    assert deviation(beam.torque(DragLaw(1e-7)).torque_nm / 1e-7, beam.first_order_torque()) < 1e-3


@pytest.mark.parametrize(
    ("here", "there"),
    [
        (plant(), plant(gamma=0.0205, density=4.70015e-3, delay_s=5e-6)),
        (plant(gamma=5e-4), plant(gamma=2.8e-3, lambda_=0.5)),  # as much of another order
        (plant(gamma=5e-4), plant(gamma=0.0)),
    ],
)
def test_removed_torque_returns_with_another_beam(short, here, there):
    """A fit's residual with another beam than that of the drag, against recomputed drag."""
    torque_nm = short.torque_predictor.torque(there)[0]
    torque_nm = torque_nm + response(short, there).torque(LAW).torque_nm[short.retained_samples]
    with_drag = short.remove_drag_torque(here, LAW)
    assert with_drag.drag is not None
    names = ("gamma",)
    poles = there.mode_poles(3, names)
    change, _ = with_drag.drag.torque_change_to(there, poles, names, np.eye(1))
    linear = with_drag.spectrum(short.torque_predictor.torque(there)[0])
    taken = with_drag.spectrum((short.torque_nm - with_drag.torque_nm)[short.retained_samples])
    truth = short.spectrum(torque_nm)
    moved = np.linalg.norm(truth - taken - short.spectrum(short.torque_predictor.torque(here)[0]))
    assert np.linalg.norm(linear + taken + change - truth) < 0.05 * moved


def test_filter_applies_to_drag_torque():
    comparison = compared(swept(6.0, 20.0))
    plant = Plant(LINK, Damping(zeta=7.1e-5, alpha=1.0, gamma=5.5e-2, lambda_=1.0))
    law, constant_s = DragLaw(2.3e-3), 3e-3
    unfiltered, filtered = (
        comparison.spectrum(
            response(comparison, each).torque(law).torque_nm[comparison.retained_samples]
        )
        for each in (plant, replace(plant, filter_time_constant_s=constant_s))
    )
    divisor = 1 + 2j * np.pi * comparison.frequency_hz * constant_s
    assert deviation(filtered, unfiltered / divisor) < 2e-2


def test_drag_that_does_not_converge_is_abandoned():
    """Without a warning: they are errors here."""
    comparison = compared(swept(6.0, 20.0))
    light = replace(LINK, density_kg_per_m=1e-7, bending_stiffness_n_m2=1e-6)
    with pytest.raises(DragError):
        response(comparison, Plant(light, Damping(zeta=7.1e-5))).torque(DragLaw(2.3e-3))


def measured_modes(plant):
    """Poles of three modes, and their residues by an integral around each pole."""
    poles = {pole.mode: pole.at_rad_s for pole in plant.mode_poles(3, ())}
    circle = np.exp(2j * np.pi * np.arange(16) / 16)

    def residue(mode):
        distance = 0.1 * poles[mode].imag * circle
        return np.mean(transfer(poles[mode] + distance, plant.beam, plant.damping) * distance)

    return SimpleNamespace(poles_rad_s=poles, residue=residue)


def test_the_torque_has_the_measured_phase_of_each_mode(short):
    """Where the assumed beam is not externally damped, and its torque is late."""
    true_plant, assumed = plant(gamma=0.1), plant(zeta=1e-9, gamma=0.0, delay_s=2e-4)
    true_modes = measured_modes(true_plant)
    near_mode_1 = np.abs(short.frequency_hz / 2.55 - 1) < 0.1

    def drag_spectrum(*plant_and_modes):
        drag = DragResponse(short.angle_rad, short.decimation.rate_hz, *plant_and_modes)
        return short.spectrum(drag.first_order_torque()[short.retained_samples])[near_mode_1]

    def lag_rad(residue):
        modes = SimpleNamespace(poles_rad_s=true_modes.poles_rad_s, residue=residue)
        return np.angle(np.vdot(drag_spectrum(assumed, modes), drag_spectrum(true_plant)))

    assert abs(lag_rad(true_modes.residue)) < 0.01
    without_external_damping = 1j * true_modes.poles_rad_s[1] ** 4
    assert lag_rad(lambda _: without_external_damping) == pytest.approx(-0.24, abs=0.02)


def test_modes_that_drag_does_not_move_are_left_out(short):
    soft_beam = replace(LINK, bending_stiffness_n_m2=0.004)
    soft = Plant(soft_beam, Damping(zeta=7e-5, alpha=1.0))
    poles = {pole.mode: pole.at_rad_s for pole in soft.mode_poles(7, ())}
    modes = SimpleNamespace(poles_rad_s=poles, residue=lambda mode: 1j * poles[mode] ** 4)
    drag = DragResponse(short.angle_rad, short.decimation.rate_hz, soft, modes)
    torque = drag.torque(DragLaw(1e-3), range(1, 8))
    assert list(torque.pole_derivatives) == [1, 2, 3, 4, 5]
    assert np.isfinite(torque.torque_nm).all()
