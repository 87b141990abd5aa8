"""Fits: exact where the data are, and never above what other searches find."""

import itertools
import math

import numpy as np
import pytest
import scipy  # whose parts come on first use
from cases import further
from hypothesis import given, settings
from hypothesis import strategies as st

from analysis.models import STRUCTURES, WeightingError, weights
from analysis.paper import fit_frf, fit_many
from rigd.beam import Plant, ResponseGrid, TransferGrid, transfer

pytestmark = pytest.mark.fit

WEIGHTINGS = ("const", "omega")
SOME = [name if name == "VI" else further(name) for name in STRUCTURES]
"""Structures of tests that are run each time for the freest."""
SOME_WEIGHTINGS = [further("const"), "omega"]


def assert_parameters(fit, damping, relative=1e-6):
    expected = {
        "zeta": damping.zeta,
        "alpha": damping.alpha,
        "gamma": damping.gamma,
        "lambda": damping.lambda_,
    }
    assert list(fit.parameters) == list(expected)
    for name, value in expected.items():
        assert fit.parameters[name] == pytest.approx(value, rel=relative)


@pytest.mark.parametrize("weighting", SOME_WEIGHTINGS)
def test_noise_free_fits_return_the_parameters_of_table_3(
    link, paper_grid_hz, paper_dampings, weighting
):
    s = 2j * np.pi * paper_grid_hz
    for (name, _), damping in paper_dampings.items():
        fit = fit_frf(paper_grid_hz, transfer(s, link, damping), link, STRUCTURES[name], weighting)
        assert_parameters(fit, damping)
        assert fit.at_bounds == ()
        assert fit.cost < 1e-15


@settings(max_examples=10)
@given(
    name=st.sampled_from(list(STRUCTURES)),
    weighting=st.sampled_from([*WEIGHTINGS, "omega^-0.5"]),
    internal_size=st.floats(-3.5, -1.2).map(lambda x: 10**x),
    alpha=st.floats(0.3, 1.7),
    external_size=st.floats(-2.5, -0.2).map(lambda x: 10**x),
    lambda_=st.floats(0.2, 1.7),
    tool_inertia=st.sampled_from([0.0, 1e-5]),
)
def test_noise_free_fits_return_any_physical_parameters(
    link, paper_grid_hz, name, weighting, internal_size, alpha, external_size, lambda_,
    tool_inertia,
):  # fmt: skip
    structure = STRUCTURES[name]
    alpha = structure.fixed.get("alpha", alpha)
    lambda_ = structure.fixed.get("lambda", lambda_)
    damping = structure.damping(
        {
            "zeta": internal_size * 100.55**-alpha,
            "alpha": alpha,
            "gamma": external_size * link.density_over_stiffness * 16.045 ** (2 - lambda_),
            "lambda": lambda_,
        }
    )
    plant = Plant(link, damping, tool_inertia_kg_m2=tool_inertia)
    (measured,) = ResponseGrid(2j * np.pi * paper_grid_hz).evaluate(plant)
    fit = fit_frf(
        paper_grid_hz, measured, link, structure, weighting, tool_inertia_kg_m2=tool_inertia
    )
    assert_parameters(fit, damping)


@pytest.fixture(scope="module")
def fits(noisy_frf, link):
    found = fit_many(noisy_frf.frequency_hz, noisy_frf.response, link)
    return {(fit.structure.name, fit.weighting): fit for fit in found}


@pytest.fixture(scope="module")
def cost(noisy_frf, link):
    """Eq. (26) on all points from the parameters themselves, independent of the code under test."""
    omega = 2 * np.pi * noisy_frf.frequency_hz
    grid = TransferGrid(1j * omega)
    p = {"const": np.full(omega.size, 1 / omega.size), "omega": 1 / omega / np.sum(1 / omega)}

    def evaluate(weighting, damping):
        return float(
            np.sum(p[weighting] * np.abs(grid.evaluate(link, damping) - noisy_frf.response) ** 2)
        )

    return evaluate


