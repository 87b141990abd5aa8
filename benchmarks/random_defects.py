"""Rigs with one defect of random kind and size, from a seed, and their records.

Three kinds of rig: uniform beams (controls), linear and constant ones that are not uniform, and
those that are not linear or change with time. See `defect_records` for the records.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from defect_records import (
    DENSITY_KG_PER_M,
    LENGTH_M,
    STIFFNESS_N_M2,
    DampingLaw,
    Defect,
    DefectRecord,
    NoiseSpectrum,
    TorqueChannel,
    clamp_loss_factor,
    clamp_stiffness,
    simulate,
)
from finite_element_beam import Complex, FiniteElementBeam, PointMass, Profile, Real
from numpy.random import Generator

AMPLITUDES_RAD = (0.0125, 0.025, 0.05)
DAMPING_LEVELS = (0.3, 0.7, 1.5, 3.0)

_GRAVITY_M_S2 = 9.81
_PIVOT_INTERNAL_RAD_S, _PIVOT_EXTERNAL_RAD_S = 100.0, 40.0
_ZETA_S, _GAMMA, _GAMMA_ORDER = 7.1e-5, 0.055, 0.594


def uniform(value: float) -> Profile:
    """Return a property that is the same along the beam."""
    return lambda x: np.full_like(np.asarray(x, dtype=float), value)


def scaled_sections(value: float, edges_m: Real, factors: Real) -> Profile:
    """Return a property with jumps."""
    return lambda x: value * factors[np.searchsorted(edges_m, x, side="right")]


def scaled_smoothly(value: float, waves: Real, cosines: Real, sines: Real) -> Profile:
    """Return a property that varies smoothly: a sum of few waves."""

    def profile(x: Real) -> Real:
        phase = np.multiply.outer(np.asarray(x) / LENGTH_M, np.pi * waves)
        found: Real = value * (1 + np.cos(phase) @ cosines + np.sin(phase) @ sines)
        return found

    return profile


def make_beam(damping: DampingLaw, **changed: object) -> FiniteElementBeam:
    """Return the stated beam with changed properties."""
    properties: dict[str, object] = {
        "length_m": LENGTH_M,
        "density_kg_per_m": uniform(DENSITY_KG_PER_M),
        "stiffness_n_m2": uniform(STIFFNESS_N_M2),
        "elastic": damping.elastic,
        "medium_n_s_per_m2": damping.medium,
    }
    return FiniteElementBeam(**(properties | changed))  # type: ignore[arg-type]


_UNEVEN = ("not uniform",)


def _integer_law(generator: Generator, level: float) -> DampingLaw:
    """Draw damping of type III: both orders are 1."""
    zeta = level * _ZETA_S * np.exp(generator.normal(scale=0.2))
    gamma = level * 0.012 * np.exp(generator.normal(scale=0.3))
    return DampingLaw(float(zeta), 1.0, float(gamma), 1.0)


def _law(generator: Generator, level: float) -> DampingLaw:
    """Draw damping of type III or VI, with the losses of the paper's link times a level."""
    if generator.random() < 0.25:
        return _integer_law(generator, level)
    alpha, order = generator.uniform(0.7, 1.15), generator.uniform(0.4, 1.05)
    pivot, air = _PIVOT_INTERNAL_RAD_S, _PIVOT_EXTERNAL_RAD_S
    loss = level * _ZETA_S * pivot * np.exp(generator.normal(scale=0.2))
    zeta = loss / (pivot**alpha * np.sin(alpha * np.pi / 2))
    force = level * _GAMMA * air**_GAMMA_ORDER * np.sin(_GAMMA_ORDER * np.pi / 2)
    force *= np.exp(generator.normal(scale=0.3))
    gamma = force / (air**order * np.sin(order * np.pi / 2))
    return DampingLaw(float(zeta), float(alpha), float(gamma), float(order))


def _of_integer_order(law: DampingLaw) -> DampingLaw:
    """Return the law of orders 1 with the same losses at the pivots."""
    internal = law.elastic(1j * np.array([_PIVOT_INTERNAL_RAD_S]))[0].imag
    external = law.medium(1j * np.array([_PIVOT_EXTERNAL_RAD_S]))[0].imag / STIFFNESS_N_M2
    zeta, gamma = internal / _PIVOT_INTERNAL_RAD_S, external / _PIVOT_EXTERNAL_RAD_S
    return DampingLaw(float(zeta), 1.0, float(gamma), 1.0)


