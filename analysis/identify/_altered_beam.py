"""Modes of a beam that is nearly the plain uniform one: tilted, loaded, uneven or softly clamped.

By Galerkin's method in the first modes of the uniform beam, which turns with the clamp as it does.
Relative to the stiffness of the beam, mode k then solves ``D(s) = 0``::

    D = c K + (1 + j eta) C + rho/EI s² M + gamma s^lambda I + rho/EI g T,    c = 1 + zeta s^alpha

with numbers K (stiffness), C (of the clamp), M (mass), I (medium) and T (tension by gravity) that
its shape gives, and the residue of the torque includes its arms about the motor axis. The plain
beam has ``K = k⁴``, ``M = I = 1``, ``C = T = 0``. The effect of damping on a shape is of the order
of the damping times the alteration: it moves poles by the square, and the arms to first order.

A local compliance adds to the flexibility, not to the stiffness: the moment
along a clamped-free beam follows from its loads alone, so few modes suffice there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from rigd.beam import clamped_free_eigenvalues, mode_shape

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from analysis.identify._plant import Plant
    from rigd.beam import Beam

GRAVITY_M_S2: Final = 9.81
_BASIS: Final = 14
_NEXT: Final = float(clamped_free_eigenvalues(_BASIS + 1)[-1])
_NODES_OF_HALF: Final = 32
_STEP: Final = 1e-5
"""For slopes of shapes: exact to 1e-8 of them."""

_ITERATIONS: Final = 2
_APART: Final = 1e-7
"""Relative distance of the shift of inverse iterations from the eigenvalue."""

Terms = NDArray[np.inexact[Any]]
Profile = Literal["taper", "outer half", "wave"]
"""Deviation along the beam: from -1/2 to 1/2; 0 and 1; a cosine of one period."""


@dataclass(frozen=True, slots=True)
class Alteration:
    """Deviations of a rig from a plain uniform beam on a rigid clamp.

    Attributes
    ----------
    lumps : tuple of (float, float)
        Position relative to the length, and mass in kg.
    gravity_m_s2 : float
        Component along the beam at rest, positive towards the tip.
    density, stiffness : tuple of (str, float)
        Profile and size of a relative deviation of the mass per length, of the bending stiffness.
    clamp_compliance : float
        Compliance of the clamp, times EI over the length.
    clamp_loss : float
        Loss factor of the clamp.
    relaxation : tuple of (float, float)
        Strength and time constant (s): the stiffness gains ``strength s t / (1 + s t)``.
    sensor : tuple of (float, float)
        Reciprocal of the undamped frequency (s) and of the quality of a second-order lag in the
        torque's channel.
    lag_s : float
        Time constant of a first-order lag there.
    """

    lumps: tuple[tuple[float, float], ...] = ()
    gravity_m_s2: float = 0.0
    density: tuple[tuple[Profile, float], ...] = ()
    stiffness: tuple[tuple[Profile, float], ...] = ()
    clamp_compliance: float = 0.0
    clamp_loss: float = 0.0
    relaxation: tuple[float, float] = (0.0, 1.0)
    sensor: tuple[float, float] = (0.0, 0.0)
    lag_s: float = 0.0

    @classmethod
    def stated(cls, nominal: Plant, tilt_deg: float | None = None) -> Alteration:
        """Return the alterations that the file states: the mass at the tip and the inclination.

        Parameters
        ----------
        nominal : Plant
        tilt_deg : float, optional
            Inclination of the plane of motion along the beam at rest, positive where the tip is
            lower than the motor's axis.
        """
        mass_kg = nominal.tip_mass_kg
        return cls(
            lumps=((1.0, mass_kg),) if mass_kg else (),
            gravity_m_s2=GRAVITY_M_S2 * math.sin(math.radians(tilt_deg or 0.0)),
        )

    def same_shapes(self, other: Alteration) -> bool:
        """Return whether another alteration changes the mode shapes in the same way."""
        return self == replace(
            other, relaxation=self.relaxation, sensor=self.sensor, lag_s=self.lag_s
        )

    def channel(self, s: NDArray[np.complex128]) -> NDArray[np.complex128] | float:
        """Return the factor by which the lags of the torque channel multiply a torque."""
        time_s, over_quality = self.sensor
        through: NDArray[np.complex128] | float = 1.0
        if time_s:
            q = s * time_s
            through = 1 / (1 + over_quality * q + q * q)
        return through / (1 + self.lag_s * s) if self.lag_s else through


@dataclass(frozen=True, slots=True)
class ModeTerms:
    """Galerkin coefficients of some modes of an altered beam, each of shape (n,); see the module.

    Attributes
    ----------
    stiffness, clamp, mass, lump, tension : ndarray, shape (n,)
        Over the length to the fourth power, or the third and g times it, where D has that; the
        lumps' part of the mass is that of a beam of the density `density_kg_per_m`, and of any
        beam in proportion to it where that is None.
    mass_arm, lump_arm, medium_arm, tension_arm : ndarray, shape (n,)
        About the motor's axis, over the length; complex where the clamp has a loss.
    turn_by_medium, turn_by_internal : ndarray, shape (n,)
        Contributions of ``gamma s^lambda`` and ``zeta s^alpha`` to the arm of the mass, by their
        change of the shape.
    density_kg_per_m : float or None
    alteration : Alteration
    """

    stiffness: Terms
    clamp: Terms
    mass: Terms
    lump: Terms
    tension: Terms
    mass_arm: Terms
    lump_arm: Terms
    medium_arm: Terms
    tension_arm: Terms
    turn_by_medium: Terms
    turn_by_internal: Terms
    density_kg_per_m: float | None
    alteration: Alteration


@dataclass(frozen=True, slots=True)
class _Basis:
    """First modes of the uniform beam at the nodes of a quadrature, and their integrals."""

    z: NDArray[np.float64]
    x: NDArray[np.float64]
    weights: NDArray[np.float64]
    shapes: NDArray[np.float64]
    slopes: NDArray[np.float64]
    curvatures: NDArray[np.float64]
    arms: NDArray[np.float64]
    arms_of_tension: NDArray[np.float64]
    tension: NDArray[np.float64]

    def weighted(
        self, rows: NDArray[np.float64], profile: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return integrals of products of rows, weighted by a profile, shape (N, N)."""
        found: NDArray[np.float64] = (rows * (self.weights * profile)) @ rows.T
        return found

    def deviation(self, parts: Sequence[tuple[Profile, float]]) -> NDArray[np.float64]:
        """Return the relative deviation at the nodes."""
        total = np.zeros(self.x.size)
        for profile, size in parts:
            total += size * _PROFILES[profile](self.x)
        return total