def test_every_structure_with_every_weighting(fits, cost):
    assert list(fits) == list(itertools.product(STRUCTURES, WEIGHTINGS))
    for (name, weighting), fit in fits.items():
        assert fit.structure is STRUCTURES[name]
        assert fit.cost == pytest.approx(cost(weighting, fit.damping), rel=1e-12)
        assert fit.damping == STRUCTURES[name].damping(fit.parameters)


@pytest.mark.parametrize("weighting", SOME_WEIGHTINGS)
@pytest.mark.parametrize("name", SOME)
def test_neighbours_are_not_lower(fits, cost, name, weighting):
    """A local grid from close by to far off, along the parameters and along flat directions."""
    fit = fits[name, weighting]
    for width in (1e-3, 1e-2, 1e-1):
        for steps in itertools.product((-width, 0.0, width), repeat=len(fit.structure.free)):
            step = dict(zip(fit.structure.free, steps, strict=True))
            moved = dict(fit.parameters)
            for order in {"alpha", "lambda"} & step.keys():
                moved[order] = min(max(moved[order] + step[order], 0.001), 1.999)
            for coefficient, order, rad_s in (("zeta", "alpha", 134.0), ("gamma", "lambda", 19.0)):
                if coefficient in step:
                    # The damping at a mode changes; the order alone does not change it.
                    turn = fit.parameters[order] - moved[order]
                    moved[coefficient] *= math.exp(step[coefficient]) * rad_s**turn
            assert cost(weighting, fit.structure.damping(moved)) >= fit.cost * (1 - 1e-9)


@pytest.mark.parametrize("weighting", SOME_WEIGHTINGS)
@pytest.mark.parametrize("name", SOME)
def test_random_starts_do_not_end_lower(fits, cost, noisy_frf, link, name, weighting):
    """Twenty random starts of scipy's solver on every tenth point, the best carried to all."""
    structure = STRUCTURES[name]
    every = weights(2 * np.pi * noisy_frf.frequency_hz, weighting)
    grid = TransferGrid(2j * np.pi * noisy_frf.frequency_hz[::10])
    root, measured = np.sqrt(every[::10])[:, None], noisy_frf.response[::10]
    low = np.array([0.001 if p in ("alpha", "lambda") else -16.0 for p in structure.free])
    high = np.array([1.999 if p in ("alpha", "lambda") else 4.0 for p in structure.free])

    def damping(x):
        free = zip(structure.free, map(float, x), strict=True)
        return structure.damping(
            {p: v if p in ("alpha", "lambda") else math.exp(v) for p, v in free}
        )

    def residual(x):
        r = root[:, 0] * (grid.evaluate(link, damping(x)) - measured)
        return np.concatenate((r.real, r.imag))

    def jacobian(x):
        _, gradient = grid.evaluate_with_gradient(link, damping(x), structure.free)
        chain = [
            1.0 if p in ("alpha", "lambda") else math.exp(v)
            for p, v in zip(structure.free, x, strict=True)
        ]
        j = root * (np.array(chain)[:, None] * gradient).T
        return np.concatenate((j.real, j.imag))

    rng = np.random.default_rng([len(name), len(weighting), 5_771])
    ends = [
        scipy.optimize.least_squares(
            residual, rng.uniform(low, high), jacobian, bounds=(low, high), max_nfev=40
        )
        for _ in range(20)
    ]
    best = sorted(ends, key=lambda end: end.cost)[:3]
    assert fits[name, weighting].cost <= min(cost(weighting, damping(e.x)) for e in best) * (
        1 + 1e-9
    )


@pytest.mark.parametrize("weighting", WEIGHTINGS)
@pytest.mark.parametrize(
    ("wider", "narrower"),
    [("III", "I"), ("III", "II"), ("IV", "I"), ("V", "II"), ("VII", "III"), ("VI", "VII"),
     ("VI", "IV"), ("VI", "V")],
)  # fmt: skip
def test_more_freedom_never_increases_cost(fits, wider, narrower, weighting):
    assert fits[wider, weighting].cost <= fits[narrower, weighting].cost * (1 + 1e-9)


