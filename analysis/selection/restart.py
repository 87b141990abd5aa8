"""Where a search with one structure starts, given the plant that another has found."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.whole_record.unknowns import FILTER_DELAYS, bare_beam
from rigd.beam import clamped_free_eigenvalues

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from analysis.structures import Structure
    from analysis.whole_record import ModeEstimate, Plant, RecordFit
    from analysis.whole_record.unknowns import Unknowns

_SMALL: Final = 1e-5
"""Loss, relative to stiffness or inertia, at which a damping is brought in."""


def vector(unknowns: Unknowns, plant: Plant) -> NDArray[np.float64]:
    """Unknowns of a plant, shape (k,): the way back of `Unknowns.plant`.

    Parameters
    ----------
    unknowns : Unknowns
    plant : Plant
        With damping wherever the structure has some.
    """
    damping, nominal = plant.damping, unknowns.nominal
    first, second = unknowns.omega_rad_s
    ratio = plant.beam.density_over_stiffness
    at = {
        "alpha": damping.alpha,
        "lambda": damping.lambda_,
        "density_over_stiffness": math.log(ratio / nominal.beam.density_over_stiffness),
        "bending_stiffness_n_m2": math.log(
            plant.beam.bending_stiffness_n_m2 / nominal.beam.bending_stiffness_n_m2
        ),
        "delay_s": plant.delay_s / unknowns.units["delay_s"],
        "tool_inertia_kg_m2": plant.tool_inertia_kg_m2 / nominal.beam.inertia_kg_m2,
        **{
            name: value
            for name, value in plant.parameters.items()
            if name.startswith("stiffness_offset")
        },
        **{name: value / unknowns.units[name] for name, value in plant.extras.items()},
    }
    if unknowns.structure.internal:
        size = damping.zeta * second**damping.alpha
        turn = math.pi / 2 * damping.alpha
        at["zeta"] = math.log(size * math.sin(turn))
        stiffening = math.log(abs(1 + size * complex(math.cos(turn), math.sin(turn))))
        at["density_over_stiffness"] -= stiffening
        at["bending_stiffness_n_m2"] += stiffening
    if unknowns.structure.external:
        size = damping.gamma / ratio * first ** (damping.lambda_ - 2)
        turn = math.pi / 2 * damping.lambda_
        at["gamma"] = math.log(size * math.sin(turn))
        at["density_over_stiffness"] += math.log(
            abs(1 - size * complex(math.cos(turn), math.sin(turn)))
        )
    if "tip_mass_kg" in unknowns.extras:
        ln_ratio, ln_stiffness = bare_beam(at["tip_mass_kg"])
        at["density_over_stiffness"] -= ln_ratio
        at["bending_stiffness_n_m2"] -= ln_stiffness
    for name, share in FILTER_DELAYS.items():
        if name in unknowns.extras:
            at["delay_s"] += share * plant.extras[name] / unknowns.units["delay_s"]
    return np.array([at.get(name, 0.0) for name in unknowns.names])


def adapted(unknowns: Unknowns, plant: Plant, of: Structure) -> NDArray[np.float64]:
    """Start for one structure at the plant that another found, shape (k,).

    Damping keeps its size at the first two modes where its order changes; damping that the other
    lacks comes in small, of order 1.

    Parameters
    ----------
    unknowns : Unknowns
        Of the one.
    plant : Plant
    of : Structure
        The other.
    """
    own = replace(unknowns, structure=of)
    start = dict(zip(own.names, vector(own, plant).tolist(), strict=True))
    for coefficient, order in (("zeta", "alpha"), ("gamma", "lambda")):
        start.setdefault(coefficient, math.log(_SMALL))
        start.setdefault(order, 1.0)
    return np.array([start[name] for name in unknowns.names])


def resonances_kept(
    unknowns: Unknowns, damped_as: RecordFit, modes: Sequence[ModeEstimate]
) -> NDArray[np.float64]:
    """Start for a beam that is not uniform with its modes where a uniform one has them, shape (k,).

    A fractional order acts as stiffness, differently at each mode; with another order the modes
    would lie elsewhere, by more than they are wide.

    Parameters
    ----------
    unknowns : Unknowns
        Of the beam that is not uniform.
    damped_as : RecordFit
        Its damping is where that of the start comes from.
    modes : sequence of ModeEstimate
        Those of the uniform beam.
    """
    x = adapted(unknowns, damped_as.plant, damped_as.structure)
    plant = unknowns.plant(x)
    damping, ratio = plant.damping, plant.beam.density_over_stiffness
    numbers = range(1, len(unknowns.offsets) + 2)
    found = {mode.number: mode for mode in modes if mode.frequency_hz > 0}
    if not all(number in found for number in numbers):
        return x
    stiffness = (clamped_free_eigenvalues(len(numbers)) / plant.beam.length_m) ** 4
    rises = []
    for k, number in zip(stiffness.tolist(), numbers, strict=True):
        mode = found[number]
        s = 2 * np.pi * mode.frequency_hz * complex(-mode.damping_ratio, 1.0)
        inertial = ratio * s**2 + damping.gamma * s**damping.lambda_
        elastic = k * (1 + damping.zeta * s**damping.alpha)
        rises.append((-inertial / elastic).real)
    if "density_over_stiffness" in unknowns.free:
        # Mode 1 has no offset: rho/EI puts it where it is.
        x[unknowns.names.index("density_over_stiffness")] -= math.log(rises[0])
        rises = [rise / rises[0] for rise in rises]
    for name, rise in zip(unknowns.offsets, rises[1:], strict=True):
        x[unknowns.names.index(name)] = rise - 1
    return x
