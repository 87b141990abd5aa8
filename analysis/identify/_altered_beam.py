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

_EIGENVALUE_BEYOND_BASIS: Final = float(clamped_free_eigenvalues(_BASIS_MODE_COUNT + 1)[-1])
"""Eigenvalue k L of the first mode of the uniform beam that is not in the basis."""

_QUADRATURE_POINTS_PER_HALF: Final = 32
"""Number of quadrature points in each half of the beam."""

_NUMERICAL_SLOPE_STEP: Final = 1e-5
"""Step of the relative position for numerical slopes of mode shapes, which are exact to a relative
error of 1e-8."""

_INVERSE_ITERATION_COUNT: Final = 2
"""Number of inverse iterations for a mode shape with a lossy clamp."""

_RELATIVE_EIGENVALUE_SHIFT: Final = 1e-7
"""Shift of an inverse iteration relative to the eigenvalue: the matrix is not singular."""

CoefficientArray = NDArray[np.inexact[Any]]
"""Array of real or complex Galerkin coefficients."""

DeviationProfile = Literal["taper", "outer half", "wave"]
"""Shape of a relative deviation along the beam.

"taper" rises from -1/2 to 1/2, "outer half" is 0 in the inner and 1 in the outer half, and "wave"
is a cosine of one period."""


@dataclass(frozen=True, slots=True)
class BeamDeviations:
    """Deviations of a rig from a uniform beam on a rigid clamp with an ideal torque channel.

    Attributes
    ----------
    point_masses : tuple of (float, float)
        Added point masses: position relative to the length, and mass in kg.
    gravity_m_s2 : float
        Component of gravity along the beam at rest, positive towards the tip.
    density_deviations, stiffness_deviations : tuple of (str, float)
        Relative deviations of the mass per length and of the bending stiffness: profile and size.
    clamp_compliance : float
        Compliance of the clamp, times EI over the length.
    clamp_loss : float
        Loss factor of the clamp.
    relaxation_strength_and_time : tuple of (float, float)
        Strength and time constant (s) of a relaxation of the material: the stiffness gains
        ``strength s t / (1 + s t)``.
    second_order_torque_lag : tuple of (float, float)
        Second-order lag in the torque channel: reciprocal of its undamped frequency (s), and of its
        quality factor.
    first_order_torque_lag_s : float
        Time constant of a first-order lag in the torque channel.
    """

    point_masses: tuple[tuple[float, float], ...] = ()
    gravity_m_s2: float = 0.0
    density_deviations: tuple[tuple[DeviationProfile, float], ...] = ()
    stiffness_deviations: tuple[tuple[DeviationProfile, float], ...] = ()
    clamp_compliance: float = 0.0
    clamp_loss: float = 0.0
    relaxation_strength_and_time: tuple[float, float] = (0.0, 1.0)
    second_order_torque_lag: tuple[float, float] = (0.0, 0.0)
    first_order_torque_lag_s: float = 0.0

    @classmethod
    def from_nominal_plant(
        cls, nominal_plant: Plant, tilt_deg: float | None = None
    ) -> BeamDeviations:
        """Return the deviations of the beam that the session file states: tip mass and tilt.

        The angle between the beam at rest and the horizontal is positive if the tip is lower than
        the root; None counts as 0.
        """
        mass_kg = nominal_plant.tip_mass_kg
        return cls(
            point_masses=((1.0, mass_kg),) if mass_kg else (),
            gravity_m_s2=GRAVITY_M_S2 * math.sin(math.radians(tilt_deg or 0.0)),
        )

    def has_same_mode_shapes(self, other_deviations: BeamDeviations) -> bool:
        """Return whether two sets of deviations result in the same mode shapes.

        They then differ at most in the relaxation of the material and in the lags of the torque
        channel, which do not affect the mode shapes.
        """
        return self == replace(
            other_deviations,
            relaxation_strength_and_time=self.relaxation_strength_and_time,
            second_order_torque_lag=self.second_order_torque_lag,
            first_order_torque_lag_s=self.first_order_torque_lag_s,
        )

    @property
    def torque_lag_denominators(self) -> tuple[tuple[float, float], ...]:
        """Return the coefficients of s and s² in the denominator of each low-pass of the torque."""
        time_s, inverse_quality = self.second_order_torque_lag
        denominators = ((inverse_quality * time_s, time_s**2), (self.first_order_torque_lag_s, 0.0))
        return tuple(lag for lag in denominators if any(lag))