def test_bias_of_the_paper(synthetic_frf, link, plant):
    """Welch's leakage is read as damping: the biases measured over twenty other sessions."""
    expected = {
        "const": (-0.034, -0.015, -0.356, 0.282),
        "omega": (0.20, -0.025, -0.16, 0.128),
    }
    for weighting, (zeta, alpha, gamma, lambda_) in expected.items():
        fit = fit_frf(
            synthetic_frf.frequency_hz, synthetic_frf.response, link, STRUCTURES["VI"], weighting
        ).parameters
        assert fit["zeta"] / plant.zeta - 1 == pytest.approx(zeta, abs=0.05)
        assert fit["alpha"] - plant.alpha == pytest.approx(alpha, abs=0.01)
        assert fit["gamma"] / plant.gamma - 1 == pytest.approx(gamma, abs=0.03)
        assert fit["lambda"] - plant.lambda_ == pytest.approx(lambda_, abs=0.015)


def test_fits_do_not_depend_on_each_other(fits, noisy_frf, link):
    for name in ("II", "VI"):
        alone = fit_frf(noisy_frf.frequency_hz, noisy_frf.response, link, STRUCTURES[name], "omega")
        assert alone == fits[name, "omega"]


def test_standard_deviations_of_the_free_parameters_only(fits):
    for fit in fits.values():
        assert fit.std.keys() == fit.parameters.keys()
        for name, std in fit.std.items():
            assert std > 0 if name in fit.structure.free else std == 0


def test_standard_deviations_agree_with_scatter(link, plant, paper_grid_hz):
    exact = transfer(2j * np.pi * paper_grid_hz, link, plant)
    rng = np.random.default_rng(60_221)
    repeats = [
        fit_frf(
            paper_grid_hz,
            exact + 0.3 * (rng.normal(size=exact.size) + 1j * rng.normal(size=exact.size)),
            link,
            STRUCTURES["VII"],
            "omega",
        )
        for _ in range(10)
    ]
    for name in ("zeta", "gamma", "lambda"):
        scatter = np.std([fit.parameters[name] for fit in repeats], ddof=1)
        assert np.mean([fit.std[name] for fit in repeats]) == pytest.approx(scatter, rel=0.5)


def test_absent_damping_rests_on_its_bound(link, paper_grid_hz, paper_dampings):
    truth = paper_dampings["II", "const"]
    measured = transfer(2j * np.pi * paper_grid_hz, link, truth)
    measured *= 1 + 1e-4j  # a lead that internal damping cannot explain
    fit = fit_frf(paper_grid_hz, measured, link, STRUCTURES["III"], "const")
    assert fit.parameters["zeta"] * 100.55 < 1e-3
    assert fit.parameters["gamma"] == pytest.approx(truth.gamma, rel=0.01)


def test_weighting_by_a_function(noisy_frf, link, fits):
    def inverse(omega):
        return 1 / omega

    fit = fit_frf(noisy_frf.frequency_hz, noisy_frf.response, link, STRUCTURES["III"], inverse)
    assert fit.weighting == "inverse"
    assert fit.cost == pytest.approx(fits["III", "omega"].cost, rel=1e-9)


def test_unusable_responses_are_refused(noisy_frf, link):
    few = noisy_frf.band(2.5, 2.51)
    with pytest.raises(ValueError, match="2 points"):
        fit_many(few.frequency_hz, few.response, link)
    broken = noisy_frf.response.copy()
    broken[5] = np.nan
    with pytest.raises(ValueError, match="finite"):
        fit_many(noisy_frf.frequency_hz, broken, link)
    with pytest.raises(ValueError, match="above 0 Hz"):
        fit_many(np.arange(10.0), np.ones(10, dtype=complex), link)
    with pytest.raises(WeightingError, match="no weighting"):
        fit_many(noisy_frf.frequency_hz, noisy_frf.response, link, weightings=["omgea"])
