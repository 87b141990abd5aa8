"""Modes of a beam that deviates slightly from a uniform one: tilted, loaded, uneven or softly held.

They are computed by Galerkin's method with the first modes of the uniform beam as basis; the basis
turns with the clamp. Relative to the stiffness of the beam, mode k then solves ``D(s) = 0``::

    D = c K + (1 + j eta) C + rho/EI s² M + gamma s^lambda I + rho/EI g T,    c = 1 + zeta s^alpha

The coefficients K (stiffness), C (clamp), M (mass), I (external damping) and T (tension by gravity)
follow from the mode shape. The residue of the torque includes the arms of these forces about the
motor axis. The uniform beam has ``K = k⁴``, ``M = I = 1``, ``C = T = 0``. Damping changes a mode
shape by about the product of the damping and the deviation from a uniform beam. The arms change in
proportion to this product, the poles in proportion to its square.

A local compliance adds to the flexibility of the beam, not to its stiffness. The moment along a
clamped-free beam follows from its loads alone, so few modes suffice.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from rigd.beam import clamped_free_eigenvalues, mode_shape

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from rigd.beam import Beam, Plant

GRAVITY_M_S2: Final = 9.81
"""Acceleration of gravity, in m/s²."""

_BASIS_MODE_COUNT: Final = 14
"""Number of modes of the uniform beam in the basis."""

_NEXT_EIGENVALUE: Final = float(clamped_free_eigenvalues(_BASIS_MODE_COUNT + 1)[-1])
"""Eigenvalue k L of the first mode of the uniform beam that is not in the basis."""

_QUADRATURE_POINTS_PER_HALF: Final = 32
"""Number of quadrature points in each half of the beam."""

_SLOPE_STEP: Final = 1e-5
"""Step of the relative position for numerical slopes of mode shapes, which are exact to a relative
error of 1e-8."""

_INVERSE_ITERATIONS: Final = 2
"""Number of inverse iterations for a mode shape with a lossy clamp."""

_RELATIVE_SHIFT: Final = 1e-7
"""Shift of an inverse iteration relative to the eigenvalue: the matrix is not singular."""

CoefficientArray = NDArray[np.inexact[Any]]
"""Array of real or complex Galerkin coefficients."""

Profile = Literal["taper", "outer half", "wave"]
"""Shape of a relative deviation along the beam.

