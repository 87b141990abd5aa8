"""Tip mass and elastic clamp: the textbook's closed form, its poles, and their realisation."""

from dataclasses import replace

import numpy as np
import pytest

from rigd.beam import (
    Beam,
    Damping,
    Plant,
    clamped_free_eigenvalues,
    poles,
    root_shear_ratio,
    transfer,
)
from rigd.beam.realisation import realise

BEAM = Beam(0.98, 4.7e-3, 0.090275)
DAMPINGS = {
    "fractional": Damping(7.1e-5, 0.92, 5.5e-2, 0.594),
    "integer": Damping(7.1e-5, 1.0, 1.2e-2, 1.0),
}
ENDS = [(0.0, 0.0), (5e-5, 0.0), (0.0, 0.01), (5e-4, 0.05)]


def ends(mass, compliance):
    return {"tip_mass_kg": mass, "root_compliance_rad_per_nm": compliance}


def textbook(s, damping, tip_mass_kg, compliance):
    """Torque per angle of the beam as `solved` has it."""
    return solved(s, damping, tip_mass_kg, compliance)[0]


def solved(s, damping, tip_mass_kg, compliance):
    """Solve ``EI c y'''' = -p y``, y(0) = 0, y'(0) = 1, y''(L) = 0, EI c y'''(L) = m s² y.

    The torque on the root and the slope of the tip against it, both per motor angle.
    """
    c = 1 + damping.zeta * s**damping.alpha
    p = BEAM.density_over_stiffness * s**2 + damping.gamma * s**damping.lambda_
    found, slopes = [], []
    for index in range(s.size):
        stiffness = BEAM.bending_stiffness_n_m2 * c[index]
        roots = (-p[index] / c[index] + 0j) ** 0.25 * np.array([1, 1j, -1, -1j])
        waves = np.exp(roots * BEAM.length_m)
        matrix = np.array(
            [
                np.ones(4),
                roots,
                roots**2 * waves,
                (stiffness * roots**3 - tip_mass_kg * s[index] ** 2) * waves,
            ]
        )
        amplitudes = np.linalg.solve(matrix, np.array([0, 1, 0, 0]))
        found.append(-stiffness * (amplitudes @ roots**2))
        slopes.append(amplitudes @ (roots * waves) - 1)
    rigid = np.array(found)
    factor = 1 / (1 + compliance * rigid)
    return rigid * factor, np.array(slopes) * factor


@pytest.mark.parametrize(("mass", "compliance"), ENDS)
@pytest.mark.parametrize("name", DAMPINGS)
def test_the_closed_form_solves_the_boundary_value_problem(name, mass, compliance):
    s = 0.5 + 2j * np.pi * np.geomspace(0.5, 80, 60)
    loaded = Plant(BEAM, DAMPINGS[name], **ends(mass, compliance))
    assert loaded.transfer(s) == pytest.approx(
        textbook(s, DAMPINGS[name], mass, compliance), rel=1e-7
    )


OFFSETS = (0.04, -0.07, 0.1)


def offset(compliance):
    """Give a beam whose modes have stiffnesses of their own."""
    return Plant(
        BEAM,
        DAMPINGS["fractional"],
        root_compliance_rad_per_nm=compliance,
        stiffness_offsets=OFFSETS,
    )


@pytest.mark.parametrize("compliance", [0.0, 0.05])
def test_modes_with_own_stiffness_replace_uniform_ones(compliance):
    """By the sum of the modes: each of the first four with its own stiffness."""
    s = 0.5 + 2j * np.pi * np.geomspace(0.5, 100, 60)
    loaded = offset(compliance)
    elastic, inertial = loaded.elastic_and_inertial_factors(s)
    response = transfer(s, BEAM, DAMPINGS["fractional"])
    for z, stiffness_offset in zip(clamped_free_eigenvalues(4)[1:], OFFSETS, strict=True):
        k4, stiffness = (z / BEAM.length_m) ** 4, BEAM.bending_stiffness_n_m2
        for sign, own in ((-1, k4), (1, k4 * (1 + stiffness_offset))):
            # Of a mode a² EI p - a² EI p²/(p + c k⁴): the first part is the rigid link's.
            weight = 4 * BEAM.length_m**3 / z**4 * stiffness
            response = response - sign * weight * inertial**2 / (inertial + elastic * own)
    exact = response / (1 + compliance * response)
    assert loaded.transfer(s) == pytest.approx(exact, rel=1e-9)
    h = 1e-6 * s
    difference = (
        loaded.rigid_clamp_response(s + h).response - loaded.rigid_clamp_response(s - h).response
    ) / (2 * h)
    assert loaded.derivative_by_s(s, loaded.rigid_clamp_response(s)) == pytest.approx(
        difference, rel=1e-6
    )