def _slopes(law: DampingLaw) -> tuple[float, float]:
    """Return the slopes, lowest and highest, of the material's loss from 2.5 to 45 Hz."""
    omega = np.geomspace(2 * np.pi * 2.5, 2 * np.pi * 45, 200)
    slope = np.gradient(np.log(law.elastic(1j * omega).imag), np.log(omega))
    return float(slope.min()), float(slope.max())


def _signed(generator: Generator, low: float, high: float) -> float:
    """Draw a size between two limits, log-uniformly, of either sign."""
    return _size(generator, low, high) * (1 if generator.random() < 0.5 else -1)


def _size(generator: Generator, low: float, high: float) -> float:
    return float(np.exp(generator.uniform(np.log(low), np.log(high))))


def _sections(generator: Generator, size: float) -> tuple[Real, Real]:
    """Draw one to three jumps, and the factors between them."""
    edges = np.sort(generator.uniform(0.1, 0.9, generator.integers(1, 4))) * LENGTH_M
    factors = 1 + size * generator.uniform(-1, 1, edges.size + 1)
    factors[generator.integers(edges.size + 1)] = 1 + size
    return edges, factors


def _wander(generator: Generator, value: float, size: float) -> Profile:
    waves = np.arange(1, 6, dtype=float)
    cosines, sines = generator.normal(size=(2, 5)) / waves
    deviation = np.sqrt(np.sum(cosines**2 + sines**2) / 2)
    return scaled_smoothly(value, waves, cosines * size / deviation, sines * size / deviation)


def _none(generator: Generator, law: DampingLaw) -> Defect:
    channel = TorqueChannel(
        delay_s=float(generator.uniform(0.0, 1e-3)),
        tool_inertia_kg_m2=float(generator.choice([0.0, generator.uniform(0.0, 3e-5)])),
    )
    size = {"delay_s": channel.delay_s, "tool_inertia_kg_m2": channel.tool_inertia_kg_m2}
    return Defect("none", size, True, law, make_beam(law), channel)


def _mass_sections(generator: Generator, law: DampingLaw) -> Defect:
    size = _signed(generator, 0.003, 0.08)
    edges, factors = _sections(generator, size)
    density = scaled_sections(DENSITY_KG_PER_M, edges, factors)
    beam = make_beam(law, density_kg_per_m=density, jumps_m=tuple(edges))
    drawn = {"edges_m": edges.tolist(), "factors": factors.tolist()}
    return Defect("mass, sections", drawn, True, law, beam, effects=_UNEVEN)


def _mass_smooth(generator: Generator, law: DampingLaw) -> Defect:
    size = _size(generator, 0.003, 0.05)
    beam = make_beam(law, density_kg_per_m=_wander(generator, DENSITY_KG_PER_M, size))
    return Defect("mass, smooth", {"relative_std": size}, True, law, beam, effects=_UNEVEN)


def _stiffness_sections(generator: Generator, law: DampingLaw) -> Defect:
    size = _signed(generator, 0.003, 0.08)
    edges, factors = _sections(generator, size)
    stiffness = scaled_sections(STIFFNESS_N_M2, edges, factors)
    beam = make_beam(law, stiffness_n_m2=stiffness, jumps_m=tuple(edges))
    drawn = {"edges_m": edges.tolist(), "factors": factors.tolist()}
    return Defect("stiffness, sections", drawn, True, law, beam, effects=_UNEVEN)


def _stiffness_smooth(generator: Generator, law: DampingLaw) -> Defect:
    size = _size(generator, 0.003, 0.05)
    beam = make_beam(law, stiffness_n_m2=_wander(generator, STIFFNESS_N_M2, size))
    return Defect("stiffness, smooth", {"relative_std": size}, True, law, beam, effects=_UNEVEN)


def _taper(generator: Generator, law: DampingLaw) -> Defect:
    """Draw a linear taper of width (stiffness by its first power) or thickness (its third)."""
    size, power = _signed(generator, 0.003, 0.06), int(generator.choice([1, 3]))

    def width(x: Real) -> Real:
        return 1 + size * (0.5 - np.asarray(x) / LENGTH_M)

    beam = make_beam(
        law,
        density_kg_per_m=lambda x: DENSITY_KG_PER_M * width(x),
        stiffness_n_m2=lambda x: STIFFNESS_N_M2 * width(x) ** power,
    )
    return Defect("taper", {"taper": size, "power": power}, True, law, beam, effects=_UNEVEN)