_PROFILES: Final[dict[Profile, Callable[[NDArray[np.float64]], NDArray[np.float64]]]] = {
    "taper": lambda x: x - 0.5,
    "outer half": lambda x: np.where(x > 0.5, 1.0, 0.0),
    "wave": lambda x: np.cos(2 * np.pi * x),
}


def _at(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the basis shapes at positions along the beam, (N, …)."""
    return np.array([mode_shape(number, x) for number in range(1, _BASIS + 1)])


@lru_cache(maxsize=32)
def _at_lump(position: float) -> NDArray[np.float64]:
    """Return the basis shapes at one position, (N,); the array is read-only."""
    return _at(np.array(position))


@lru_cache(maxsize=1)
def _basis() -> _Basis:
    """Return the basis; it is computed once."""
    nodes, weights = np.polynomial.legendre.leggauss(_NODES_OF_HALF)
    x = np.concatenate([0.25 * (nodes + 1), 0.25 * (nodes + 3)])
    weights = np.tile(weights / 4, 2)
    z = clamped_free_eigenvalues(_BASIS)
    sign = (-1.0) ** np.arange(_BASIS)
    shapes, slopes = _at(x), (_at(x + _STEP) - _at(x - _STEP)) / (2 * _STEP)
    return _Basis(
        z=z,
        x=x,
        weights=weights,
        shapes=shapes,
        slopes=slopes,
        # A clamped-free mode seen from its tip is the moment of a clamped-free mode.
        curvatures=(sign * z**2)[:, None] * _at(1 - x),
        arms=2 * sign / z**2,
        arms_of_tension=slopes @ (weights * (1 - x)),
        tension=(slopes * (weights * (1 - x))) @ slopes.T,
    )


@lru_cache(maxsize=16)
def mode_terms(alteration: Alteration, beam: Beam, modes: tuple[int, ...]) -> ModeTerms:
    """Return the Galerkin coefficients of some modes of a beam that is altered."""
    basis = _basis()
    length, indices = beam.length_m, np.array(modes) - 1
    count = len(alteration.lumps)

    def padded(array: NDArray[np.float64], value: float = 0.0) -> NDArray[np.float64]:
        if not count:
            return array
        found = np.zeros((_BASIS + count,) * array.ndim)
        found[(slice(_BASIS),) * array.ndim] = array
        beyond = range(_BASIS, _BASIS + count)
        found[(beyond,) * array.ndim] = value
        return found

    heavier = basis.deviation(alteration.density)
    mass = padded(np.eye(_BASIS) + basis.weighted(basis.shapes, heavier), 1.0)
    mass_arm = padded(basis.arms + basis.shapes @ (basis.weights * heavier * basis.x))
    lump, lump_arm = np.zeros_like(mass), np.zeros_like(mass_arm)
    tension, tension_arm = padded(basis.tension), padded(basis.arms_of_tension)
    for index, (position, mass_kg) in enumerate(alteration.lumps, start=_BASIS):
        fraction, shape = (
            mass_kg / (beam.density_kg_per_m * length),
            padded(_at_lump(position).copy()),
        )
        # All modes beyond the basis give way to a lump as one spring, and move as one mode.
        beyond = position**3 / 3 - float(np.sum((shape[:_BASIS] / basis.z**2) ** 2))
        shape[index] = math.sqrt(max(beyond, 0.0)) * _NEXT**2
        lump += fraction * np.outer(shape, shape)
        lump_arm += fraction * position * shape
        if alteration.gravity_m_s2:
            inside = np.where(basis.x < position, fraction, 0.0)
            tension = tension + padded(basis.weighted(basis.slopes, inside))
            tension_arm = tension_arm + fraction * shape
    # Flexibility to loads of the basis' shapes: of the beam, of the clamp
    moments = basis.curvatures / basis.z[:, None] ** 4
    softer = 1 / (1 + basis.deviation(alteration.stiffness))
    bends = padded(basis.weighted(moments, softer), _NEXT**-4.0)
    at_root = padded(2 * (-1.0) ** np.arange(_BASIS) / basis.z**2)
    turns: Terms = alteration.clamp_compliance * np.outer(at_root, at_root)
    elastic: Terms = np.linalg.inv(bends + turns)
    pull = alteration.gravity_m_s2 * beam.density_over_stiffness * length**3
    # Largest 1 / omega²: the lowest modes are the most exact
    lower = np.linalg.inv(np.linalg.cholesky(elastic + pull * tension))
    inverse, vectors = np.linalg.eigh(lower @ (mass + lump) @ lower.T)
    inverse, vectors = inverse[::-1], vectors[:, ::-1]
    every = lower.T @ vectors / np.sqrt(inverse)  # of modal mass 1
    shapes: Terms = every[:, indices]
    if alteration.clamp_loss:
        turns = turns / (1 + 1j * alteration.clamp_loss)
        elastic = np.linalg.inv(bends + turns)
        shapes = _complex_shapes(elastic + pull * tension, mass + lump, shapes)
    loads = elastic @ shapes
    size = np.sum(shapes * shapes, axis=0)
    # What the losses change in the shapes, to first order, turns the residues a little.
    separation = 1 / inverse[indices] - 1 / inverse[:, None]
    separation[indices, np.arange(indices.size)] = np.inf
    arms = (mass_arm + lump_arm) @ every
    medium = arms @ ((every.T @ shapes) / separation)
    internal = arms @ (((elastic @ every).T @ bends @ loads) / separation)

    def of_shapes(matrix: NDArray[np.float64]) -> Terms:
        found: Terms = np.sum(shapes * (matrix @ shapes), axis=0) / size
        return found

    root = np.sqrt(size)
    gravity = alteration.gravity_m_s2 / length
    return ModeTerms(
        stiffness=np.sum(loads * (bends @ loads), axis=0) / size / length**4,
        clamp=np.sum(loads * (turns @ loads), axis=0) / size / length**4,
        mass=of_shapes(mass),
        lump=of_shapes(lump),
        tension=gravity * of_shapes(tension),
        mass_arm=mass_arm @ shapes / root,
        lump_arm=lump_arm @ shapes / root,
        medium_arm=padded(basis.arms) @ shapes / root,
        tension_arm=gravity * (tension_arm @ shapes) / root,
        turn_by_medium=medium / root * length**4,
        turn_by_internal=internal / root,
        density_kg_per_m=beam.density_kg_per_m,
        alteration=alteration,
    )


def _complex_shapes(
    elastic: Terms, mass: NDArray[np.float64], shapes: Terms
) -> NDArray[np.complex128]:
    """Return the shapes with a lossy clamp, (N, n), by inverse iteration from the lossless ones."""
    found = shapes.astype(np.complex128)
    for mode in found.T:
        for _ in range(_ITERATIONS):
            square = (mode @ elastic @ mode) / (mode @ mass @ mode)
            following = np.linalg.solve(elastic - square * (1 + _APART) * mass, mass @ mode)
            mode[:] = following / np.sqrt(following @ mass @ following)
    return found
