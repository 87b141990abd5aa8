"""Causes of modes of a nonuniform beam: reported with their sizes, from independent constants.

The constants are those of finite elements, which are independent of the analyzer's shapes.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from cauchy_residues import modal_constants

from analysis.identify import ModalEstimate, ModalModel
from analysis.identify._altered_beam import BeamDeviations, galerkin_mode_terms
from analysis.identify._explanations import explanations, finding
from analysis.identify._step_in_time import StiffnessStep
from analysis.identify.beam_uniformity import uniform_beam_test
from analysis.identify.tolerant_estimate import tolerant_estimate
from analysis.identify.uniform_beam import UniformBeamProblem
from rigd.beam import Beam, Damping, Plant

LINK = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.090275)
LAW = Damping(zeta=7.1e-5, alpha=0.996, gamma=5.5e-2, lambda_=0.594)
NOMINAL = Plant(beam=LINK, damping=Damping())
MODES = (1, 2, 3)
STD = np.array([1e-5, 1.5e-3, 1e-3, 1e-3] * 3)
ELEMENTS = 32


@dataclass
class Elements:
    """Beam of Hermite elements on a locked hub, with deviations from a uniform one."""

    density: tuple = (1.0, 1.0)  # factors of the inner and the outer half
    stiffness: tuple = (1.0, 1.0)
    masses: tuple = ()  # (number of the node, kg)
    gravity_m_s2: float = 0.0
    root_nm_per_rad: complex = math.inf
    relaxation: tuple = (0.0, 1.0)

    def matrices(self):
        size, h = 2 * ELEMENTS + 2, LINK.length_m / ELEMENTS
        mass, medium, bending, tension = np.zeros((4, size, size))
        points, weights = np.polynomial.legendre.leggauss(4)
        outboard = sum(kg for _, kg in self.masses)
        for element in range(ELEMENTS - 1, -1, -1):
            half = int(element >= ELEMENTS // 2)
            density = LINK.density_kg_per_m * self.density[half]
            stiffness = LINK.bending_stiffness_n_m2 * self.stiffness[half]
            outboard -= sum(kg for node, kg in self.masses if node == element)
            carried = sum(kg for node, kg in self.masses if node > element)
            at = slice(2 * element, 2 * element + 4)
            for x, weight in zip((points + 1) / 2, weights * h / 2, strict=True):
                shape = np.array([
                    1 - 3 * x**2 + 2 * x**3, h * (x - 2 * x**2 + x**3),
                    3 * x**2 - 2 * x**3, h * (x**3 - x**2),
                ])  # fmt: skip
                slope = np.array([
                    (6 * x**2 - 6 * x) / h, 1 - 4 * x + 3 * x**2,
                    (6 * x - 6 * x**2) / h, 3 * x**2 - 2 * x,
                ])  # fmt: skip
                curve = np.array([
                    (12 * x - 6) / h**2, (6 * x - 4) / h, (6 - 12 * x) / h**2, (6 * x - 2) / h
                ])  # fmt: skip
                beyond_m = LINK.length_m - (element + x) * h
                pulled = carried + LINK.density_kg_per_m * beyond_m
                mass[at, at] += weight * density * np.outer(shape, shape)
                medium[at, at] += weight * np.outer(shape, shape)
                bending[at, at] += weight * stiffness * np.outer(curve, curve)
                tension[at, at] += weight * self.gravity_m_s2 * pulled * np.outer(slope, slope)
        for node, kg in self.masses:
            mass[2 * node, 2 * node] += kg
        return mass, medium, bending, tension

    def constants(self):
        """Logarithms of frequency, damping ratio and residue, and phase of each mode in turn."""
        mass, medium, bending, tension = self.matrices()
        rigid = np.zeros(len(mass))
        rigid[0::2] = np.linspace(0, LINK.length_m, ELEMENTS + 1)
        rigid[1::2] = 1.0
        free = slice(2, None) if self.root_nm_per_rad == math.inf else slice(1, None)
        root = np.zeros(len(mass))
        root[1] = 0.0 if self.root_nm_per_rad == math.inf else 1.0
        gamma = LAW.gamma * LINK.bending_stiffness_n_m2
        strength, time_s = self.relaxation

        def stiffness(s):  # dynamic, of all that the hub's turn does not bend too
            elastic = 1 + LAW.zeta * s**LAW.alpha + strength * s * time_s / (1 + s * time_s)
            moved = mass * s**2 + gamma * medium * s**LAW.lambda_ + tension
            spring = np.diag(root * (self.root_nm_per_rad if root.any() else 0.0))
            return (moved + elastic * bending + spring)[free, free], (moved @ rigid)[free]

        found = []
        undamped = bending + tension
        if root.any():
            undamped = undamped + np.diag(root * np.real(self.root_nm_per_rad))
        lower = np.linalg.inv(np.linalg.cholesky(mass[free, free]))
        squares, vectors = np.linalg.eigh(lower @ undamped[free, free] @ lower.T)
        for number in range(len(MODES)):
            s, shape = 1j * math.sqrt(squares[number]), lower.T @ vectors[:, number] + 0j
            for _ in range(8):
                step = 1e-4 * abs(s)
                (here, _), (above, _), (below, _) = map(stiffness, (s, s + step, s - step))
                slope = (above - below) / (2 * step)
                shape = np.linalg.solve(here, slope @ shape)
                shape /= np.abs(shape).max()
                s -= (shape @ here @ shape) / (shape @ slope @ shape)
            driven = stiffness(s)[1] @ shape
            residue = np.log(-(driven**2) / (shape @ slope @ shape) / 1j)
            decay = -s.real / abs(s)
            found += [math.log(s.imag / (2 * math.pi)), math.log(decay), residue.real, residue.imag]
        return np.array(found)


def fitted(constants, seed=1):
    """An estimate of these constants, with noise of `STD`."""
    off = np.random.default_rng(seed).normal(scale=STD)
    return ModalEstimate(ModalModel((), (), ()), MODES, constants + off, np.diag(STD**2))


def poles(constants):
    rows = constants.reshape(-1, 4)
    omega, ratio = 2 * np.pi * np.exp(rows[:, 0]), np.exp(rows[:, 1])
    return omega * (1j - ratio / np.sqrt(1 - ratio**2))


def through(constants, channel):
    """Constants behind an instrument with a response."""
    passed = np.log(channel(poles(constants)))
    shifted = constants.reshape(-1, 4).copy()
    shifted[:, 2] += passed.real
    shifted[:, 3] += passed.imag
    return shifted.ravel()


def second_order(hz, quality):
    def channel(s):
        q = s / (2 * np.pi * hz)
        return 1 / (1 + q / quality + q**2)

    return channel


@pytest.fixture(scope="module")
def plain():
    return Elements().constants()


def test_finite_elements_of_the_uniform_beam_are_its_exact_modes(plain):
    exact = modal_constants(replace(NOMINAL, damping=LAW), MODES)
    assert plain == pytest.approx(exact, abs=5e-5)
    assert uniform_beam_test(fitted(plain), NOMINAL).status == "passed"


def assert_stated(cause):
    """With a unit, and with a size in words."""
    assert cause.unit
    assert any(character.isdigit() for character in cause.phrase)


FURTHER = pytest.mark.further
TILT = 9.81 * math.sin(math.radians(2))


@pytest.mark.parametrize(
    ("name", "beam", "size", "within"),
    [
        pytest.param("tilt", Elements(gravity_m_s2=TILT), 2.0, 0.1, id="tilt", marks=FURTHER),
        pytest.param(
            "tilt", Elements(gravity_m_s2=-TILT), -2.0, 0.1, id="tip higher", marks=FURTHER
        ),
        pytest.param(
            "tip mass",
            Elements(masses=((ELEMENTS, 1e-4),)),
            1e-4,
            0.03,
            id="tip mass",
            marks=FURTHER,
        ),
        pytest.param(
            "tip mass",
            Elements(masses=((ELEMENTS, 6e-4),)),
            6e-4,
            0.03,
            id="heavy tip",
            marks=FURTHER,
        ),
        pytest.param("lump", Elements(masses=((19, 2e-4),)), 2e-4, 0.05, id="lump", marks=FURTHER),
        pytest.param(
            "uneven mass", Elements(density=(1, 1.03)), 0.03, 0.05, id="mass", marks=FURTHER
        ),
        pytest.param(
            "uneven stiffness",
            Elements(stiffness=(1, 0.96)),
            -0.04,
            0.05,
            id="bending",
            marks=FURTHER,
        ),
        pytest.param(
            "elastic clamp", Elements(root_nm_per_rad=50.0), 50.0, 0.05, id="clamp", marks=FURTHER
        ),
        pytest.param(
            "lossy clamp", Elements(root_nm_per_rad=30 + 3j), 30.0, 0.1, id="lossy", marks=FURTHER
        ),
        pytest.param("relaxation", Elements(relaxation=(0.03, 0.01)), 0.03, 0.1, id="relaxation"),
    ],
)
def test_cause_is_reported_with_its_size(name, beam, size, within):
    fit = fitted(beam.constants())
    assert uniform_beam_test(fit, NOMINAL).status == "refused"
    found = {each.name: each for each in explanations(uniform_beam_test(fit, NOMINAL))}
    assert found[name].size == pytest.approx(size, rel=within)
    assert found[name].p_value > 0.01
    assert_stated(found[name])


@pytest.mark.parametrize(
    ("name", "channel", "hz"),
    [
        pytest.param(
            "torque filter of first order",
            lambda s: 1 / (1 + s / (2 * np.pi * 120)),
            120.0,
            marks=FURTHER,
        ),
        pytest.param(
            "torque filter of second order", second_order(90.0, 2**-0.5), 90.0, marks=FURTHER
        ),
        ("sensor resonance", second_order(200.0, 20.0), 200.0),
    ],
)
def test_instrument_is_reported_with_its_frequency(plain, name, channel, hz):
    fit = fitted(through(plain, channel))
    found = {each.name: each for each in explanations(uniform_beam_test(fit, NOMINAL))}
    assert found[name].size == pytest.approx(hz, rel=0.1)
    assert_stated(found[name])


def test_rig_with_the_cause_predicts_the_modes():
    constants = Elements(root_nm_per_rad=50.0).constants()
    plants = [
        each.plant
        for each in explanations(uniform_beam_test(fitted(constants), NOMINAL))
        if each.plant
    ]
    off = [(modal_constants(plant, MODES) - constants) / STD for plant in plants]
    assert min(np.abs(each).max() for each in off) < 4


def test_weighed_tip_mass_belongs_to_the_plain_beam():
    fit = fitted(Elements(masses=((ELEMENTS, 3e-4),)).constants())
    assert uniform_beam_test(fit, NOMINAL).status == "refused"
    assert uniform_beam_test(fit, replace(NOMINAL, tip_mass_kg=3e-4)).status == "passed"
    assert uniform_beam_test(fit, replace(NOMINAL, tip_mass_kg=1e-4)).status == "refused"


def test_measured_tilt_belongs_to_the_plain_beam():
    fit = fitted(Elements(gravity_m_s2=TILT, masses=((ELEMENTS, 1e-4),)).constants())
    weighed = replace(NOMINAL, tip_mass_kg=1e-4)
    assert uniform_beam_test(fit, weighed).status == "refused"
    assert uniform_beam_test(fit, weighed, 2.0).status == "passed"
    assert uniform_beam_test(fit, weighed, -2.0).status == "refused"


@pytest.mark.further
def test_tilt_is_found_with_a_weighed_mass():
    fit = fitted(Elements(gravity_m_s2=TILT, masses=((ELEMENTS, 1e-4),)).constants())
    weighed = replace(NOMINAL, tip_mass_kg=1e-4)
    (tilt,) = (
        each for each in explanations(uniform_beam_test(fit, weighed)) if each.name == "tilt"
    )
    assert tilt.size == pytest.approx(2.0, rel=0.1)


def test_unlisted_causes_are_not_reported(plain):
    moved = plain.copy()
    moved[4] += 0.1  # mode 2 alone, by a tenth
    fit = fitted(moved)
    assert explanations(uniform_beam_test(fit, NOMINAL)) == ()
    report = finding(uniform_beam_test(fit, NOMINAL), ())
    assert "No single one of the simple causes" in report.sentence
    assert (report.kind, report.value, report.interval) == ("rival explanations", None, None)


def test_causes_are_reported_and_never_facts():
    fit = fitted(Elements(gravity_m_s2=TILT).constants())
    test = uniform_beam_test(fit, NOMINAL)
    found = explanations(test)
    assert 2 <= len(found) <= 5
    assert {each.name: each.size for each in found}["tilt"] == pytest.approx(2.0, rel=0.1)
    assert [each.p_value for each in found] == sorted((e.p_value for e in found), reverse=True)
    report = finding(test, found, StiffnessStep(25.0, 70.2, -0.0021))
    assert (report.kind, report.value, report.interval) == ("rival explanations", None, None)
    assert "an axis 2° off plumb (the tip at rest lower than the axis)" in report.sentence
    assert "a step of the stiffness by about -0.2 % near 70 s" in report.sentence
    assert "None is established by this record" in report.sentence
    assert "step of" not in finding(test, found, StiffnessStep(13.0, 70.2, -0.0021)).sentence
    alone = finding(test, found[:1]).sentence
    assert "It is not established by this record" in alone


def test_two_modes_cannot_distinguish_causes():
    fit = fitted(Elements(gravity_m_s2=TILT).constants())
    two = replace(fit, mode_numbers=(1, 2, 0))  # the third is of something else
    assert explanations(uniform_beam_test(two, NOMINAL)) == ()


def test_losses_of_nonuniform_beam_have_a_tolerance():
    uneven = fitted(Elements(density=(1.0, 1.004)).constants())
    assert uniform_beam_test(uneven, NOMINAL).status == "refused"
    omega_rad_s = 2 * np.pi * 40.0
    by_zeta_and_alpha = np.array([1.0, math.log(omega_rad_s)])  # of the logarithm of the loss

    def loss_and_std(*, is_uniform):
        found = tolerant_estimate(uneven, NOMINAL, 1e-3, is_uniform=is_uniform)
        variance = by_zeta_and_alpha @ found.covariance[:2, :2] @ by_zeta_and_alpha
        return found.plant.damping.internal_loss_factor(omega_rad_s), math.sqrt(variance)

    loss, std = loss_and_std(is_uniform=False)
    true = (LAW.zeta * (1j * omega_rad_s) ** LAW.alpha).imag
    assert loss == pytest.approx(true, rel=3 * std)
    # Three thousandths of each damping ratio, besides 1.5 thousandths of noise.
    assert std > 1.05 * loss_and_std(is_uniform=True)[1]


@pytest.mark.parametrize(
    "altered",
    [
        {},
        {"point_masses": ((1.0, 2e-4),), "gravity_m_s2": 0.3},
        {"clamp_compliance": 0.01, "clamp_loss": 0.1, "first_order_torque_lag_s": 1e-4},
        {"relaxation_strength_and_time": (0.02, 0.01), "second_order_torque_lag": (3e-4, 0.5)},
    ],
)
def test_derivatives_of_modal_constants_match_differences(plain, altered):
    fit, rig = fitted(plain), replace(NOMINAL, filter_time_constant_s=2e-4, delay_s=1e-3)
    problem = UniformBeamProblem(fit, fit.visible_mode_numbers, rig)
    terms = galerkin_mode_terms(BeamDeviations(**altered), rig.beam, problem.modes)
    x, unit, step = problem.starts()[0], np.eye(problem.constant_count), 1e-5
    slopes = problem.residual_and_slopes(x, unit, terms)[1]()
    differences = [
        problem.residual_and_slopes(x + change, unit, terms)[0]
        - problem.residual_and_slopes(x - change, unit, terms)[0]
        for change in step * np.eye(x.size)
    ]
    np.testing.assert_allclose(slopes, np.array(differences) / (2 * step), rtol=1e-5, atol=1e-8)