def _lumps(generator: Generator, law: DampingLaw) -> Defect:
    lumps = tuple(
        PointMass(float(generator.uniform(0.15, 0.97)) * LENGTH_M, _size(generator, 1e-5, 3e-4))
        for _ in range(generator.integers(1, 4))
    )
    size = {"lumps": [[lump.position_m, lump.mass_kg] for lump in lumps]}
    return Defect("lump", size, True, law, make_beam(law, masses=lumps), effects=(*_UNEVEN, "lump"))


def _tip_mass(generator: Generator, law: DampingLaw) -> Defect:
    mass = _size(generator, 1e-5, 1e-3)
    beam = make_beam(law, masses=(PointMass(LENGTH_M, mass),))
    return Defect("tip mass", {"mass_kg": mass}, True, law, beam, effects=("tip mass",))


def _glue(generator: Generator, law: DampingLaw) -> Defect:
    """Draw a fillet at the root, stiffer and heavier towards the hub, with its own loss."""
    length = float(generator.uniform(0.005, 0.05))
    stiffer, heavier = _size(generator, 0.05, 2.0), _size(generator, 0.05, 2.0)
    loss = _size(generator, 0.005, 0.1)

    def fillet(x: Real) -> Real:
        return np.maximum(1 - np.asarray(x) / length, 0.0)

    def elastic(s: Complex) -> Complex:
        # Loss nearly independent of frequency over the sweep.
        found: Complex = law.elastic(s) * (1 + loss * (s / 100.0) ** 0.2 / np.sin(0.1 * np.pi))
        return found

    beam = make_beam(
        law,
        density_kg_per_m=lambda x: DENSITY_KG_PER_M * (1 + heavier * fillet(x)),
        patches=((lambda x: STIFFNESS_N_M2 * stiffer * fillet(x), elastic),),
        jumps_m=(length,),
    )
    size = {"length_m": length, "stiffer": stiffer, "heavier": heavier, "loss": loss}
    slopes = (0.2, law.alpha or 0.0)
    return Defect("glue", size, True, law, beam, alpha_range=slopes, effects=(*_UNEVEN, "glue"))


def _tilt(generator: Generator, law: DampingLaw) -> Defect:
    degrees, direction = _size(generator, 0.3, 5.0), float(generator.uniform(0, 2 * np.pi))
    inclined = _GRAVITY_M_S2 * np.sin(np.radians(degrees))
    beam = make_beam(law, gravity_m_s2=float(inclined * np.cos(direction)))
    constant = -float(inclined * np.sin(direction)) * beam.mass_moment_kg_m
    size = {"degrees": degrees, "direction_rad": direction}
    effects = (*_UNEVEN, "tilt")
    return Defect("tilt", size, True, law, beam, effects=effects, constant_nm=constant)


def _relaxations(generator: Generator, law: DampingLaw) -> Defect:
    """Draw standard linear solids instead of a fractional order."""
    count = int(generator.integers(1, 5))
    times = np.exp(generator.uniform(np.log(5e-4), np.log(0.5), count))
    strengths = generator.uniform(0.3, 1.7, count)
    # Their loss at 100 rad/s is that of the replaced law, within limits.
    turns = _PIVOT_INTERNAL_RAD_S * times
    loss = float(strengths @ (turns / (1 + turns**2)))
    pivot = 1j * np.array([_PIVOT_INTERNAL_RAD_S])
    strengths = np.minimum(strengths * law.elastic(pivot)[0].imag / loss, 0.2)
    relaxed = DampingLaw(
        None,
        None,
        law.gamma,
        law.lambda_,
        tuple(zip(strengths.tolist(), times.tolist(), strict=True)),
    )
    size = {"relaxations": [list(pair) for pair in relaxed.relaxations]}
    return Defect(
        "relaxations",
        size,
        True,
        relaxed,
        make_beam(relaxed),
        alpha_range=_slopes(relaxed),
        effects=("relaxations",),
    )


