import math

import numpy as np
import pytest

from analysis.identify import SETTINGS
from analysis.identify.parametrization import Unknowns
from analysis.models import STRUCTURES
from rigd.beam import LOGARITHMIC_PARAMETERS, Beam, Damping, Plant, undamped_frequencies_rad_s

NOMINAL = Plant(Beam(0.98, 4.7e-3, 0.090275), Damping(), 1e-4, 1e-5)
SIZES = {"zeta": -2.0, "alpha": 0.7, "gamma": -1.0, "lambda": 1.3}


def start(unknowns):
    return unknowns.start(np.array([SIZES[name] for name in unknowns.structure.free]))


@pytest.mark.parametrize("free", [SETTINGS, (), SETTINGS[:1], SETTINGS[1:3], SETTINGS[3:]])
@pytest.mark.parametrize("name", STRUCTURES)
def test_derivatives(name, free):
    unknowns = Unknowns.for_structure(STRUCTURES[name], NOMINAL, free)
    x = start(unknowns) + np.random.default_rng(8).normal(scale=0.1, size=len(unknowns.names))

    def estimates(at, logarithmic):
        values = unknowns.plant(at).parameters
        return np.array(
            [math.log(values[n]) if n in logarithmic else values[n] for n in unknowns.names]
        )

    for derivative, logarithmic in (
        (unknowns.estimates_by_unknowns(x), LOGARITHMIC_PARAMETERS),
        (unknowns.plant_and_gradient(x)[1], LOGARITHMIC_PARAMETERS - {"zeta", "gamma"}),
    ):
        numeric = np.array(
            [
                (estimates(x + 1e-6 * e, logarithmic) - estimates(x - 1e-6 * e, logarithmic)) / 2e-6
                for e in np.eye(x.size)
            ]
        ).T
        assert derivative == pytest.approx(numeric, abs=1e-8)


def test_absent_damping_starts_small_with_order_one():
    plant = Plant(NOMINAL.beam, Damping(zeta=7e-5, alpha=0.9), 2e-4, 2e-5)
    unknowns = Unknowns.for_structure(STRUCTURES["VI"], NOMINAL, SETTINGS)
    found = unknowns.plant(unknowns.vector(plant))
    first, _ = undamped_frequencies_rad_s(NOMINAL.beam, 2)
    ratio = plant.beam.density_over_stiffness
    assert found.damping.lambda_ == 1.0
    assert found.damping.gamma == pytest.approx(1e-5 * ratio * first, rel=1e-6)
    for name, value in plant.parameters.items():
        if name not in ("gamma", "lambda"):
            assert found.parameters[name] == pytest.approx(value, rel=1e-9), name


def test_fixed_parameters_do_not_change():
    unknowns = Unknowns.for_structure(STRUCTURES["III"], NOMINAL, ())
    plant = unknowns.plant(start(unknowns))
    assert plant.beam.density_kg_per_m == pytest.approx(NOMINAL.beam.density_kg_per_m)
    assert plant.beam.bending_stiffness_n_m2 == NOMINAL.beam.bending_stiffness_n_m2
    assert (plant.delay_s, plant.tool_inertia_kg_m2) == (1e-4, 1e-5)
    assert (plant.damping.alpha, plant.damping.lambda_) == (1.0, 1.0)


def test_order_alone_preserves_loss_and_stiffness_at_the_mode():
    unknowns = Unknowns.for_structure(STRUCTURES["VI"], NOMINAL, SETTINGS)
    x = start(unknowns)
    first, second = undamped_frequencies_rad_s(NOMINAL.beam, 2)

    def at_the_modes(at):
        plant = unknowns.plant(at)
        p, stiffness = plant.damping, plant.beam.bending_stiffness_n_m2
        internal = p.zeta * (1j * second) ** p.alpha
        ratio = plant.beam.density_over_stiffness
        external = ratio * (1j * first) ** 2 + p.gamma * (1j * first) ** p.lambda_
        return (
            internal.imag,
            stiffness * abs(1 + internal),
            abs(external) / abs(1 + internal),
            external.imag / ratio,
        )

    moved = x.copy()
    moved[[1, 3]] = 0.3, 1.7
    assert at_the_modes(moved) == pytest.approx(at_the_modes(x), rel=1e-12)
    assert unknowns.plant(moved).parameters["zeta"] != pytest.approx(
        unknowns.plant(x).parameters["zeta"]
    )


def test_starts_lie_within_the_bounds():
    for structure in STRUCTURES.values():
        unknowns = Unknowns.for_structure(structure, NOMINAL, SETTINGS)
        lower, upper = unknowns.bounds
        x = start(unknowns)
        assert ((lower <= x) & (x <= upper)).all()
        assert unknowns.gradient_names[-4:] == (
            "ln_density_over_stiffness",
            "ln_stiffness",
            "delay_s",
            "tool_inertia_kg_m2",
        )