@pytest.mark.parametrize("compliance", [0.0, 0.05])
def test_poles_of_modes_with_own_stiffness_are_realised(compliance):
    loaded = offset(compliance)
    at_poles = loaded.poles(clamped_free_eigenvalues(6))[:, 0]
    far, near = (np.abs(loaded.transfer(at_poles * (1 + h))) for h in (1e-4, 1e-8))
    assert (near > 1e3 * far).all()
    made = realise(loaded)
    s = 2j * np.pi * np.geomspace(0.1, 90, 200)
    assert made.transfer(s) == pytest.approx(loaded.transfer(s), rel=1e-3)
    # The residues are those of the realisation: half of the contribution of both states of a pair.
    of_states = made.c[: 2 * at_poles.size].reshape(-1, 2)
    assert 2 * np.abs(loaded.residues(at_poles)) == pytest.approx(np.hypot(*of_states.T), rel=1e-4)


def test_quantities_undefined_for_own_stiffness_are_refused():
    with pytest.raises(ValueError, match="The shear of modes"):
        offset(0.0).shear_response(np.array([1j]))
    with pytest.raises(ValueError, match="exclude each other"):
        replace(offset(0.0), tip_mass_kg=1e-4)


def test_tip_of_modes_with_own_stiffness_is_their_sum():
    s = 0.5 + 2j * np.pi * np.geomspace(0.5, 80, 40)
    loaded = offset(0.0)
    elastic, inertial = loaded.elastic_and_inertial_factors(s)
    z = clamped_free_eigenvalues(400)
    stiffness = (z / BEAM.length_m) ** 4 * (1 + np.pad(OFFSETS, (1, z.size - 1 - len(OFFSETS))))
    # A turn of the root is 2 L (-1)^(i-1) / z² of each mode, whose tip moves by 2.
    turn = 2 * BEAM.length_m * (-1.0) ** np.arange(z.size) / z**2
    size = -inertial[:, None] * turn / (elastic[:, None] * stiffness + inertial[:, None])
    displacement, slope = loaded.tip_response(s)
    assert displacement == pytest.approx(2 * size.sum(axis=1), rel=1e-7, abs=1e-9)
    slopes = 2 * z * root_shear_ratio(z.size) / BEAM.length_m
    uniform = Plant(BEAM, DAMPINGS["fractional"])
    same = (
        -inertial[:, None]
        * turn
        / (elastic[:, None] * (z / BEAM.length_m) ** 4 + inertial[:, None])
    )
    expected = uniform.tip_slope(s) + ((size - same) * slopes).sum(axis=1)
    assert slope == pytest.approx(expected, rel=1e-7)


@pytest.mark.parametrize("compliance", [0.0, 0.05])
def test_derivatives_of_modes_with_own_stiffness(compliance):
    loaded = offset(compliance)
    names = ("zeta", "lambda", "ln_density_over_stiffness", "root_compliance_rad_per_nm")
    s = 0.5 + 2j * np.pi * np.geomspace(0.5, 80, 40)
    poles = loaded.poles(clamped_free_eigenvalues(3))[:, 0]
    _, gradient = loaded.transfer_and_gradient(s, names)
    moved = loaded.pole_gradients(poles, names)
    damping = DAMPINGS["fractional"]
    for row, (more, step) in enumerate((
        (replace(loaded, damping=replace(damping, zeta=damping.zeta + 1e-9)), 1e-9),
        (replace(loaded, damping=replace(damping, lambda_=damping.lambda_ + 1e-6)), 1e-6),
        (replace(loaded, beam=replace(
            BEAM, density_kg_per_m=BEAM.density_kg_per_m * np.exp(1e-6))), 1e-6),
        (replace(loaded, root_compliance_rad_per_nm=compliance + 1e-6), 1e-6),
    )):  # fmt: skip
        difference = (more.transfer(s) - loaded.transfer(s)) / step
        assert np.abs(gradient[row] - difference).max() < 1e-3 * np.abs(difference).max(), row
        by_step = (more.poles(clamped_free_eigenvalues(3))[:, 0] - poles) / step
        assert moved[:, row] == pytest.approx(by_step, rel=1e-3, abs=1e-4), row