"taper" rises from -1/2 to 1/2, "outer half" is 0 in the inner and 1 in the outer half, and "wave"
is a cosine of one period."""


@dataclass(frozen=True, slots=True)
class Alteration:
    """Deviations of a rig from a uniform beam on a rigid clamp with an ideal torque channel.

    Attributes
    ----------
    lumps : tuple of (float, float)
        Added point masses: position relative to the length, and mass in kg.
    gravity_m_s2 : float
        Component of gravity along the beam at rest, positive towards the tip.
    density, stiffness : tuple of (str, float)
        Relative deviations of the mass per length and of the bending stiffness: profile and size.
    clamp_compliance : float
        Compliance of the clamp, times EI over the length.
    clamp_loss : float
        Loss factor of the clamp.
    relaxation : tuple of (float, float)
        Strength and time constant (s) of a relaxation of the material: the stiffness gains
        ``strength s t / (1 + s t)``.
    sensor_lag : tuple of (float, float)
        Second-order lag in the torque channel: reciprocal of its undamped frequency (s), and of its
        quality factor.
    lag_s : float
        Time constant of a first-order lag in the torque channel.
    """

    lumps: tuple[tuple[float, float], ...] = ()
    gravity_m_s2: float = 0.0
    density: tuple[tuple[Profile, float], ...] = ()
    stiffness: tuple[tuple[Profile, float], ...] = ()
    clamp_compliance: float = 0.0
    clamp_loss: float = 0.0
    relaxation: tuple[float, float] = (0.0, 1.0)
    sensor_lag: tuple[float, float] = (0.0, 0.0)
    lag_s: float = 0.0

    @classmethod
    def from_nominal(cls, nominal: Plant, tilt_deg: float | None = None) -> Alteration:
        """Return the alteration of the beam that the session file states: tip mass and tilt.

        Parameters
        ----------
        nominal : Plant
            Rig and specimen as the file states them.
        tilt_deg : float, optional
            Angle between the beam at rest and the horizontal, positive if the tip is lower than
            the root.
        """
        mass_kg = nominal.tip_mass_kg
        return cls(
            lumps=((1.0, mass_kg),) if mass_kg else (),
            gravity_m_s2=GRAVITY_M_S2 * math.sin(math.radians(tilt_deg or 0.0)),
        )

    def has_same_shapes(self, other_alteration: Alteration) -> bool:
        """Return whether two alterations of the beam result in the same mode shapes.

        They then differ at most in the relaxation of the material and in the lags of the torque
        channel, which do not affect the mode shapes.
        """
        return self == replace(
            other_alteration,
            relaxation=self.relaxation,
            sensor_lag=self.sensor_lag,
            lag_s=self.lag_s,
        )

    @property
    def lags(self) -> tuple[tuple[float, float], ...]:
        """Return the coefficients of s and s² in the denominator of each low-pass of the torque."""
        time_s, inverse_quality = self.sensor_lag
        lags = ((inverse_quality * time_s, time_s**2), (self.lag_s, 0.0))
        return tuple(lag for lag in lags if any(lag))


@dataclass(frozen=True, slots=True)
class ModeTerms:
    """Galerkin coefficients of n modes of an altered beam.

    The documentation of the module defines the dynamic stiffness D and its terms.

    Attributes
    ----------
    stiffness, clamp, mass, lump, tension : ndarray, shape (n,)
        Coefficients of D: ``K / L⁴``, ``C / L⁴``, M without the point masses, M of the point
        masses, and ``g T / L``, with the length L of the beam.
    mass_arm, lump_arm, medium_arm, tension_arm : ndarray, shape (n,)
        Arms of the forces of mass, point masses, external damping and tension about the motor's
        axis, divided by the length; complex if the clamp has a loss.
    arm_change_by_external, arm_change_by_internal : ndarray, shape (n,)
        Change of the arm of the mass per ``gamma s^lambda`` and per ``zeta s^alpha``, since damping
        changes the mode shape.
    density_kg_per_m : float or None
        Mass per length for which `lump` is valid. None if the point masses are constant fractions
        of the mass of the beam.
    alteration : Alteration
        Alteration of the beam.
    """

    stiffness: CoefficientArray
    clamp: CoefficientArray
    mass: CoefficientArray
    lump: CoefficientArray
    tension: CoefficientArray
    mass_arm: CoefficientArray
    lump_arm: CoefficientArray
    medium_arm: CoefficientArray
    tension_arm: CoefficientArray
    arm_change_by_external: CoefficientArray
    arm_change_by_internal: CoefficientArray
    density_kg_per_m: float | None
    alteration: Alteration

    def coefficients_by_mode(self) -> Iterable[tuple[complex, ...]]:
        """Return one tuple of coefficients for each mode, in the order of the attributes."""
        return zip(*(terms.tolist() for terms in _coefficient_arrays(self)), strict=True)


_coefficient_arrays: Final = attrgetter(*(field.name for field in fields(ModeTerms)[:-2]))
"""Function that returns the coefficients of `ModeTerms`: all attributes that are arrays."""


@dataclass(frozen=True, slots=True)
class _Basis:
    """First N modes of the uniform beam at quadrature points, and integrals over their shapes.

    `z` are the eigenvalues k L, and `x` the quadrature points, as positions relative to the length,
    with their `weights`. `shapes`, `slopes` and `curvatures` have the shape (N, points). `arms` are
    the integrals of ``shape x`` and `arms_of_tension` those of ``slope (1 - x)``, both of shape
    (N,). `tension` are the integrals of ``slope_i slope_j (1 - x)``, shape (N, N).
    """

    z: NDArray[np.float64]
    x: NDArray[np.float64]
    weights: NDArray[np.float64]
    shapes: NDArray[np.float64]
    slopes: NDArray[np.float64]
    curvatures: NDArray[np.float64]
    arms: NDArray[np.float64]
    arms_of_tension: NDArray[np.float64]
    tension: NDArray[np.float64]

    def weighted_products(
        self, rows: NDArray[np.float64], profile: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the integrals over the beam of all pairwise products of N functions, shape (N, N).

        `rows` are the values of the N functions at the quadrature points. Each product is weighted
        by `profile`, the values of another function at these points.
        """
        integrals: NDArray[np.float64] = (rows * (self.weights * profile)) @ rows.T
        return integrals

    def deviation(self, deviations: Sequence[tuple[Profile, float]]) -> NDArray[np.float64]:
        """Return the total relative deviation of density or stiffness at the quadrature points.

        It is the sum of `deviations`, each given by its profile along the beam and its size. The
        shape is (points,).
        """
        total_deviation = np.zeros(self.x.size)
        for profile, size in deviations:
            total_deviation += size * _PROFILE_FUNCTIONS[profile](self.x)
        return total_deviation


_PROFILE_FUNCTIONS: Final[dict[Profile, Callable[[NDArray[np.float64]], NDArray[np.float64]]]] = {
    "taper": lambda x: x - 0.5,
    "outer half": lambda x: np.where(x > 0.5, 1.0, 0.0),
    "wave": lambda x: np.cos(2 * np.pi * x),
}
"""Deviation as a function of the relative position along the beam, for each profile."""


