"""The finite elements of the random defects against closed forms and published values."""

import numpy as np
import pytest
from finite_element_beam import FiniteElementBeam, PointMass, uniform_response
from independent_records import DENSITY_KG_PER_M, LENGTH_M, STIFFNESS_N_M2, Truth
from numpy.typing import NDArray

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

PAPER = {"zeta": 7.1e-5, "alpha": 0.996, "gamma": 5.5e-2, "lambda_": 0.594}
MASS_KG = DENSITY_KG_PER_M * LENGTH_M
UNIT_RAD_S = np.sqrt(STIFFNESS_N_M2 / DENSITY_KG_PER_M) / LENGTH_M**2
"""Unit of the dimensionless frequencies of the literature."""


def constant(value: float):
    return lambda x: np.full_like(x, value)


def elastic(s: Complex) -> Complex:
    return 1 + PAPER["zeta"] * s ** PAPER["alpha"]


def medium(s: Complex) -> Complex:
    return PAPER["gamma"] * STIFFNESS_N_M2 * s ** PAPER["lambda_"]


def nothing(s: Complex) -> Complex:
    return np.zeros_like(s)


def link(**changed: object) -> FiniteElementBeam:
    properties: dict[str, object] = {
        "length_m": LENGTH_M,
        "density_kg_per_m": constant(DENSITY_KG_PER_M),
        "stiffness_n_m2": constant(STIFFNESS_N_M2),
        "elastic": elastic,
        "medium_n_s_per_m2": medium,
    }
    return FiniteElementBeam(**(properties | changed))  # type: ignore[arg-type]


def undamped(**changed: object) -> Real:
    """Frequencies over `UNIT_RAD_S`."""
    beam = link(elastic=np.ones_like, medium_n_s_per_m2=nothing, **changed)
    return beam.undamped()[0] / UNIT_RAD_S


def test_a_uniform_beam_responds_by_its_closed_form():
    s = 2j * np.pi * np.geomspace(0.05, 60, 300)
    expected = Truth(**PAPER).torque_per_angle(s)
    assert np.abs(link().response(s) / expected - 1).max() < 5e-5
    written_out = uniform_response(s, LENGTH_M, DENSITY_KG_PER_M, STIFFNESS_N_M2, elastic, medium)
    assert np.abs(written_out / expected - 1).max() < 1e-12


def test_poles_and_residues_of_a_uniform_beam():
    truth = Truth(**PAPER)
    for mode in link().modes(2 * np.pi * 150)[:4]:
        pole = truth.pole(mode.number)
        assert abs(mode.pole_rad_s / pole - 1) < 1e-6
        assert mode.damping_ratio == pytest.approx(truth.damping_ratio(mode.number), rel=1e-5)
        step = 1e-5 * abs(pole) * np.array([1, 1j, -1, -1j])
        residue = np.mean(truth.torque_per_angle(pole + step) * step)
        assert abs(mode.residue / residue - 1) < 1e-5


def test_relaxations_have_poles_where_the_closed_form_is_infinite():
    def relaxing(s: Complex) -> Complex:
        return 1 + 0.02 * s * 0.01 / (1 + s * 0.01) + 0.01 * s * 0.1 / (1 + s * 0.1)

    for mode in link(elastic=relaxing).modes(2 * np.pi * 60):
        off = abs(mode.pole_rad_s) * np.array([0.0, 1e-3])
        near, far = np.abs(
            uniform_response(
                mode.pole_rad_s + off, LENGTH_M, DENSITY_KG_PER_M, STIFFNESS_N_M2, relaxing, medium
            )
        )
        assert near > 1e3 * far


def test_the_response_from_poles_is_that_of_the_elements():
    edges = np.array([0.3, 0.7])

    def uneven(x: Real) -> Real:
        return DENSITY_KG_PER_M * np.array([1.0, 1.05, 0.97])[np.searchsorted(edges, x)]

    beam = link(density_kg_per_m=uneven, jumps_m=tuple(edges), gravity_m_s2=0.5)
    s = 0.1 + 2j * np.pi * np.linspace(0, 500, 50_001)
    indices = np.random.default_rng(1).integers(0, 10_000, 100)
    fast = beam.fast_response(s, beam.modes())[indices]
    assert np.abs(fast / beam.response(s[indices]) - 1).max() < 1e-6


