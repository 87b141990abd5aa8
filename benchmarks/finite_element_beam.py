"""A non-uniform rotating beam by finite elements: response, poles and residues.

Euler-Bernoulli elements with cubic Hermite shape functions, in the deflection relative to the
turning hub, ``y = theta x + r(x, t)``. Nothing here is taken from `rigd` or `analysis`.

The dynamic stiffness is a sum of constant matrices, each multiplied by a function of the Laplace
variable s: mass by s², viscous medium by s^lambda, bending stiffness by ``1 + zeta s^alpha`` or by
relaxations. The hub's angle is prescribed and the torque is its reaction:

``G(s) = D_hh - D_hf D_ff^-1 D_fh``

Poles with locked hub solve the nonlinear eigenproblem ``D_ff(p) phi = 0``; the residue of G there
is ``-(D_hf phi)² / (phi' D_ff'(p) phi)``.

Gravity: the hub's axis is tilted by phi from the vertical, so ``g sin phi`` acts in the beam's
plane, at an angle psi to the beam's neutral axis, fixed to the ground. A slice at x sinks towards
the hub by half the integral of y'², so with ``g_x = g sin phi cos psi`` (positive: the beam hangs)
the potential energy is half the integral of ``N(x) y'²``, with the tension
``N(x) = g_x * (mass outboard of x)``. In terms of the absolute deflection this holds for the
rigid turn too: it is then the stiffness of a pendulum, ``g_x`` times the first moment of mass. The
other component, ``g_y = g sin phi sin psi``, is a constant load: a constant torque
``-g_y * (first moment of mass)``. What the static sag changes in the stiffness is of the order of
the sag's slope squared, below 1e-4 of it at 5 degrees, and is left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.linalg import eigh
from scipy.linalg.lapack import zgbsv

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]
Profile = Callable[[Real], Real]
"""A quantity along the beam, by position in metres."""
Factor = Callable[[Complex], Complex]
"""Factor of a matrix, as a function of the Laplace variable."""

_ELEMENTS = 64
_BANDS = 3
"""Diagonals on each side of the main one."""
_HIGHEST_MODE_RAD_S = 2 * np.pi * 2000.0
_MODE_LIMIT = 24
_SMOOTH_POINTS = 3000
_BATCH = 500
_ITERATIONS = 12
_POLE_TOLERANCE = 1e-7
"""Rounding errors are 1e-8: the stiffest deformation is 1e8 times as stiff as mode 1."""

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(5)
_XI = 0.5 * (_NODES + 1)
_WEIGHTS = 0.5 * _WEIGHTS


def _shapes(xi: Real, length: Real | float) -> tuple[Real, Real, Real]:
    """Return an element's Hermite functions, slopes and curvatures, four along the last axis."""
    xi, h = np.broadcast_arrays(xi, length)
    value = np.stack(
        [
            1 - 3 * xi**2 + 2 * xi**3,
            h * (xi - 2 * xi**2 + xi**3),
            3 * xi**2 - 2 * xi**3,
            h * (xi**3 - xi**2),
        ],
        axis=-1,
    )
    slope = np.stack(
        [
            (6 * xi**2 - 6 * xi) / h,
            1 - 4 * xi + 3 * xi**2,
            (6 * xi - 6 * xi**2) / h,
            3 * xi**2 - 2 * xi,
        ],
        axis=-1,
    )
    curvature = np.stack(
        [(12 * xi - 6) / h**2, (6 * xi - 4) / h, (6 - 12 * xi) / h**2, (6 * xi - 2) / h], axis=-1
    )
    return value, slope, curvature


@dataclass(frozen=True, slots=True)
class PointMass:
    """A mass on the beam, at a position from the hub."""

    position_m: float
    mass_kg: float
    inertia_kg_m2: float = 0.0


@dataclass(frozen=True, slots=True)
class _Term:
    """A symmetric matrix of the dynamic stiffness, and the function that multiplies it."""

    factor: Factor
    free: Real
    coupling: Real
    hub: float

    def banded(self) -> Real:
        """Free part in the form of LAPACK's solver for banded matrices."""
        size = self.free.shape[0]
        bands = np.zeros((2 * _BANDS + 1, size))
        for offset in range(-_BANDS, _BANDS + 1):
            diagonal = np.diagonal(self.free, offset)
            start = max(offset, 0)
            bands[_BANDS - offset, start : start + diagonal.size] = diagonal
        return bands


@dataclass(frozen=True, slots=True)
class LockedHubMode:
    """A mode with locked hub: pole in rad/s, residue of torque per angle in N·m/s."""

    number: int
    pole_rad_s: complex
    residue: complex

    @property
    def frequency_hz(self) -> float:
        """Frequency of the free decay."""
        return float(self.pole_rad_s.imag / (2 * np.pi))

    @property
    def damping_ratio(self) -> float:
        """Damping ratio."""
        return float(-self.pole_rad_s.real / abs(self.pole_rad_s))


