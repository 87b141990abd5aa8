"""Tip mass and elastic clamp: the textbook's closed form, its poles, and their realisation."""

import numpy as np
import pytest

from rigd.beam import Beam, Damping, LoadedBeam, clamped_free_eigenvalues, poles, realise, transfer

BEAM = Beam(0.98, 4.7e-3, 0.090275)
DAMPINGS = {
    "fractional": Damping(7.1e-5, 0.92, 5.5e-2, 0.594),
    "integer": Damping(7.1e-5, 1.0, 1.2e-2, 1.0),
}
ENDS = [(0.0, 0.0), (5e-5, 0.0), (0.0, 0.01), (5e-4, 0.05)]


def textbook(s, damping, tip_mass_kg, compliance):
    """Solve ``EI c y'''' = -p y`` with y(0) = 0, y'(0) = 1, y''(L) = 0, EI c y'''(L) = m s² y."""
    c = 1 + damping.zeta * s**damping.alpha
    p = BEAM.density_over_stiffness * s**2 + damping.gamma * s**damping.lambda_
    found = []
    for place in range(s.size):
        stiffness = BEAM.bending_stiffness_n_m2 * c[place]
        roots = (-p[place] / c[place] + 0j) ** 0.25 * np.array([1, 1j, -1, -1j])
        waves = np.exp(roots * BEAM.length_m)
        matrix = np.array(
            [
                np.ones(4),
                roots,
                roots**2 * waves,
                (stiffness * roots**3 - tip_mass_kg * s[place] ** 2) * waves,
            ]
        )
        amplitudes = np.linalg.solve(matrix, np.array([0, 1, 0, 0]))
        found.append(-stiffness * (amplitudes @ roots**2))
    rigid = np.array(found)
    return rigid / (1 + compliance * rigid)


@pytest.mark.parametrize(("mass", "compliance"), ENDS)
@pytest.mark.parametrize("name", DAMPINGS)
def test_the_closed_form_solves_the_boundary_value_problem(name, mass, compliance):
    s = 0.5 + 2j * np.pi * np.geomspace(0.5, 80, 60)
    loaded = LoadedBeam(BEAM, DAMPINGS[name], mass, compliance)
    assert loaded.transfer(s) == pytest.approx(
        textbook(s, DAMPINGS[name], mass, compliance), rel=1e-7
    )


def test_without_either_it_is_the_bare_beam():
    s = 2j * np.pi * np.geomspace(0.01, 400, 300)
    bare = LoadedBeam(BEAM, DAMPINGS["fractional"])
    assert bare.transfer(s) == pytest.approx(transfer(s, BEAM, DAMPINGS["fractional"]), rel=1e-9)
    z = clamped_free_eigenvalues(5)
    assert (bare.poles(z) == poles(BEAM, DAMPINGS["fractional"], 5)).all()


@pytest.mark.parametrize(("mass", "compliance"), ENDS[1:])
@pytest.mark.parametrize("name", DAMPINGS)
def test_the_response_is_infinite_at_the_poles_and_nought_at_the_zeros(name, mass, compliance):
    loaded = LoadedBeam(BEAM, DAMPINGS[name], mass, compliance)
    at_poles = loaded.poles(clamped_free_eigenvalues(4))[:, 0]
    beside = loaded.transfer(at_poles * (1 + 1e-4))
    assert (np.abs(loaded.transfer(at_poles * (1 + 1e-9))) > 1e4 * np.abs(beside)).all()
    at_zeros = loaded.zeros(np.pi * np.arange(1.25, 4))[:, 0]
    beside = loaded.transfer(at_zeros * (1 + 1e-4))
    assert (np.abs(loaded.transfer(at_zeros * (1 + 1e-9))) < 1e-4 * np.abs(beside)).all()


@pytest.mark.parametrize(("mass", "compliance"), ENDS[1:])
def test_the_realisation_is_that_of_the_beam_with_its_ends(mass, compliance):
    made = realise(
        BEAM, DAMPINGS["fractional"], tip_mass_kg=mass, root_compliance_rad_per_nm=compliance
    )
    s = 2j * np.pi * np.geomspace(0.1, 90, 200)
    of_states = [made.c @ np.linalg.solve(x * np.eye(made.b.size) - made.a, made.b) for x in s]
    response = s**2 * (np.array(of_states) + made.direct_inertia_kg_m2)
    response += made.direct_viscosity_nm_s_per_rad * s + made.direct_stiffness_nm_per_rad
    exact = textbook(s, DAMPINGS["fractional"], mass, compliance)
    assert response == pytest.approx(exact, rel=1e-3)
