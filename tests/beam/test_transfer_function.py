"""Eq. 25 and its derivatives against values computed with 50 and 60 digits.

``exact_model.csv`` has G. ``exact_derivatives.csv`` has its derivatives with respect to the six
parameters: central differences (step 1e-20) of Eq. 25 as the paper writes it, with the external
damping outside ``rho/EI``, evaluated by mpmath with 60 digits, for the means of Table 3 and four
random beams, at 24 points each from 1e-3 to 5e3 Hz, every fourth of them off the imaginary axis.
"""

import csv
from pathlib import Path

import numpy as np
import pytest
from cases import further
from hypothesis import given
from hypothesis import strategies as st

from rigd.beam import GRADIENT_NAMES, Beam, Damping, TransferGrid, transfer, transfer_and_gradient

DATA = Path(__file__).parent.parent / "data"
PAPER_BEAM = Beam(0.98, 4.7e-3, 0.090275)

beams = st.builds(
    Beam,
    length_m=st.floats(0.1, 3.0),
    density_kg_per_m=st.floats(1e-4, 1.0),
    bending_stiffness_n_m2=st.floats(1e-3, 10.0),
)
dampings = st.builds(
    Damping,
    zeta=st.floats(0.0, 1e-2),
    alpha=st.floats(0.05, 1.95),
    gamma=st.floats(0.0, 1.0),
    lambda_=st.floats(0.05, 1.95),
)


def rows_by_case(name):
    cases = {}
    with (DATA / name).open(newline="") as file:
        for row in csv.DictReader(file):
            cases.setdefault(row.pop("case"), []).append({k: float(v) for k, v in row.items()})
    return cases


def model(row):
    beam = Beam(row["length_m"], row["density_kg_per_m"], row["bending_stiffness_n_m2"])
    return beam, Damping(row["zeta"], row["alpha"], row["gamma"], row["lambda"])


GOLDEN = rows_by_case("exact_model.csv")
DERIVATIVES = rows_by_case("exact_derivatives.csv")
UNMARKED_CASES = ("II-const", "VI-omega", "random-0", "random-2")
"""Cases of `make test`: no internal damping, both, and beams unlike the paper's."""


@pytest.mark.parametrize("case", GOLDEN)
def test_golden_values(case):
    rows = GOLDEN[case]
    omega = np.array([row["omega_rad_s"] for row in rows])
    exact = np.array([complex(row["g_real"], row["g_imag"]) for row in rows])
    g = transfer(1j * omega, *model(rows[0]))
    assert np.max(np.abs(g - exact) / np.abs(exact)) < 1e-12


@pytest.mark.parametrize("name", GRADIENT_NAMES)
@pytest.mark.parametrize(
    "case", [case if case in UNMARKED_CASES else further(case) for case in DERIVATIVES]
)
def test_derivatives(case, name):
    rows = DERIVATIVES[case]
    s = np.array([complex(row["sigma_rad_s"], row["omega_rad_s"]) for row in rows])
    exact = np.array([complex(row[f"{name}_real"], row[f"{name}_imag"]) for row in rows])
    for points in (s, s[s.real == 0]):  # the imaginary axis has a faster way of its own
        _, gradient = transfer_and_gradient(points, *model(rows[0]), [name])
        wanted = exact if points is s else exact[s.real == 0]
        error = np.abs(gradient[0] - wanted)
        # A damping that is absent has no derivative with respect to its order.
        assert np.all(error <= 1e-11 * np.abs(wanted))
        assert wanted.any() or not gradient.any()


def test_gradient_has_the_requested_order():
    s = 2j * np.pi * np.geomspace(1e-3, 5e3, 500)
    damping = Damping(7e-5, 0.996, 0.055, 0.594)
    g, gradient = transfer_and_gradient(s, PAPER_BEAM, damping, GRADIENT_NAMES)
    _, reverse = transfer_and_gradient(s, PAPER_BEAM, damping, GRADIENT_NAMES[::-1])
    assert np.array_equal(gradient, reverse[::-1])
    np.testing.assert_allclose(g, transfer(s, PAPER_BEAM, damping), rtol=1e-14)