@dataclass(slots=True)
class FiniteElementBeam:
    """A beam turned by a hub.

    Attributes
    ----------
    length_m : float
    density_kg_per_m, stiffness_n_m2 : callable
        Mass per length and bending stiffness by position. Both may jump at ``jumps_m``.
    elastic : callable
        Factor of the bending stiffness, by s: ``1 + zeta s^alpha``.
    medium_n_s_per_m2 : callable
        Force of the medium per length and deflection, by s: ``c_v s^lambda``.
    masses : tuple of PointMass
    gravity_m_s2 : float
        Component of gravity along the neutral axis, positive outwards.
    root_nm_per_rad : callable, optional
        Spring between hub and root, by s; rigid without.
    patches : tuple of (callable, callable)
        Additional bending stiffness by position, each with a factor by s.
    jumps_m : tuple of float
        Positions at which properties jump. Elements end there.
    elements : int
    """

    length_m: float
    density_kg_per_m: Profile
    stiffness_n_m2: Profile
    elastic: Factor
    medium_n_s_per_m2: Factor
    masses: tuple[PointMass, ...] = ()
    gravity_m_s2: float = 0.0
    root_nm_per_rad: Factor | None = None
    patches: tuple[tuple[Profile, Factor], ...] = ()
    jumps_m: tuple[float, ...] = ()
    elements: int = _ELEMENTS
    _terms: tuple[_Term, ...] = field(init=False, repr=False)
    _bands: tuple[Real, ...] = field(init=False, repr=False)
    _nodes: Real = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Assemble the matrices."""
        jumps = [*self.jumps_m]
        if self.gravity_m_s2:
            # The tension jumps at a mass.
            jumps += [mass.position_m for mass in self.masses]
        ends = np.unique([0.0, *(x for x in jumps if 0 < x < self.length_m), self.length_m])
        parts = []
        for start, end in pairwise(ends):
            count = max(2, round(self.elements * (end - start) / self.length_m))
            parts.append(np.linspace(start, end, count + 1)[:-1])
        self._nodes = np.append(np.concatenate(parts), self.length_m)
        self._terms = tuple(self._assembled())
        self._bands = tuple(term.banded() for term in self._terms)

    def _assembled(self) -> list[_Term]:
        def square(s: Complex) -> Complex:
            return s**2

        def one(s: Complex) -> Complex:
            return np.ones_like(s)

        mass = self._integrated(self.density_kg_per_m, 0)
        for point in self.masses:
            mass += self._point(point)
        terms = [
            self._term(square, mass),
            self._term(self.medium_n_s_per_m2, self._integrated(np.ones_like, 0)),
            self._elastic_term(self.elastic, self.stiffness_n_m2),
        ]
        terms += [self._elastic_term(factor, extra) for extra, factor in self.patches]
        if self.gravity_m_s2:
            tension = self.gravity_m_s2 * self._integrated(self._outboard_kg, 1)
            terms.append(self._term(one, tension))
        if self.root_nm_per_rad is not None:
            spring = np.zeros_like(terms[0].free)
            spring[0, 0] = 1.0
            terms.append(_Term(self.root_nm_per_rad, spring, np.zeros(spring.shape[0]), 0.0))
        return terms

    def _term(self, factor: Factor, absolute: Real) -> _Term:
        """Transform a matrix from absolute deflection to hub angle and relative deflection."""
        rigid = np.empty(absolute.shape[0])
        rigid[0::2], rigid[1::2] = self._nodes, 1.0
        coupling = absolute @ rigid
        free = self._free
        return _Term(factor, absolute[free, free], coupling[free], float(rigid @ coupling))

    def _elastic_term(self, factor: Factor, stiffness: Profile) -> _Term:
        """Return the term of a bending stiffness, with exactly zero effect of a rigid turn."""
        matrix = self._integrated(stiffness, 2)[self._free, self._free]
        return _Term(factor, matrix, np.zeros(matrix.shape[0]), 0.0)

    @property
    def _free(self) -> slice:
        """Free degrees of freedom: without the root's deflection, and its slope where rigid."""
        return slice(2 if self.root_nm_per_rad is None else 1, None)

    def _integrated(self, profile: Profile, order: int) -> Real:
        """Return the integral of a profile times a squared derivative of the shape functions."""
        starts, lengths = self._nodes[:-1, None], np.diff(self._nodes)[:, None]
        shape = _shapes(_XI, lengths)[order]
        weight = _WEIGHTS * lengths * profile(starts + lengths * _XI)
        blocks = np.einsum("eqi,eq,eqj->eij", shape, weight, shape)
        matrix = np.zeros((2 * self._nodes.size,) * 2)
        first = 2 * np.arange(len(blocks))
        for row, column in np.ndindex(4, 4):
            # Elements overlap by a node, so that no entry of one row and column occurs twice.
            matrix[first + row, first + column] += blocks[:, row, column]
        return matrix

    def _point(self, point: PointMass) -> Real:
        matrix = np.zeros((2 * self._nodes.size,) * 2)
        value, slope, i = self._at(point.position_m)
        at = slice(2 * i, 2 * i + 4)
        matrix[at, at] = point.mass_kg * np.outer(value, value)
        matrix[at, at] += point.inertia_kg_m2 * np.outer(slope, slope)
        return matrix

    def _at(self, position_m: float) -> tuple[Real, Real, int]:
        """Return shape functions and slopes at a position, and the number of the element."""
        i = int(np.searchsorted(self._nodes, position_m, side="right")) - 1
        i = min(max(i, 0), self._nodes.size - 2)
        h = self._nodes[i + 1] - self._nodes[i]
        value, slope, _ = _shapes(np.array((position_m - self._nodes[i]) / h), h)
        return value, slope, i

    def _outboard_kg(self, x: Real) -> Real:
        """Return the mass outboard of positions, shape (elements, n), each row in its element."""
        starts, ends = self._nodes[:-1], self._nodes[1:]
        points = starts[:, None] + np.multiply.outer(ends - starts, _XI)
        elements = (ends - starts) * (self.density_kg_per_m(points) @ _WEIGHTS)
        beyond = np.append(np.cumsum(elements[::-1])[-2::-1], 0.0)
        beyond += [
            sum(point.mass_kg for point in self.masses if point.position_m >= end - 1e-12)
            for end in ends
        ]
        left = ends[:, None] - x
        inside = self.density_kg_per_m(x[..., None] + left[..., None] * _XI) @ _WEIGHTS
        return beyond[:, None] + left * inside

    @property
    def mass_moment_kg_m(self) -> float:
        """First moment of mass about the hub."""
        moment = float(
            sum(
                (end - start) * (_WEIGHTS * points) @ self.density_kg_per_m(points)
                for start, end in zip(self._nodes[:-1], self._nodes[1:], strict=True)
                for points in [start + _XI * (end - start)]
            )
        )
        return moment + sum(point.mass_kg * point.position_m for point in self.masses)

    def response(self, s: Complex) -> Complex:
        """Return the torque applied by the hub over its angle, in N·m/rad."""
        s = np.atleast_1d(np.asarray(s, dtype=complex))
        found = np.empty(s.size, dtype=complex)
        for start in range(0, s.size, _BATCH):
            part = slice(start, start + _BATCH)
            weights, coupling, matrix = self._summed(s[part])
            hub = weights @ np.array([term.hub for term in self._terms])
            bent = [_solved(*pair) for pair in zip(matrix, coupling, strict=True)]
            found[part] = hub - np.sum(coupling * np.array(bent), axis=1)
        return found

    def _summed(self, s: Complex) -> tuple[Complex, Complex, Complex]:
        """Return factors, coupling and banded matrix of the dynamic stiffness, a row for each s."""
        weights = np.array([term.factor(s) for term in self._terms]).T
        coupling = weights @ np.array([term.coupling for term in self._terms])
        matrix = np.tensordot(weights, np.array(self._bands), 1)
        return weights, coupling, matrix

    def undamped(self) -> tuple[Real, Real]:
        """Return frequencies in rad/s and shapes of the undamped modes with locked hub."""
        mass, near = self._terms[0].free, 1j * np.ones(1) * 1e-3
        stiffness = sum(
            (term.factor(near)[0].real * term.free for term in self._terms[2:]),
            start=np.zeros_like(mass),
        )
        last = min(_MODE_LIMIT, mass.shape[0]) - 1
        squares, shapes = eigh(stiffness, mass, subset_by_index=[0, last])
        return np.sqrt(np.maximum(squares, 0.0)), shapes

    def participations(self) -> tuple[Real, Real]:
        """Return undamped frequencies in rad/s, and the participation of each mode in a rigid turn.

        A participation is the square root of the mode's part of the moment of inertia, with the
        sign of its shape.
        """
        frequencies, shapes = self.undamped()
        return frequencies, self._terms[0].coupling @ shapes

    def shapes_at(self, position_m: Real) -> Real:
        """Return deflections of the undamped modes of unit modal mass, shape (modes, positions)."""
        _, shapes = self.undamped()
        full = np.zeros((2 * self._nodes.size, shapes.shape[1]))
        full[self._free] = shapes
        found = np.empty((shapes.shape[1], position_m.size))
        for i, position in enumerate(position_m):
            value, _, element = self._at(float(position))
            found[:, i] = value @ full[2 * element : 2 * element + 4]
        return found

    def modes(self, highest_rad_s: float = _HIGHEST_MODE_RAD_S) -> list[LockedHubMode]:
        """Return the modes with locked hub, except overdamped ones."""
        frequencies, shapes = self.undamped()
        found: list[LockedHubMode] = []
        for number, omega in enumerate(frequencies, start=1):
            if omega > highest_rad_s:
                break
            mode = self._mode(number, 1j * omega, shapes[:, number - 1].astype(complex))
            if mode is not None and mode.pole_rad_s.imag > 0.5 * abs(mode.pole_rad_s):
                found.append(mode)
        return found

    def _mode(self, number: int, pole: complex, shape: Complex) -> LockedHubMode | None:
        """Solve the nonlinear eigenproblem by inverse iteration, from an undamped mode."""
        # The undamped shape first: the dynamic stiffness may differ much from the static one.
        squares = np.array([shape @ term.free @ shape for term in self._terms])
        for _ in range(4):
            pole -= (self._factors(pole) @ squares) / (self._slopes(pole) @ squares)
        change = np.inf
        for _ in range(_ITERATIONS):
            loaded = self._slope_times(pole, shape)
            _, coupling, matrix = self._summed(np.array([pole]))
            following = _solved(matrix[0], loaded)
            step = complex((shape @ loaded) / (following @ loaded))
            shape = following / np.sqrt(following @ following)
            pole, change = pole - step, abs(step)
            if change < 1e-11 * abs(pole):
                break
        if not change < _POLE_TOLERANCE * abs(pole):
            return None
        _, coupling, _ = self._summed(np.array([pole]))
        energy = shape @ self._slope_times(pole, shape)
        return LockedHubMode(number, pole, complex(-((coupling[0] @ shape) ** 2) / energy))

    def _factors(self, s: complex) -> Complex:
        at = np.array([s])
        return np.array([term.factor(at)[0] for term in self._terms])

    def _slopes(self, s: complex) -> Complex:
        """Differentiate the factors by s."""
        step = 1e-5 * abs(s)
        return (self._factors(s + step) - self._factors(s - step)) / (2 * step)

    def _slope_times(self, s: complex, shape: Complex) -> Complex:
        """Multiply a shape by the derivative of the free dynamic stiffness by s."""
        parts = [term.free @ shape.real + 1j * (term.free @ shape.imag) for term in self._terms]
        found: Complex = self._slopes(s) @ np.array(parts)
        return found

    def fast_response(self, s: Complex, modes: list[LockedHubMode]) -> Complex:
        """Return the response on a line of constant real part, from poles and a smooth remainder.

        The remainder has no resonance, so that a spline through 3000 points of it suffices.
        """
        sigma = float(s[0].real)
        scale = max(sigma, 1e-3)
        wanted = np.arcsinh(s.imag / scale)
        grid = np.linspace(0.0, wanted[-1], _SMOOTH_POINTS)
        at = sigma + 1j * scale * np.sinh(grid)
        remainder = self.response(at)
        for mode in modes:
            remainder -= resonance(mode, at)
        found: Complex = CubicSpline(grid, remainder / at)(wanted) * s
        for mode in modes:
            found += resonance(mode, s)
        return found