def test_beam_takes_given_mode_frequencies():
    wanted_hz = offset(0.0).poles(clamped_free_eigenvalues(3))[:, 0].imag / (2 * np.pi)
    heavier = replace(BEAM, density_kg_per_m=1.2 * BEAM.density_kg_per_m)
    found = Plant(heavier, DAMPINGS["fractional"]).with_frequencies(wanted_hz)
    assert found.stiffness_offsets == pytest.approx(OFFSETS[:2], abs=1e-5)
    assert found.beam.density_kg_per_m == pytest.approx(BEAM.density_kg_per_m, rel=1e-5)
    with pytest.raises(ValueError, match="does not oscillate"):
        Plant(BEAM, Damping(gamma=1e3)).with_frequencies(wanted_hz)


@pytest.mark.parametrize(("mass", "compliance"), ENDS)
def test_slope_of_the_tip_solves_the_boundary_value_problem(mass, compliance):
    s = 0.5 + 2j * np.pi * np.geomspace(0.5, 80, 60)
    loaded = Plant(BEAM, DAMPINGS["fractional"], **ends(mass, compliance))
    exact = solved(s, DAMPINGS["fractional"], mass, compliance)[1]
    assert loaded.tip_slope(s) == pytest.approx(exact, rel=1e-6)


STEPS = {
    "zeta": 1e-9, "alpha": 1e-6, "gamma": 1e-7, "lambda": 1e-6, "ln_density_over_stiffness": 1e-6,
    "ln_stiffness": 1e-6, "tip_mass_kg": 1e-9, "root_compliance_rad_per_nm": 1e-7,
}  # fmt: skip


def changed(loaded, name, step):
    """The beam with one parameter changed."""
    beam, damping = loaded.beam, loaded.damping
    match name:
        case "ln_density_over_stiffness":
            denser = replace(beam, density_kg_per_m=beam.density_kg_per_m * np.exp(step))
            return replace(loaded, beam=denser)
        case "ln_stiffness":
            grown = np.exp(step)
            stiffer = replace(
                beam,
                density_kg_per_m=beam.density_kg_per_m * grown,
                bending_stiffness_n_m2=beam.bending_stiffness_n_m2 * grown,
            )
            return replace(loaded, beam=stiffer)
        case "tip_mass_kg" | "root_compliance_rad_per_nm":
            return replace(loaded, **{name: getattr(loaded, name) + step})
    key = "lambda_" if name == "lambda" else name
    return replace(loaded, damping=replace(damping, **{key: getattr(damping, key) + step}))


@pytest.mark.parametrize("name", STEPS)
@pytest.mark.parametrize(("mass", "compliance"), [(5e-5, 0.002), (5e-4, 0.05)])
def test_derivatives_match_differences(mass, compliance, name):
    s = 0.5 + 2j * np.pi * np.geomspace(0.5, 60, 40)
    loaded = Plant(BEAM, DAMPINGS["fractional"], **ends(mass, compliance))
    step, z = STEPS[name], clamped_free_eigenvalues(3)
    above, below = changed(loaded, name, step), changed(loaded, name, -step)
    found, (gradient,) = loaded.transfer_and_gradient(s, [name])
    assert found == pytest.approx(loaded.transfer(s), rel=1e-12)
    differences = (above.transfer(s) - below.transfer(s)) / (2 * step)
    assert np.abs(gradient - differences).max() < 1e-4 * np.abs(differences).max()
    moved = (above.poles(z) - below.poles(z))[:, 0] / (2 * step)
    assert loaded.pole_gradients(loaded.poles(z)[:, 0], [name])[:, 0] == pytest.approx(
        moved, rel=1e-3
    )


