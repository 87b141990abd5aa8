"""Simple causes of modes that no plain uniform beam has, each with one or two unknowns.

See `analysis.identify._explanations`, which fits them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from analysis.identify._altered_beam import GRAVITY_M_S2

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from analysis.identify._altered_beam import Alteration, Profile
    from analysis.identify._plant import Plant
    from rigd.beam import Beam

_BUTTERWORTH: Final = 2**0.5
RELAXATION: Final = "relaxation"
"""It may be all of the internal damping."""


@dataclass(frozen=True, slots=True)
class Cause:
    """Physical cause of deviating modes, with one or two unknowns of its own.

    Attributes
    ----------
    name : str
    starts : sequence of tuple of float
        Unknowns from which searches begin.
    lower, upper : tuple of float
        Plausible range; a result at an outer bound is discarded.
    altered : callable
        Function of the stated alteration, the unknowns and the beam that returns an alteration.
    described : callable
        Function of the unknowns and the fitted beam that returns size, unit and words.
    plant : callable, optional
        Function of the unknowns and the fitted plant that returns the plant with this cause.
    special : tuple of str
        Names of causes that this one includes as special cases.
    """

    name: str
    starts: Sequence[tuple[float, ...]]
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    altered: Callable[[Alteration, Sequence[float], Beam], Alteration]
    described: Callable[[Sequence[float], Beam], tuple[float, str, str]]
    plant: Callable[[Sequence[float], Plant], Plant | None] | None = None
    special: tuple[str, ...] = ()


def _with_tilt(stated: Alteration, own: Sequence[float], _: Beam) -> Alteration:
    return replace(stated, gravity_m_s2=GRAVITY_M_S2 * math.sin(math.radians(own[0])))


def _tilt(own: Sequence[float], _: Beam) -> tuple[float, str, str]:
    lower = "lower" if own[0] > 0 else "higher"
    words = f"an axis {_digits(abs(own[0]))}° off plumb (the tip at rest {lower} than the axis)"
    return own[0], "deg", words


def _mass_kg(fraction: float, beam: Beam) -> float:
    return fraction * beam.density_kg_per_m * beam.length_m


def _with_tip_mass(stated: Alteration, own: Sequence[float], beam: Beam) -> Alteration:
    return replace(stated, lumps=((1.0, _mass_kg(own[0], beam)),))


def _tip_mass(own: Sequence[float], beam: Beam) -> tuple[float, str, str]:
    mass_kg = _mass_kg(own[0], beam)
    return mass_kg, "kg", f"a mass of {_digits(1e3 * mass_kg)} g at the tip"


def _with_lump(stated: Alteration, own: Sequence[float], beam: Beam) -> Alteration:
    return replace(stated, lumps=(*stated.lumps, (own[0], _mass_kg(own[1], beam))))


def _lump(own: Sequence[float], beam: Beam) -> tuple[float, str, str]:
    mass_kg = _mass_kg(own[1], beam)
    at = f"{100 * own[0]:.0f} % of the length"
    return mass_kg, "kg", f"a mass of {_digits(1e3 * mass_kg)} g on the beam at {at}"


def _compliance(own: Sequence[float], beam: Beam) -> float:
    return own[0] * beam.length_m / beam.bending_stiffness_n_m2


def _with_clamp(stated: Alteration, own: Sequence[float], _: Beam) -> Alteration:
    return replace(stated, clamp_compliance=own[0], clamp_loss=own[1] if len(own) > 1 else 0.0)


def _clamp(own: Sequence[float], beam: Beam) -> tuple[float, str, str]:
    stiffness = 1 / _compliance(own, beam)
    loss = f" and a loss factor of {_digits(own[1])}" if len(own) > 1 else ""
    return (
        stiffness,
        "N·m/rad",
        f"a clamp with a stiffness of {_digits(stiffness)} N·m/rad{loss}",
    )


def _corner(own: Sequence[float], _: Beam) -> tuple[float, str, str]:
    hz = _hz(own)
    return hz, "Hz", f"a low-pass filter of first order at {_digits(hz)} Hz in the torque channel"


def _second_corner(own: Sequence[float], _: Beam) -> tuple[float, str, str]:
    hz = _hz(own)
    return hz, "Hz", f"a low-pass filter of second order at {_digits(hz)} Hz in the torque channel"


def _with_filter(own: Sequence[float], plant: Plant) -> Plant | None:
    """Return the plant with a first-order filter; None if the file already states a filter."""
    stated = plant.filter_time_constant_s
    return None if stated else replace(plant, filter_time_constant_s=1e-3 * own[0])


def _with_second_filter(own: Sequence[float], plant: Plant) -> Plant | None:
    """Return the plant with a second-order filter; None if the file already states a filter."""
    stated = plant.second_order_filter_time_constant_s
    return None if stated else replace(plant, second_order_filter_time_constant_s=1e-3 * own[0])


def _resonance(own: Sequence[float], _: Beam) -> tuple[float, str, str]:
    hz = _hz(own)
    return hz, "Hz", f"a resonance of sensor or mount near {_digits(hz)} Hz"


def _hz(own: Sequence[float]) -> float:
    return 1e3 / (2 * math.pi * own[0])


def _relaxation(own: Sequence[float], _: Beam) -> tuple[float, str, str]:
    time_s = math.exp(own[0])
    words = (
        f"a relaxation of the material in {_digits(1e3 * time_s)} ms that stiffens it by "
        f"{_digits(100 * own[1])} %"
    )
    return own[1], "1", words


def _digits(value: float) -> str:
    """Round to two digits: the interval is not known."""
    return f"{value:.2g}" if abs(value) < 100 else f"{float(f'{value:.2g}'):.0f}"


def _uneven_mass(profile: Profile, words: str) -> Cause:
    def altered(stated: Alteration, own: Sequence[float], _: Beam) -> Alteration:
        return replace(stated, density=((profile, own[0]),))

    return Cause("uneven mass", _EITHER, (-0.3,), (0.3,), altered, _deviation(words))


def _uneven_stiffness(profile: Profile, words: str) -> Cause:
    def altered(stated: Alteration, own: Sequence[float], _: Beam) -> Alteration:
        return replace(stated, stiffness=((profile, own[0]),))

    return Cause("uneven stiffness", _EITHER, (-0.3,), (0.3,), altered, _deviation(words))


def _deviation(words: str) -> Callable[[Sequence[float], Beam], tuple[float, str, str]]:
    return lambda own, _: (own[0], "1", words.format(f"{float(f'{100 * own[0]:.2g}'):+g} %"))


_EITHER: Final = ((-0.01,), (0.01,))
CAUSES: Final = (
    Cause("tilt", ((-2.0,), (2.0,)), (-10.0,), (10.0,), _with_tilt, _tilt),
    Cause(
        "tip mass", ((0.003,), (0.02,), (0.1,), (0.25,)), (0.0,), (1.0,), _with_tip_mass, _tip_mass,
        lambda own, plant: replace(plant, tip_mass_kg=_mass_kg(own[0], plant.beam)),
    ),
    Cause(
        "lump", tuple((0.05 * index, 0.01) for index in range(3, 20, 2)),
        (0.02, 0.0), (0.99, 0.5), _with_lump, _lump, special=("tip mass",),
    ),
    _uneven_mass("taper", "a mass per length that changes by {} from root to tip"),
    _uneven_mass("outer half", "an outer half with {} mass per length"),
    _uneven_mass("wave", "a mass per length with {} at both ends and the opposite in the middle"),
    _uneven_stiffness("taper", "a bending stiffness that changes by {} from root to tip"),
    _uneven_stiffness("outer half", "an outer half with {} bending stiffness"),
    _uneven_stiffness(
        "wave", "a bending stiffness with {} at both ends and the opposite in the middle"
    ),
    Cause(
        "elastic clamp", ((1e-4,), (1e-3,), (1e-2,)), (0.0,), (0.2,), _with_clamp, _clamp,
        lambda own, plant: replace(plant, root_compliance_rad_per_nm=_compliance(own, plant.beam)),
    ),
    Cause(
        "lossy clamp",
        tuple((size, loss) for size in (1e-4, 1e-3, 1e-2) for loss in (0.02, 0.1)),
        (0.0, 0.0), (0.2, 0.5), _with_clamp, _clamp, special=("elastic clamp",),
    ),
    Cause(
        "torque filter of first order", ((0.2,), (0.6,), (2.0,)), (0.0,), (20.0,),
        lambda stated, own, _: replace(stated, lag_s=1e-3 * own[0]), _corner,
        _with_filter,
    ),
    Cause(
        "torque filter of second order", ((0.2,), (0.6,), (2.0,)), (0.0,), (10.0,),
        lambda stated, own, _: replace(stated, sensor=(1e-3 * own[0], _BUTTERWORTH)),
        _second_corner,
        _with_second_filter,
    ),
    Cause(
        "sensor resonance",
        tuple((size, loss) for size in (0.3, 0.6, 1.0, 1.6) for loss in (0.05, 0.5)),
        (0.0, 0.0), (3.0, 2.0),
        lambda stated, own, _: replace(stated, sensor=(1e-3 * own[0], own[1])), _resonance,
        special=("torque filter of second order",),
    ),
    Cause(
        RELAXATION,
        tuple(
            (math.log(time_s), strength)
            for time_s in (5e-4, 2e-3, 8e-3, 0.03, 0.1, 0.3)
            for strength in (0.003, 0.015, 0.08)
        ),
        (math.log(1e-4), 0.0), (math.log(3.0), 0.5),
        lambda stated, own, _: replace(stated, relaxation=(own[1], math.exp(own[0]))), _relaxation,
    ),
)  # fmt: skip