def _solved(matrix: Complex, right: Complex) -> Complex:
    """Solve a banded system in the form of `_Term.banded`."""
    room = np.zeros((_BANDS, matrix.shape[1]), dtype=complex)
    *_, found, fault = zgbsv(_BANDS, _BANDS, np.concatenate([room, matrix]), right)
    if fault:
        raise ArithmeticError("the dynamic stiffness is singular here")
    solved: Complex = found
    return solved


def resonance(mode: LockedHubMode, s: Complex) -> Complex:
    """Return the part of a response by a pair of poles, which falls as s² towards zero."""
    pole, residue = mode.pole_rad_s, mode.residue
    weight = residue / pole**2
    # Both poles over a common denominator: half the divisions.
    numerator = 2 * weight.real * s - 2 * (weight * pole.conjugate()).real
    found: Complex = s**2 * numerator / (s**2 - 2 * pole.real * s + abs(pole) ** 2)
    return found


def uniform_response(
    s: Complex, length_m: float, density: float, stiffness: float, elastic: Factor, medium: Factor
) -> Complex:
    """Return the closed form of a uniform beam, Eq. 25, for comparison."""
    carried = stiffness * elastic(s)
    z = (-(density * s**2 + medium(s)) / carried) ** 0.25 * length_m
    numerator = np.sin(z) * np.cosh(z) - np.cos(z) * np.sinh(z)
    found: Complex = -carried / length_m * z * numerator / (1 + np.cos(z) * np.cosh(z))
    return found
