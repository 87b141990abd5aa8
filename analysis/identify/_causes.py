"""Simple causes of modes that differ from those of a uniform beam, with one or two unknowns each.

`analysis.identify._explanations` fits them to the modes of a record.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from analysis.identify._altered_beam import GRAVITY_M_S2

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from analysis.identify._altered_beam import BeamDeviations, DeviationProfile
    from rigd.beam import Beam, Plant

_BUTTERWORTH_INVERSE_QUALITY: Final = 2**0.5
"""Reciprocal quality factor of a second-order Butterworth filter."""

RELAXATION_CAUSE: Final = "relaxation"
"""Name of the cause that may explain all of the internal damping."""


@dataclass(frozen=True, slots=True)
class Cause:
    """Physical cause that makes the modes deviate from those of a uniform beam.

    It has one or two unknowns of its own.

    Attributes
    ----------
    name : str
        Name of the cause.
    start_points : sequence of tuple of float
        Unknowns from which searches begin.
    lower_bounds, upper_bounds : tuple of float
        Plausible range of the unknowns; a fit that ends at a bound is discarded.
    add_deviation : callable
        Function of the deviations that the file states, the unknowns and the beam. It returns the
        deviations with this cause added.
    describe : callable
        Function of the unknowns and the fitted beam. It returns size, unit and a phrase.
    plant : callable, optional
        Function of the unknowns and the fitted plant. It returns the plant with this cause.
    special_case_names : tuple of str
        Names of causes that this one includes as special cases.
    """

    name: str
    start_points: Sequence[tuple[float, ...]]
    lower_bounds: tuple[float, ...]
    upper_bounds: tuple[float, ...]
    add_deviation: Callable[[BeamDeviations, Sequence[float], Beam], BeamDeviations]
    describe: Callable[[Sequence[float], Beam], tuple[float, str, str]]
    plant: Callable[[Sequence[float], Plant], Plant | None] | None = None
    special_case_names: tuple[str, ...] = ()


def _set_tilt(
    stated_deviations: BeamDeviations, unknowns: Sequence[float], _: Beam
) -> BeamDeviations:
    """Return beam deviations with gravity for a tilted axis; the unknown is the tilt in degrees."""
    return replace(
        stated_deviations, gravity_m_s2=GRAVITY_M_S2 * math.sin(math.radians(unknowns[0]))
    )


def _describe_tilt(unknowns: Sequence[float], _: Beam) -> tuple[float, str, str]:
    """Describe a tilt of the axis: size in degrees, unit and phrase."""
    direction = "lower" if unknowns[0] > 0 else "higher"
    phrase = (
        f"an axis {_format_two_digits(abs(unknowns[0]))}° off plumb "
        f"(the tip at rest {direction} than the axis)"
    )
    return unknowns[0], "deg", phrase


def _added_mass_kg(mass_fraction: float, beam: Beam) -> float:
    """Return a mass in kilograms that is a given fraction of the beam's mass."""
    return mass_fraction * beam.density_kg_per_m * beam.length_m


def _set_tip_mass(
    stated_deviations: BeamDeviations, unknowns: Sequence[float], beam: Beam
) -> BeamDeviations:
    """Return beam deviations with a tip mass; the unknown is its fraction of the beam's mass."""
    return replace(stated_deviations, point_masses=((1.0, _added_mass_kg(unknowns[0], beam)),))


def _describe_tip_mass(unknowns: Sequence[float], beam: Beam) -> tuple[float, str, str]:
    """Describe a mass at the tip: size in kilograms, unit and phrase."""
    mass_kg = _added_mass_kg(unknowns[0], beam)
    return mass_kg, "kg", f"a mass of {_format_two_digits(1e3 * mass_kg)} g at the tip"


def _add_point_mass(
    stated_deviations: BeamDeviations, unknowns: Sequence[float], beam: Beam
) -> BeamDeviations:
    """Return beam deviations with a further point mass.

    The unknowns are its position relative to the length and its fraction of the beam's mass.
    """
    return replace(
        stated_deviations,
        point_masses=(
            *stated_deviations.point_masses,
            (unknowns[0], _added_mass_kg(unknowns[1], beam)),
        ),
    )


def _describe_point_mass(unknowns: Sequence[float], beam: Beam) -> tuple[float, str, str]:
    """Describe a point mass on the beam: size in kilograms, unit and phrase."""
    mass_kg = _added_mass_kg(unknowns[1], beam)
    position_phrase = f"{100 * unknowns[0]:.0f} % of the length"
    return (
        mass_kg,
        "kg",
        f"a mass of {_format_two_digits(1e3 * mass_kg)} g on the beam at {position_phrase}",
    )


def _compliance_rad_per_nm(unknowns: Sequence[float], beam: Beam) -> float:
    """Return the clamp's compliance in rad/(N·m); the unknown is its ratio to L/EI."""
    return unknowns[0] * beam.length_m / beam.bending_stiffness_n_m2