@dataclass(frozen=True, slots=True)
class ModeTerms:
    """Galerkin coefficients of n modes of an altered beam.

    The documentation of the module defines the dynamic stiffness D and its terms.

    Attributes
    ----------
    stiffness, clamp_stiffness, mass, point_mass, tension : ndarray, shape (n,)
        Coefficients of D: ``K / L⁴``, ``C / L⁴``, M without the point masses, M of the point
        masses, and ``g T / L``, with the length L of the beam.
    mass_arm, point_mass_arm, external_damping_arm, tension_arm : ndarray, shape (n,)
        Arms of the forces of mass, point masses, external damping and tension about the motor's
        axis, divided by the length; complex if the clamp has a loss.
    arm_change_per_external_damping, arm_change_per_internal_damping : ndarray, shape (n,)
        Change of the arm of the mass per ``gamma s^lambda`` and per ``zeta s^alpha``, since damping
        changes the mode shape.
    density_kg_per_m : float or None
        Mass per length for which `point_mass` is valid. None if the point masses are constant
        fractions of the mass of the beam.
    deviations : BeamDeviations
        Deviations from a uniform beam.
    """

    stiffness: CoefficientArray
    clamp_stiffness: CoefficientArray
    mass: CoefficientArray
    point_mass: CoefficientArray
    tension: CoefficientArray
    mass_arm: CoefficientArray
    point_mass_arm: CoefficientArray
    external_damping_arm: CoefficientArray
    tension_arm: CoefficientArray
    arm_change_per_external_damping: CoefficientArray
    arm_change_per_internal_damping: CoefficientArray
    density_kg_per_m: float | None
    deviations: BeamDeviations

    def coefficients_by_mode(self) -> Iterable[tuple[complex, ...]]:
        """Return one tuple of coefficients for each mode, in the order of the attributes."""
        return zip(*(terms.tolist() for terms in _get_coefficient_arrays(self)), strict=True)


_get_coefficient_arrays: Final = attrgetter(*(field.name for field in fields(ModeTerms)[:-2]))
"""Function that returns the coefficients of `ModeTerms`: all attributes that are arrays."""