def _clamp(generator: Generator, law: DampingLaw) -> Defect:
    stiffness, loss = _size(generator, 10.0, 1000.0), float(generator.uniform(0.0, 0.15))

    def spring(s: Complex) -> Complex:
        return clamp_stiffness((stiffness, loss), s)

    omega = 2 * np.pi * np.geomspace(2.5, 45.0, 200)
    lost = law.elastic(1j * omega).imag + clamp_loss_factor((stiffness, loss), omega)
    slope = np.gradient(np.log(lost), np.log(omega))
    slopes = float(min(slope.min(), law.alpha)), float(max(slope.max(), law.alpha))
    return Defect(
        "clamp",
        {"root_nm_per_rad": stiffness, "loss": loss},
        True,
        law,
        make_beam(law, root_nm_per_rad=spring),
        alpha_range=slopes,
        clamp=(stiffness, loss),
        effects=("elastic clamp", "lossy clamp"),
    )


def _sensor_resonance(generator: Generator, law: DampingLaw) -> Defect:
    channel = TorqueChannel(
        resonance_hz=_size(generator, 100.0, 400.0), quality=_size(generator, 0.7, 50.0)
    )
    size = {"resonance_hz": channel.resonance_hz, "quality": channel.quality}
    effects = ("torque filter", "sensor resonance", "delay")
    return Defect("sensor resonance", size, True, law, make_beam(law), channel, effects=effects)


def _loss_patch(generator: Generator, law: DampingLaw) -> Defect:
    """Draw a tape: more loss, and somewhat more mass, over part of the beam."""
    start = float(generator.uniform(0.0, 0.8)) * LENGTH_M
    end = start + float(generator.uniform(0.05, 0.2)) * LENGTH_M
    loss, heavier = _size(generator, 0.002, 0.05), _size(generator, 1e-3, 0.03)

    def inside(x: Real) -> Real:
        return ((np.asarray(x) >= start) & (np.asarray(x) < end)).astype(float)

    beam = make_beam(
        law,
        density_kg_per_m=lambda x: DENSITY_KG_PER_M * (1 + heavier * inside(x)),
        patches=(
            (
                lambda x: STIFFNESS_N_M2 * inside(x),
                lambda s: loss * (s / 100.0) ** 0.3 / np.sin(0.15 * np.pi),
            ),
        ),
        jumps_m=(start, end),
    )
    size = {"start_m": start, "end_m": end, "loss": loss, "heavier": heavier}
    slopes = (min(0.3, law.alpha or 0.3), max(0.3, law.alpha or 0.3))
    return Defect("lossy patch", size, True, law, beam, alpha_range=slopes, effects=_UNEVEN)


def _both_uneven(generator: Generator, law: DampingLaw) -> Defect:
    mass, stiffness = _size(generator, 0.003, 0.03), _size(generator, 0.003, 0.03)
    beam = make_beam(
        law,
        density_kg_per_m=_wander(generator, DENSITY_KG_PER_M, mass),
        stiffness_n_m2=_wander(generator, STIFFNESS_N_M2, stiffness),
    )
    size = {"mass_relative_std": mass, "stiffness_relative_std": stiffness}
    return Defect("mass and stiffness", size, True, law, beam, effects=_UNEVEN)


def _step(generator: Generator, law: DampingLaw) -> Defect:
    """Draw a change of stiffness in time; the orders are 1, the state is position and speed."""
    law = _of_integer_order(law)
    at_s = float(generator.uniform(10.0, 115.0))
    change = _signed(generator, 1e-3, 5e-3)
    size = {"at_s": at_s, "relative_change": change}
    effects = ("step in time", "drifting stiffness")
    step = (at_s, change)
    return Defect("step in time", size, False, law, make_beam(law), effects=effects, step=step)


def _cubic(generator: Generator, law: DampingLaw) -> Defect:
    channel = TorqueChannel(cubic=_signed(generator, 2e-3, 5e-2))
    size = {"relative_at_peak": channel.cubic}
    effects = ("nonlinear gain", "harmonics")
    return Defect("cubic gain", size, False, law, make_beam(law), channel, effects=effects)


def _drag(generator: Generator, law: DampingLaw) -> Defect:
    law, diameter = _of_integer_order(law), _size(generator, 5e-5, 1e-3)
    size = {"diameter_m": diameter}
    effects = ("air drag", "nonlinear damping", "harmonics")
    return Defect("drag", size, False, law, make_beam(law), effects=effects, drag_m=diameter)


def _play(generator: Generator, law: DampingLaw) -> Defect:
    channel = TorqueChannel(play_rad=_size(generator, 5e-5, 1e-3))
    size = {"play_rad": channel.play_rad}
    effects = ("play", "harmonics")
    return Defect("play", size, False, law, make_beam(law), channel, effects=effects)