@pytest.mark.parametrize("ratio", [0.01, 0.2, 1.0])
def test_tip_mass_lowers_frequencies_by_the_frequency_equation(ratio: float):
    masses = (PointMass(LENGTH_M, ratio * MASS_KG),)
    for omega in undamped(masses=masses)[:4]:
        z = np.sqrt(omega)
        plain = 1 + np.cos(z) * np.cosh(z)
        slope = np.sinh(z) * np.cos(z) - np.cosh(z) * np.sin(z)
        # Relative to how fast the equation changes with z.
        assert abs(plain + ratio * z * slope) < 1e-5 * z * np.cosh(z) * (1 + ratio * z)
    if ratio == 1.0:
        assert undamped(masses=masses)[0] == pytest.approx(1.5573, abs=2e-4)


def test_a_mass_anywhere_adds_its_moment_to_the_inertia():
    s = np.array([2j * np.pi * 1e-3])
    without, with_mass = (
        link(medium_n_s_per_m2=nothing, masses=masses).response(s)[0].real
        for masses in ((), (PointMass(0.371, 2e-4),))
    )
    assert (with_mass - without) / (s[0] ** 2).real == pytest.approx(2e-4 * 0.371**2, rel=1e-4)


@pytest.mark.parametrize(
    ("inertia_power", "stiffness_power", "expected"),
    [
        # Kirchhoff's wedge and cone, S. Naguleswaran, J. Sound and Vibration 172 (1994) 289-304.
        (1, 3, [5.3151, 15.2072, 30.0198]),
        (2, 4, [8.7193, 21.1457, 38.4538]),
    ],
)
def test_beams_that_taper_to_a_point(
    inertia_power: int, stiffness_power: int, expected: list[float]
):
    found = undamped(
        density_kg_per_m=lambda x: DENSITY_KG_PER_M * (1 - x / LENGTH_M) ** inertia_power,
        stiffness_n_m2=lambda x: STIFFNESS_N_M2 * (1 - x / LENGTH_M) ** stiffness_power,
    )
    assert found[:3] == pytest.approx(expected, rel=2e-4)


def test_column_buckles_at_greenhills_length():
    # S. P. Timoshenko, J. M. Gere, Theory of Elastic Stability, section 2.12: 7.837 EI/L³.
    critical = 7.8373 * STIFFNESS_N_M2 / (DENSITY_KG_PER_M * LENGTH_M**3)
    standing = undamped(gravity_m_s2=-critical)[0]
    nearly = undamped(gravity_m_s2=-0.99 * critical)[0]
    assert standing**2 < 1e-4 * 3.516**2
    assert nearly**2 == pytest.approx(0.01 * 3.516**2, rel=0.05)


def test_a_hanging_beam_is_a_pendulum_at_low_frequency():
    gravity = 0.3
    beam = link(medium_n_s_per_m2=nothing, gravity_m_s2=gravity, masses=(PointMass(0.6, 1e-3),))
    assert beam.mass_moment_kg_m == pytest.approx(MASS_KG * LENGTH_M / 2 + 6e-4)
    at_rest = beam.response(np.array([1e-6j]))[0].real
    # The sag makes it softer than a rigid pendulum, by about weight over stiffness.
    assert at_rest == pytest.approx(gravity * beam.mass_moment_kg_m, rel=0.01)
    stiff = link(
        medium_n_s_per_m2=nothing,
        gravity_m_s2=gravity,
        masses=(PointMass(0.6, 1e-3),),
        stiffness_n_m2=constant(1e4 * STIFFNESS_N_M2),
        elements=20,
    )
    assert stiff.response(np.array([1e-6j]))[0].real == pytest.approx(
        gravity * stiff.mass_moment_kg_m, rel=1e-5
    )


def test_a_spring_at_the_root_is_in_series():
    s = 2j * np.pi * np.geomspace(0.5, 60, 50)
    spring = 30.0 * (1 + 0.05j)
    expected = 1 / (1 / link().response(s) + 1 / spring)
    found = link(root_nm_per_rad=lambda s: np.full_like(s, spring)).response(s)
    assert np.abs(found / expected - 1).max() < 1e-6