@dataclass(frozen=True, slots=True)
class _ModeBasis:
    """First N modes of the uniform beam at quadrature points, and integrals over their shapes.

    `eigenvalues` are the eigenvalues k L, and `positions` the quadrature points, as positions
    relative to the length, with their `quadrature_weights`. `shapes`, `slopes` and `curvatures`
    have the shape (N, points). `mass_arms` are the integrals of ``shape x`` and `tension_arms`
    those of ``slope (1 - x)``, both of shape (N,). `tension_integrals` are the integrals of
    ``slope_i slope_j (1 - x)``, shape (N, N).
    """

    eigenvalues: NDArray[np.float64]
    positions: NDArray[np.float64]
    quadrature_weights: NDArray[np.float64]
    shapes: NDArray[np.float64]
    slopes: NDArray[np.float64]
    curvatures: NDArray[np.float64]
    mass_arms: NDArray[np.float64]
    tension_arms: NDArray[np.float64]
    tension_integrals: NDArray[np.float64]

    def weighted_product_integrals(
        self, function_values: NDArray[np.float64], weight_function: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the integrals over the beam of all pairwise products of N functions, shape (N, N).

        `function_values` are the values of the N functions at the quadrature points. Each product
        is weighted by `weight_function`, the values of another function at these points.
        """
        integrals: NDArray[np.float64] = (
            function_values * (self.quadrature_weights * weight_function)
        ) @ function_values.T
        return integrals

    def total_deviation(
        self, profiles_and_sizes: Sequence[tuple[DeviationProfile, float]]
    ) -> NDArray[np.float64]:
        """Return the total relative deviation of density or stiffness at the quadrature points.

        It is the sum of `profiles_and_sizes`, each given by its profile along the beam and its
        size. The shape is (points,).
        """
        deviation_sum = np.zeros(self.positions.size)
        for profile, size in profiles_and_sizes:
            deviation_sum += size * _PROFILE_FUNCTIONS[profile](self.positions)
        return deviation_sum


_PROFILE_FUNCTIONS: Final[
    dict[DeviationProfile, Callable[[NDArray[np.float64]], NDArray[np.float64]]]
] = {
    "taper": lambda x: x - 0.5,
    "outer half": lambda x: np.where(x > 0.5, 1.0, 0.0),
    "wave": lambda x: np.cos(2 * np.pi * x),
}
"""Deviation as a function of the relative position along the beam, for each profile."""


def _basis_shapes(positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the shapes of the N basis modes at positions relative to the length, (N, …)."""
    return np.array(
        [mode_shape(mode_number, positions) for mode_number in range(1, _BASIS_MODE_COUNT + 1)]
    )


@lru_cache(maxsize=32)
def _basis_shapes_at_position(position: float) -> NDArray[np.float64]:
    """Return the basis modes' deflections at one position relative to the length, shape (N,).

    The array is cached and must not be changed.
    """
    return _basis_shapes(np.array(position))


@lru_cache(maxsize=1)
def _uniform_beam_basis() -> _ModeBasis:
    """Return the cached basis: the first modes of the uniform beam, with their integrals."""
    quadrature_nodes, weights = np.polynomial.legendre.leggauss(_QUADRATURE_POINTS_PER_HALF)
    positions = np.concatenate([0.25 * (quadrature_nodes + 1), 0.25 * (quadrature_nodes + 3)])
    weights = np.tile(weights / 4, 2)
    eigenvalues = clamped_free_eigenvalues(_BASIS_MODE_COUNT)
    alternating_signs = (-1.0) ** np.arange(_BASIS_MODE_COUNT)
    shapes, slopes = (
        _basis_shapes(positions),
        (
            _basis_shapes(positions + _NUMERICAL_SLOPE_STEP)
            - _basis_shapes(positions - _NUMERICAL_SLOPE_STEP)
        )
        / (2 * _NUMERICAL_SLOPE_STEP),
    )
    return _ModeBasis(
        eigenvalues=eigenvalues,
        positions=positions,
        quadrature_weights=weights,
        shapes=shapes,
        slopes=slopes,
        # The moment of a clamped-free mode is the shape of a clamped-free mode seen from its tip.
        curvatures=(alternating_signs * eigenvalues**2)[:, None] * _basis_shapes(1 - positions),
        mass_arms=2 * alternating_signs / eigenvalues**2,
        tension_arms=slopes @ (weights * (1 - positions)),
        tension_integrals=(slopes * (weights * (1 - positions))) @ slopes.T,
    )


@lru_cache(maxsize=16)
def galerkin_mode_terms(
    deviations: BeamDeviations, beam: Beam, mode_numbers: tuple[int, ...]
) -> ModeTerms:
    """Return the Galerkin coefficients of the given modes of an altered beam.

    `mode_numbers` are mode numbers, from 1. For each point mass one mode is added to the basis. It
    represents all higher modes.
    """
    basis = _uniform_beam_basis()
    length_m, mode_indices = beam.length_m, np.array(mode_numbers) - 1
    point_mass_count = len(deviations.point_masses)

    def extend_by_point_masses(
        uniform_beam_array: NDArray[np.float64], diagonal_value: float = 0.0
    ) -> NDArray[np.float64]:
        if not point_mass_count:
            return uniform_beam_array
        extended_array = np.zeros((_BASIS_MODE_COUNT + point_mass_count,) * uniform_beam_array.ndim)
        extended_array[(slice(_BASIS_MODE_COUNT),) * uniform_beam_array.ndim] = uniform_beam_array
        point_mass_indices = range(_BASIS_MODE_COUNT, _BASIS_MODE_COUNT + point_mass_count)
        extended_array[(point_mass_indices,) * uniform_beam_array.ndim] = diagonal_value
        return extended_array

    density_deviation = basis.total_deviation(deviations.density_deviations)
    mass = extend_by_point_masses(
        np.eye(_BASIS_MODE_COUNT)
        + basis.weighted_product_integrals(basis.shapes, density_deviation),
        1.0,
    )
    mass_arm = extend_by_point_masses(
        basis.mass_arms
        + basis.shapes @ (basis.quadrature_weights * density_deviation * basis.positions)
    )
    point_mass, point_mass_arm = np.zeros_like(mass), np.zeros_like(mass_arm)
    tension, tension_arm = (
        extend_by_point_masses(basis.tension_integrals),
        extend_by_point_masses(basis.tension_arms),
    )
    for point_mass_index, (position, mass_kg) in enumerate(
        deviations.point_masses, start=_BASIS_MODE_COUNT
    ):
        mass_fraction, shape = (
            mass_kg / (beam.density_kg_per_m * length_m),
            extend_by_point_masses(_basis_shapes_at_position(position).copy()),
        )
        # All modes beyond the basis act on a point mass as one spring, and move as one mode.
        flexibility_beyond_basis = position**3 / 3 - float(
            np.sum((shape[:_BASIS_MODE_COUNT] / basis.eigenvalues**2) ** 2)
        )
        shape[point_mass_index] = (
            math.sqrt(max(flexibility_beyond_basis, 0.0)) * _EIGENVALUE_BEYOND_BASIS**2
        )
        point_mass += mass_fraction * np.outer(shape, shape)
        point_mass_arm += mass_fraction * position * shape
        if deviations.gravity_m_s2:
            outboard_mass_fraction = np.where(basis.positions < position, mass_fraction, 0.0)
            tension = tension + extend_by_point_masses(
                basis.weighted_product_integrals(basis.slopes, outboard_mass_fraction)
            )
            tension_arm = tension_arm + mass_fraction * shape
    # Flexibility of beam and clamp to loads with the shapes of the basis
    bending_moments = basis.curvatures / basis.eigenvalues[:, None] ** 4
    relative_flexibility = 1 / (1 + basis.total_deviation(deviations.stiffness_deviations))
    beam_flexibility = extend_by_point_masses(
        basis.weighted_product_integrals(bending_moments, relative_flexibility),
        _EIGENVALUE_BEYOND_BASIS**-4.0,
    )
    root_moments = extend_by_point_masses(
        2 * (-1.0) ** np.arange(_BASIS_MODE_COUNT) / basis.eigenvalues**2
    )
    clamp_flexibility: CoefficientArray = deviations.clamp_compliance * np.outer(
        root_moments, root_moments
    )
    elastic_stiffness: CoefficientArray = np.linalg.inv(beam_flexibility + clamp_flexibility)
    gravity_factor = deviations.gravity_m_s2 * beam.density_over_stiffness * length_m**3
    # Eigenvalues are 1 / omega²: the largest ones, of the lowest modes, are the most exact.
    inverse_factor = np.linalg.inv(np.linalg.cholesky(elastic_stiffness + gravity_factor * tension))
    inverse_squared_frequencies, eigenvectors = np.linalg.eigh(
        inverse_factor @ (mass + point_mass) @ inverse_factor.T
    )
    inverse_squared_frequencies, eigenvectors = (
        inverse_squared_frequencies[::-1],
        eigenvectors[:, ::-1],
    )
    all_shapes = (
        inverse_factor.T @ eigenvectors / np.sqrt(inverse_squared_frequencies)
    )  # of modal mass 1
    shapes: CoefficientArray = all_shapes[:, mode_indices]
    if deviations.clamp_loss:
        clamp_flexibility = clamp_flexibility / (1 + 1j * deviations.clamp_loss)
        elastic_stiffness = np.linalg.inv(beam_flexibility + clamp_flexibility)
        shapes = _complex_shapes(
            elastic_stiffness + gravity_factor * tension, mass + point_mass, shapes
        )
    modal_loads = elastic_stiffness @ shapes
    modal_masses = np.sum(shapes * shapes, axis=0)
    # Losses change the mode shapes to first order, and so the phase of the residues.
    eigenvalue_differences = (
        1 / inverse_squared_frequencies[mode_indices] - 1 / inverse_squared_frequencies[:, None]
    )
    eigenvalue_differences[mode_indices, np.arange(mode_indices.size)] = np.inf
    mass_arms = (mass_arm + point_mass_arm) @ all_shapes
    arm_change_per_external_damping = mass_arms @ ((all_shapes.T @ shapes) / eigenvalue_differences)
    arm_change_per_internal_damping = mass_arms @ (
        ((elastic_stiffness @ all_shapes).T @ beam_flexibility @ modal_loads)
        / eigenvalue_differences
    )

    def modal_coefficients(coefficient_matrix: NDArray[np.float64]) -> CoefficientArray:
        coefficients: CoefficientArray = (
            np.sum(shapes * (coefficient_matrix @ shapes), axis=0) / modal_masses
        )
        return coefficients

    sqrt_modal_masses = np.sqrt(modal_masses)
    gravity_per_length = deviations.gravity_m_s2 / length_m
    return ModeTerms(
        stiffness=np.sum(modal_loads * (beam_flexibility @ modal_loads), axis=0)
        / modal_masses
        / length_m**4,
        clamp_stiffness=np.sum(modal_loads * (clamp_flexibility @ modal_loads), axis=0)
        / modal_masses
        / length_m**4,
        mass=modal_coefficients(mass),
        point_mass=modal_coefficients(point_mass),
        tension=gravity_per_length * modal_coefficients(tension),
        mass_arm=mass_arm @ shapes / sqrt_modal_masses,
        point_mass_arm=point_mass_arm @ shapes / sqrt_modal_masses,
        external_damping_arm=extend_by_point_masses(basis.mass_arms) @ shapes / sqrt_modal_masses,
        tension_arm=gravity_per_length * (tension_arm @ shapes) / sqrt_modal_masses,
        arm_change_per_external_damping=arm_change_per_external_damping
        / sqrt_modal_masses
        * length_m**4,
        arm_change_per_internal_damping=arm_change_per_internal_damping / sqrt_modal_masses,
        density_kg_per_m=beam.density_kg_per_m,
        deviations=deviations,
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
        for _ in range(_INVERSE_ITERATION_COUNT):
            eigenvalue = (shape @ stiffness_matrix @ shape) / (shape @ mass_matrix @ shape)
            next_shape = np.linalg.solve(
                stiffness_matrix - eigenvalue * (1 + _RELATIVE_EIGENVALUE_SHIFT) * mass_matrix,
                mass_matrix @ shape,
            )
            shape[:] = next_shape / np.sqrt(next_shape @ mass_matrix @ next_shape)
    return complex_shapes