def _friction(generator: Generator, law: DampingLaw) -> Defect:
    channel = TorqueChannel(
        friction_nm=_size(generator, 1e-3, 3e-2), friction_speed_rad_s=_size(generator, 2e-3, 0.05)
    )
    size = {
        "friction_nm": channel.friction_nm,
        "friction_speed_rad_s": channel.friction_speed_rad_s,
    }
    effects = ("friction", "harmonics")
    return Defect("friction", size, False, law, make_beam(law), channel, effects=effects)


Draw = Callable[[Generator, DampingLaw], Defect]
CONTROL: dict[str, Draw] = {"none": _none}
LINEAR: dict[str, Draw] = {
    "mass, sections": _mass_sections,
    "mass, smooth": _mass_smooth,
    "stiffness, sections": _stiffness_sections,
    "stiffness, smooth": _stiffness_smooth,
    "mass and stiffness": _both_uneven,
    "taper": _taper,
    "lump": _lumps,
    "tip mass": _tip_mass,
    "glue": _glue,
    "tilt": _tilt,
    "relaxations": _relaxations,
    "clamp": _clamp,
    "sensor resonance": _sensor_resonance,
    "lossy patch": _loss_patch,
}
OTHER: dict[str, Draw] = {
    "step in time": _step,
    "cubic gain": _cubic,
    "drag": _drag,
    "play": _play,
    "friction": _friction,
}
KINDS = CONTROL | LINEAR | OTHER


def draw_defect(seed: int, kind: str | None = None) -> tuple[Defect, float, float, NoiseSpectrum]:
    """Draw a rig (of a kind, if given), the amplitude, the level of damping and the noise."""
    generator = np.random.Generator(np.random.SFC64([seed, 1]))
    drawn_kind = _drawn_kind(generator)
    level = float(generator.choice(DAMPING_LEVELS))
    amplitude = float(generator.choice(AMPLITUDES_RAD))
    noise = _noise(generator)
    law = _law(generator, level)
    return KINDS[kind or drawn_kind](generator, law), amplitude, level, noise


def draw(seed: int, kind: str | None = None) -> DefectRecord:
    """Draw a rig and make its record."""
    defect, amplitude, level, noise = draw_defect(seed, kind)
    return simulate(seed, defect, amplitude, level, noise)


def _drawn_kind(generator: Generator) -> str:
    """Draw a kind: 1/6 controls, 2/3 linear constant defects, 1/6 others."""
    group = (CONTROL, LINEAR, LINEAR, LINEAR, LINEAR, OTHER)[generator.integers(6)]
    return list(group)[generator.integers(len(group))]


def _noise(generator: Generator) -> NoiseSpectrum:
    """Draw noise: white in half of the records, else with a 1/f part, bumps, or both."""
    if generator.random() < 0.5:
        return NoiseSpectrum()
    which = generator.integers(3)
    corner_hz = _size(generator, 0.3, 30.0) if which != 1 else 0.0
    bumps = tuple(
        (_size(generator, 2.0, 60.0), _size(generator, 0.02, 0.3), _size(generator, 1.0, 15.0))
        for _ in range(generator.integers(1, 3) if which != 0 else 0)
    )
    return NoiseSpectrum(corner_hz=corner_hz, bumps=bumps)


def heavier_half() -> Defect:
    """Return the rig whose beam is 3 % heavier in its outer half."""
    law, middle = DampingLaw(7.1e-5, 0.996, 0.055, 0.594), LENGTH_M / 2
    density = scaled_sections(DENSITY_KG_PER_M, np.array([middle]), np.array([1.0, 1.03]))
    beam = make_beam(law, density_kg_per_m=density, jumps_m=(middle,))
    return Defect("mass, sections", {"outer_half": 1.03}, True, law, beam, effects=_UNEVEN)


def tilted_axis() -> Defect:
    """Return the rig whose beam hangs from an axis 2 degrees off the vertical."""
    law = DampingLaw(7.1e-5, 0.92, 0.055, 0.55)
    beam = make_beam(law, gravity_m_s2=_GRAVITY_M_S2 * float(np.sin(np.radians(2))))
    return Defect("tilt", {"degrees": 2.0}, True, law, beam, effects=(*_UNEVEN, "tilt"))