def _set_clamp_compliance(
    stated_deviations: BeamDeviations, unknowns: Sequence[float], _: Beam
) -> BeamDeviations:
    """Return beam deviations with a compliant clamp; unknowns are compliance and loss factor.

    The compliance is relative to that of the beam, L/EI.
    """
    return replace(
        stated_deviations,
        clamp_compliance=unknowns[0],
        clamp_loss=unknowns[1] if len(unknowns) > 1 else 0.0,
    )


def _describe_clamp(unknowns: Sequence[float], beam: Beam) -> tuple[float, str, str]:
    """Describe a compliant clamp: rotational stiffness in N·m/rad, unit and phrase."""
    stiffness_nm_per_rad = 1 / _compliance_rad_per_nm(unknowns, beam)
    loss_phrase = (
        f" and a loss factor of {_format_two_digits(unknowns[1])}" if len(unknowns) > 1 else ""
    )
    return (
        stiffness_nm_per_rad,
        "N·m/rad",
        f"a clamp with a stiffness of {_format_two_digits(stiffness_nm_per_rad)} "
        f"N·m/rad{loss_phrase}",
    )


def _describe_first_order_filter(unknowns: Sequence[float], _: Beam) -> tuple[float, str, str]:
    """Describe a first-order filter of the torque channel: corner in Hz, unit and phrase."""
    corner_hz = _filter_frequency_hz(unknowns)
    return (
        corner_hz,
        "Hz",
        f"a low-pass filter of first order at {_format_two_digits(corner_hz)} Hz "
        "in the torque channel",
    )


def _describe_second_order_filter(unknowns: Sequence[float], _: Beam) -> tuple[float, str, str]:
    """Describe a second-order filter of the torque channel: corner in Hz, unit and phrase."""
    corner_hz = _filter_frequency_hz(unknowns)
    return (
        corner_hz,
        "Hz",
        f"a low-pass filter of second order at {_format_two_digits(corner_hz)} Hz "
        "in the torque channel",
    )


def _plant_with_first_order_filter(unknowns: Sequence[float], plant: Plant) -> Plant | None:
    """Return a plant with a first-order torque filter; None if the file states one."""
    stated_time_constant_s = plant.filter_time_constant_s
    return (
        None
        if stated_time_constant_s
        else replace(plant, filter_time_constant_s=1e-3 * unknowns[0])
    )


def _plant_with_second_order_filter(unknowns: Sequence[float], plant: Plant) -> Plant | None:
    """Return a plant with a second-order torque filter; None if the file states one."""
    stated_time_constant_s = plant.second_order_filter_time_constant_s
    return (
        None
        if stated_time_constant_s
        else replace(plant, second_order_filter_time_constant_s=1e-3 * unknowns[0])
    )


def _describe_resonance(unknowns: Sequence[float], _: Beam) -> tuple[float, str, str]:
    """Describe a resonance of the torque sensor: frequency in Hz, unit and phrase."""
    resonance_hz = _filter_frequency_hz(unknowns)
    return (
        resonance_hz,
        "Hz",
        f"a resonance of sensor or mount near {_format_two_digits(resonance_hz)} Hz",
    )


def _filter_frequency_hz(unknowns: Sequence[float]) -> float:
    """Return the corner or resonance frequency in hertz for a time constant in milliseconds."""
    return 1e3 / (2 * math.pi * unknowns[0])


def _describe_relaxation(unknowns: Sequence[float], _: Beam) -> tuple[float, str, str]:
    """Describe a relaxation of the beam's material: relative stiffening, unit and phrase."""
    relaxation_time_s = math.exp(unknowns[0])
    phrase = (
        f"a relaxation of the material in {_format_two_digits(1e3 * relaxation_time_s)} ms that "
        f"stiffens it by {_format_two_digits(100 * unknowns[1])} %"
    )
    return unknowns[1], "1", phrase


def _format_two_digits(value: float) -> str:
    """Format a value with two significant digits."""
    return f"{value:.2g}" if abs(value) < 100 else f"{float(f'{value:.2g}'):.0f}"


def _uneven_mass_cause(profile: DeviationProfile, phrase: str) -> Cause:
    """Return the cause that the mass per length deviates with a profile along the beam."""

    def add_deviation(
        stated_deviations: BeamDeviations, unknowns: Sequence[float], _: Beam
    ) -> BeamDeviations:
        return replace(stated_deviations, density_deviations=((profile, unknowns[0]),))

    return Cause(
        "uneven mass",
        _START_POINTS_OF_BOTH_SIGNS,
        (-0.3,),
        (0.3,),
        add_deviation,
        _describe_deviation(phrase),
    )