@pytest.mark.parametrize("mass", [0.0, 5e-5])
def test_derivatives_match_differences_near_a_pole(mass):
    loaded, z = Plant(BEAM, DAMPINGS["fractional"], tip_mass_kg=mass), clamped_free_eigenvalues(3)
    for name in ("zeta", "ln_density_over_stiffness", "tip_mass_kg"):
        step = STEPS[name]
        poles = loaded.poles(z)[:, 0]
        moved = (changed(loaded, name, step).poles(z)[:, 0] - poles) / step
        assert loaded.pole_gradients(poles, [name])[:, 0] == pytest.approx(moved, rel=5e-3)


@pytest.mark.parametrize("stiffness", [3.224590545296398e-06, 3.352924149249553e-05, 0.090275])
@pytest.mark.parametrize("damping", [Damping(), Damping(zeta=7e-5)])
def test_pole_derivatives_by_the_ends_match_the_response(stiffness, damping):
    """Without a warning, and by the beam's own terms as in the uniform beam's closed form."""
    beam = Beam(0.98, 4.7e-3, stiffness)
    own, ends = ("zeta", "ln_density_over_stiffness"), ("tip_mass_kg", "root_compliance_rad_per_nm")
    loaded, z = Plant(beam, damping), clamped_free_eigenvalues(3)
    poles = loaded.poles(z)[:, 0]
    moved = loaded.pole_gradients(poles, (*own, *ends))
    for uniform, row in zip(loaded.mode_poles(3, own), moved, strict=True):
        np.testing.assert_allclose(row[:2], uniform.derivative, rtol=1e-6)
        assert np.isfinite(row).all()
        # Both make the mode slower.
        assert (row[2:].imag < 0).all()


def test_plant_without_mass_and_clamp_is_the_uniform_beam():
    s = 2j * np.pi * np.geomspace(0.01, 400, 300)
    uniform = Plant(BEAM, DAMPINGS["fractional"])
    assert uniform.transfer(s) == pytest.approx(transfer(s, BEAM, DAMPINGS["fractional"]), rel=1e-9)
    z = clamped_free_eigenvalues(5)
    assert (uniform.poles(z) == poles(BEAM, DAMPINGS["fractional"], 5)).all()


@pytest.mark.parametrize(("mass", "compliance"), ENDS[1:])
@pytest.mark.parametrize("name", DAMPINGS)
def test_response_has_its_poles_and_zeros(name, mass, compliance):
    loaded = Plant(BEAM, DAMPINGS[name], **ends(mass, compliance))
    at_poles = loaded.poles(clamped_free_eigenvalues(4))[:, 0]
    nearby = loaded.transfer(at_poles * (1 + 1e-4))
    assert (np.abs(loaded.transfer(at_poles * (1 + 1e-9))) > 1e4 * np.abs(nearby)).all()
    at_zeros = loaded.zeros(np.pi * np.arange(1.25, 4))[:, 0]
    nearby = loaded.transfer(at_zeros * (1 + 1e-4))
    assert (np.abs(loaded.transfer(at_zeros * (1 + 1e-9))) < 1e-4 * np.abs(nearby)).all()


@pytest.mark.parametrize(("mass", "compliance"), ENDS[1:])
def test_the_realisation_is_that_of_the_beam_with_its_ends(mass, compliance):
    made = realise(Plant(BEAM, DAMPINGS["fractional"], **ends(mass, compliance)))
    s = 2j * np.pi * np.geomspace(0.1, 90, 200)
    of_states = [made.c @ np.linalg.solve(x * np.eye(made.b.size) - made.a, made.b) for x in s]
    response = s**2 * (np.array(of_states) + made.direct_inertia_kg_m2)
    response += made.direct_viscosity_nm_s_per_rad * s + made.direct_stiffness_nm_per_rad
    exact = textbook(s, DAMPINGS["fractional"], mass, compliance)
    assert response == pytest.approx(exact, rel=1e-3)