def test_unknown_parameter_is_named():
    with pytest.raises(ValueError, match="'beta'"):
        transfer_and_gradient([1j], PAPER_BEAM, Damping(), ["beta"])


@pytest.mark.parametrize("shape", [(), (0,), (1,), (5000,), (3, 4), (2, 3, 2)])
def test_any_shape(shape):
    s = 1j * np.linspace(1.0, 300.0, int(np.prod(shape))).reshape(shape)
    damping = Damping(7e-5, 0.996, 0.055, 0.594)
    g, gradient = transfer_and_gradient(s, PAPER_BEAM, damping, ["zeta", "gamma"])
    assert transfer(s, PAPER_BEAM, damping).shape == g.shape == shape
    assert gradient.shape == (2, *shape)
    some = slice(None, None, 37 if s.size > 100 else 1)
    one_by_one = [transfer(x, PAPER_BEAM, damping) for x in s.ravel()[some]]
    np.testing.assert_allclose(g.ravel()[some], one_by_one, rtol=1e-12)


@given(beam=beams, damping=dampings)
def test_zero_frequency_gives_zero(beam, damping):
    g, gradient = transfer_and_gradient([0.0, 1j], beam, damping, GRADIENT_NAMES)
    assert g[0] == 0
    assert not gradient[:, 0].any()
    assert g[1] == pytest.approx(transfer(1j, beam, damping), rel=1e-13)


@given(beam=beams, damping=dampings, real=st.floats(-1e3, 1e3), imag=st.floats(1e-3, 1e4))
def test_conjugate_symmetry(beam, damping, real, imag):
    s = np.array([complex(real, imag), complex(real, -imag)])
    g, gradient = transfer_and_gradient(s, beam, damping, GRADIENT_NAMES)
    np.testing.assert_allclose(g[1], np.conj(g[0]), rtol=1e-12)
    np.testing.assert_allclose(gradient[:, 1], np.conj(gradient[:, 0]), rtol=1e-11, atol=1e-300)


@given(beam=beams, damping=dampings)
def test_finite_over_eighteen_decades(beam, damping):
    s = 1j * np.geomspace(1e-9, 1e9, 800)
    g, gradient = TransferGrid(s).evaluate_with_gradient(beam, damping, GRADIENT_NAMES)
    assert np.isfinite(g).all()
    assert np.isfinite(gradient).all()


@given(beam=beams)
def test_undamped_low_frequency_is_the_inertia_of_a_rigid_beam(beam):
    first_mode = 3.516 / (beam.length_m**2 * np.sqrt(beam.density_over_stiffness))
    s = 1e-4j * first_mode
    assert transfer(s, beam, Damping()) == pytest.approx(s * s * beam.inertia_kg_m2, rel=1e-6)


@given(beam=beams, zeta=st.floats(0, 1e-2), gamma=st.floats(0, 1.0))
def test_order_one_equals_the_integer_model(beam, zeta, gamma):
    s = 1j * np.geomspace(0.1, 2e3, 300)
    c = 1 + zeta * s
    z = (-(beam.length_m**4) * (beam.density_over_stiffness * s**2 + gamma * s) / c) ** 0.25
    z = z[np.abs(z) < 50]  # beyond, the textbook form overflows
    s, c = s[: z.size], c[: z.size]
    textbook = (
        -beam.bending_stiffness_n_m2 / beam.length_m * c * z
        * (np.sin(z) * np.cosh(z) - np.cos(z) * np.sinh(z)) / (1 + np.cos(z) * np.cosh(z))
    )  # fmt: skip
    g = transfer(s, beam, Damping(zeta, 1.0, gamma, 1.0))
    compared = (np.abs(z) > 1) & (np.abs(np.log10(np.abs(textbook / z**4))) < 3)
    np.testing.assert_allclose(g[compared], textbook[compared], rtol=1e-9)


@given(beam=beams, damping=dampings)
def test_beam_is_passive(beam, damping):
    """The beam takes power in any motion of the motor: Re(G / s) >= 0 on the imaginary axis."""
    s = 1j * np.geomspace(1e-2, 1e4, 300)
    impedance = transfer(s, beam, damping) / s
    assert np.all(impedance.real >= -1e-9 * np.abs(impedance))