def _uneven_stiffness_cause(profile: DeviationProfile, phrase: str) -> Cause:
    """Return the cause that the bending stiffness deviates with a profile along the beam."""

    def add_deviation(
        stated_deviations: BeamDeviations, unknowns: Sequence[float], _: Beam
    ) -> BeamDeviations:
        return replace(stated_deviations, stiffness_deviations=((profile, unknowns[0]),))

    return Cause(
        "uneven stiffness",
        _START_POINTS_OF_BOTH_SIGNS,
        (-0.3,),
        (0.3,),
        add_deviation,
        _describe_deviation(phrase),
    )


def _describe_deviation(phrase: str) -> Callable[[Sequence[float], Beam], tuple[float, str, str]]:
    """Return a function that returns size, unit and phrase of a deviation of density or stiffness.

    `phrase` is the text, with ``{}`` for the size in per cent.
    """
    return lambda unknowns, _: (
        unknowns[0],
        "1",
        phrase.format(f"{float(f'{100 * unknowns[0]:.2g}'):+g} %"),
    )


_START_POINTS_OF_BOTH_SIGNS: Final = ((-0.01,), (0.01,))
"""Start values of a relative deviation of either sign."""

CAUSES: Final = (
    Cause("tilt", ((-2.0,), (2.0,)), (-10.0,), (10.0,), _set_tilt, _describe_tilt),
    Cause(
        "tip mass",
        ((0.003,), (0.02,), (0.1,), (0.25,)),
        (0.0,),
        (1.0,),
        _set_tip_mass,
        _describe_tip_mass,
        lambda unknowns, plant: replace(plant, tip_mass_kg=_added_mass_kg(unknowns[0], plant.beam)),
    ),
    Cause(
        "lump",
        tuple((0.05 * index, 0.01) for index in range(3, 20, 2)),
        (0.02, 0.0),
        (0.99, 0.5),
        _add_point_mass,
        _describe_point_mass,
        special_case_names=("tip mass",),
    ),
    _uneven_mass_cause("taper", "a mass per length that changes by {} from root to tip"),
    _uneven_mass_cause("outer half", "an outer half with {} mass per length"),
    _uneven_mass_cause(
        "wave", "a mass per length with {} at both ends and the opposite in the middle"
    ),
    _uneven_stiffness_cause("taper", "a bending stiffness that changes by {} from root to tip"),
    _uneven_stiffness_cause("outer half", "an outer half with {} bending stiffness"),
    _uneven_stiffness_cause(
        "wave", "a bending stiffness with {} at both ends and the opposite in the middle"
    ),
    Cause(
        "elastic clamp",
        ((1e-4,), (1e-3,), (1e-2,)),
        (0.0,),
        (0.2,),
        _set_clamp_compliance,
        _describe_clamp,
        lambda unknowns, plant: replace(
            plant, root_compliance_rad_per_nm=_compliance_rad_per_nm(unknowns, plant.beam)
        ),
    ),
    Cause(
        "lossy clamp",
        tuple((size, loss) for size in (1e-4, 1e-3, 1e-2) for loss in (0.02, 0.1)),
        (0.0, 0.0),
        (0.2, 0.5),
        _set_clamp_compliance,
        _describe_clamp,
        special_case_names=("elastic clamp",),
    ),
    Cause(
        "torque filter of first order",
        ((0.2,), (0.6,), (2.0,)),
        (0.0,),
        (20.0,),
        lambda stated_deviations, unknowns, _: replace(
            stated_deviations, first_order_torque_lag_s=1e-3 * unknowns[0]
        ),
        _describe_first_order_filter,
        _plant_with_first_order_filter,
    ),
    Cause(
        "torque filter of second order",
        ((0.2,), (0.6,), (2.0,)),
        (0.0,),
        (10.0,),
        lambda stated_deviations, unknowns, _: replace(
            stated_deviations,
            second_order_torque_lag=(1e-3 * unknowns[0], _BUTTERWORTH_INVERSE_QUALITY),
        ),
        _describe_second_order_filter,
        _plant_with_second_order_filter,
    ),
    Cause(
        "sensor resonance",
        tuple((size, loss) for size in (0.3, 0.6, 1.0, 1.6) for loss in (0.05, 0.5)),
        (0.0, 0.0),
        (3.0, 2.0),
        lambda stated_deviations, unknowns, _: replace(
            stated_deviations, second_order_torque_lag=(1e-3 * unknowns[0], unknowns[1])
        ),
        _describe_resonance,
        special_case_names=("torque filter of second order",),
    ),
    Cause(
        RELAXATION_CAUSE,
        tuple(
            (math.log(time_s), strength)
            for time_s in (5e-4, 2e-3, 8e-3, 0.03, 0.1, 0.3)
            for strength in (0.003, 0.015, 0.08)
        ),
        (math.log(1e-4), 0.0),
        (math.log(3.0), 0.5),
        lambda stated_deviations, unknowns, _: replace(
            stated_deviations, relaxation_strength_and_time=(unknowns[1], math.exp(unknowns[0]))
        ),
        _describe_relaxation,
    ),
)
"""All causes that are fitted to the modes; a special case comes before its general cause."""