def _basis_shapes(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the shapes of the N basis modes at positions relative to the length, (N, …)."""
    return np.array([mode_shape(mode_number, x) for mode_number in range(1, _BASIS_MODE_COUNT + 1)])


@lru_cache(maxsize=32)
def _basis_shapes_at_lump(position: float) -> NDArray[np.float64]:
    """Return the basis modes' deflections at one position relative to the length, shape (N,).

    The array is cached and must not be changed.
    """
    return _basis_shapes(np.array(position))


@lru_cache(maxsize=1)
def _basis() -> _Basis:
    """Return the cached basis: the first modes of the uniform beam, with their integrals."""
    quadrature_nodes, weights = np.polynomial.legendre.leggauss(_QUADRATURE_POINTS_PER_HALF)
    x = np.concatenate([0.25 * (quadrature_nodes + 1), 0.25 * (quadrature_nodes + 3)])
    weights = np.tile(weights / 4, 2)
    z = clamped_free_eigenvalues(_BASIS_MODE_COUNT)
    signs = (-1.0) ** np.arange(_BASIS_MODE_COUNT)
    shapes, slopes = (
        _basis_shapes(x),
        (_basis_shapes(x + _SLOPE_STEP) - _basis_shapes(x - _SLOPE_STEP)) / (2 * _SLOPE_STEP),
    )
    return _Basis(
        z=z,
        x=x,
        weights=weights,
        shapes=shapes,
        slopes=slopes,
        # The moment of a clamped-free mode is the shape of a clamped-free mode seen from its tip.
        curvatures=(signs * z**2)[:, None] * _basis_shapes(1 - x),
        arms=2 * signs / z**2,
        arms_of_tension=slopes @ (weights * (1 - x)),
        tension=(slopes * (weights * (1 - x))) @ slopes.T,
    )


@lru_cache(maxsize=16)
def galerkin_mode_terms(alteration: Alteration, beam: Beam, modes: tuple[int, ...]) -> ModeTerms:
    """Return the Galerkin coefficients of the given modes of an altered beam.

    `modes` are mode numbers, from 1. For each point mass one mode is added to the basis. It
    represents all higher modes.
    """
    basis = _basis()
    length_m, mode_indices = beam.length_m, np.array(modes) - 1
    lump_count = len(alteration.lumps)

    def with_lump_modes(
        uniform_beam_array: NDArray[np.float64], diagonal_value: float = 0.0
    ) -> NDArray[np.float64]:
        if not lump_count:
            return uniform_beam_array
        extended_array = np.zeros((_BASIS_MODE_COUNT + lump_count,) * uniform_beam_array.ndim)
        extended_array[(slice(_BASIS_MODE_COUNT),) * uniform_beam_array.ndim] = uniform_beam_array
        lump_indices = range(_BASIS_MODE_COUNT, _BASIS_MODE_COUNT + lump_count)
        extended_array[(lump_indices,) * uniform_beam_array.ndim] = diagonal_value
        return extended_array

    density_deviation = basis.deviation(alteration.density)
    mass = with_lump_modes(
        np.eye(_BASIS_MODE_COUNT) + basis.weighted_products(basis.shapes, density_deviation), 1.0
    )
    mass_arm = with_lump_modes(
        basis.arms + basis.shapes @ (basis.weights * density_deviation * basis.x)
    )
    lump, lump_arm = np.zeros_like(mass), np.zeros_like(mass_arm)
    tension, tension_arm = with_lump_modes(basis.tension), with_lump_modes(basis.arms_of_tension)
    for lump_index, (position, mass_kg) in enumerate(alteration.lumps, start=_BASIS_MODE_COUNT):
        mass_fraction, shape = (
            mass_kg / (beam.density_kg_per_m * length_m),
            with_lump_modes(_basis_shapes_at_lump(position).copy()),
        )
        # All modes beyond the basis act on a point mass as one spring, and move as one mode.
        flexibility_beyond_basis = position**3 / 3 - float(
            np.sum((shape[:_BASIS_MODE_COUNT] / basis.z**2) ** 2)
        )
        shape[lump_index] = math.sqrt(max(flexibility_beyond_basis, 0.0)) * _NEXT_EIGENVALUE**2
        lump += mass_fraction * np.outer(shape, shape)
        lump_arm += mass_fraction * position * shape
        if alteration.gravity_m_s2:
            mass_outboard = np.where(basis.x < position, mass_fraction, 0.0)
            tension = tension + with_lump_modes(
                basis.weighted_products(basis.slopes, mass_outboard)
            )
            tension_arm = tension_arm + mass_fraction * shape
    # Flexibility of beam and clamp to loads with the shapes of the basis
    moments = basis.curvatures / basis.z[:, None] ** 4
    relative_flexibility = 1 / (1 + basis.deviation(alteration.stiffness))
    beam_flexibility = with_lump_modes(
        basis.weighted_products(moments, relative_flexibility), _NEXT_EIGENVALUE**-4.0
    )
    root_moments = with_lump_modes(2 * (-1.0) ** np.arange(_BASIS_MODE_COUNT) / basis.z**2)
    clamp_flexibility: CoefficientArray = alteration.clamp_compliance * np.outer(
        root_moments, root_moments
    )
    elastic_stiffness: CoefficientArray = np.linalg.inv(beam_flexibility + clamp_flexibility)
    gravity_factor = alteration.gravity_m_s2 * beam.density_over_stiffness * length_m**3
    # Eigenvalues are 1 / omega²: the largest ones, of the lowest modes, are the most exact.
    inverse_factor = np.linalg.inv(np.linalg.cholesky(elastic_stiffness + gravity_factor * tension))
    inverse_squares, eigenvectors = np.linalg.eigh(
        inverse_factor @ (mass + lump) @ inverse_factor.T
    )
    inverse_squares, eigenvectors = inverse_squares[::-1], eigenvectors[:, ::-1]
    all_shapes = inverse_factor.T @ eigenvectors / np.sqrt(inverse_squares)  # of modal mass 1
    shapes: CoefficientArray = all_shapes[:, mode_indices]
    if alteration.clamp_loss:
        clamp_flexibility = clamp_flexibility / (1 + 1j * alteration.clamp_loss)
        elastic_stiffness = np.linalg.inv(beam_flexibility + clamp_flexibility)
        shapes = _complex_shapes(elastic_stiffness + gravity_factor * tension, mass + lump, shapes)
    modal_loads = elastic_stiffness @ shapes
    modal_masses = np.sum(shapes * shapes, axis=0)
    # Losses change the mode shapes to first order, and so the phase of the residues.
    eigenvalue_differences = 1 / inverse_squares[mode_indices] - 1 / inverse_squares[:, None]
    eigenvalue_differences[mode_indices, np.arange(mode_indices.size)] = np.inf
    mass_arms = (mass_arm + lump_arm) @ all_shapes
    arm_change_by_external = mass_arms @ ((all_shapes.T @ shapes) / eigenvalue_differences)
    arm_change_by_internal = mass_arms @ (
        ((elastic_stiffness @ all_shapes).T @ beam_flexibility @ modal_loads)
        / eigenvalue_differences
    )

    def modal_coefficients(coefficient_matrix: NDArray[np.float64]) -> CoefficientArray:
        coefficients: CoefficientArray = (
            np.sum(shapes * (coefficient_matrix @ shapes), axis=0) / modal_masses
        )
        return coefficients

    root_modal_masses = np.sqrt(modal_masses)
    gravity_per_length = alteration.gravity_m_s2 / length_m
    return ModeTerms(
        stiffness=np.sum(modal_loads * (beam_flexibility @ modal_loads), axis=0)
        / modal_masses
        / length_m**4,
        clamp=np.sum(modal_loads * (clamp_flexibility @ modal_loads), axis=0)
        / modal_masses
        / length_m**4,
        mass=modal_coefficients(mass),
        lump=modal_coefficients(lump),
        tension=gravity_per_length * modal_coefficients(tension),
        mass_arm=mass_arm @ shapes / root_modal_masses,
        lump_arm=lump_arm @ shapes / root_modal_masses,
        medium_arm=with_lump_modes(basis.arms) @ shapes / root_modal_masses,
        tension_arm=gravity_per_length * (tension_arm @ shapes) / root_modal_masses,
        arm_change_by_external=arm_change_by_external / root_modal_masses * length_m**4,
        arm_change_by_internal=arm_change_by_internal / root_modal_masses,
        density_kg_per_m=beam.density_kg_per_m,
        alteration=alteration,
    )


def _complex_shapes(
    stiffness_matrix: CoefficientArray,
    mass_matrix: NDArray[np.float64],
    lossless_shapes: CoefficientArray,
) -> NDArray[np.complex128]:
    """Return the mode shapes of a beam in a lossy clamp, as coefficients of the basis, (N, n).

    They are complex, and computed by inverse iteration from `lossless_shapes`, the mode shapes for
    a clamp without loss.
    """
    complex_shapes = lossless_shapes.astype(np.complex128)
    for shape in complex_shapes.T:
        for _ in range(_INVERSE_ITERATIONS):
            eigenvalue = (shape @ stiffness_matrix @ shape) / (shape @ mass_matrix @ shape)
            next_shape = np.linalg.solve(
                stiffness_matrix - eigenvalue * (1 + _RELATIVE_SHIFT) * mass_matrix,
                mass_matrix @ shape,
            )
            shape[:] = next_shape / np.sqrt(next_shape @ mass_matrix @ next_shape)
    return complex_shapes
