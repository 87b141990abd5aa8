"""Transfer function of the beam with a tip mass, an elastic clamp, or modal stiffness offsets.

With ``p = rho/EI s² + gamma s^lambda``, ``c = 1 + zeta s^alpha``, ``q = z⁴ = -L⁴ p / c`` and the
mass ratio ``mu = m s² / (L EI p)``, the tip's condition ``EI c y''' = m s² y`` turns Eq. 25 into::

    G = -(EI/L) c (F + mu U) / (1 - mu F),    U = 2 z² sin z sinh z / (1 + cos z cosh z)

F as in `rigd.beam._model`. A clamp that turns by kappa per torque on the beam's root turns it into
``G / (1 + kappa G)``.

F and U are functions of q alone; ``q d/dq`` of them needs one more, ``B = z (cos z sinh z +
sin z cosh z) / (1 + cos z cosh z)``::

    q F' = (F + U + F²) / 4,    q U' = U/2 + z² B/2 + U F/4

In a beam that is not quite uniform the stiffness k⁴ of a mode differs from the uniform beam's by
the relative offset d. The following term then replaces mode i of the sum G (`rigd.beam._modes`),
with its participation a²::

    G_i = a² EI p² c k⁴ d / ((c k⁴ (1 + d) + p) (c k⁴ + p))
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rigd.beam._model import Beam, Damping
from rigd.beam._modes import (
    CLOSE_BY,
    clamped_free_eigenvalues,
    poles_for_eigenvalues,
    root_shear_ratio,
)
from rigd.beam._point_force import PointForceGrid

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

_SERIES_LIMIT = 40.0
_POWERS = (-4.0) ** np.arange(10)
_SERIES = np.array(
    [
        [scale * _POWERS[k] / math.factorial(4 * k + last) for k in range(10)]
        for scale, last in ((1.0, 0), (4.0, 3), (4.0, 2), (2.0, 1))
    ]
).T
_SERIES[0, 0] += 1.0
"""Power series in q of ``1 + cos z cosh z`` and of the numerators of F, U and z² B over q."""

_HOMOTOPY_STEPS = 12
_CHANGE_PER_STEP = 0.02
_NEWTON_STEPS = 60
_CONVERGED = 1e-10
"""Relative length of Newton's last step: the error is of the order of its square."""
_CLOSELY = 1e-6
"""The same for close starts, where convergence is quadratic from the first step on."""
_NEARLY = 1e-4
"""The same during the increase to the whole mass."""
_FARTHEST = 10.0
"""Largest movement of a pole in one step of the increase to the whole mass."""
_ASIDE = 1e-7
_NEXT_TO_POLE = 1e-8
"""Relative distance from a pole: the square root of the rounding error relative to G there."""


@dataclass(frozen=True, slots=True, eq=False)
class LoadedResponse:
    """G of the beam with a tip mass, and its derivatives.

    All of the shape of s; c, p and the mass vary one at a time, with fixed EI and length.
    """

    response: Complex
    """G in N·m/rad."""
    by_elastic: Complex
    """Derivative with respect to c."""
    by_inertial: Complex
    """Derivative with respect to p."""
    by_mass: Complex
    """Derivative with respect to the tip's mass, in N·m/(rad kg)."""


def loaded_response(
    s_squared: Complex, elastic: Complex, inertial: Complex, beam: Beam, tip_mass_kg: float
) -> LoadedResponse:
    """Evaluate G with a tip mass on a rigid clamp.

    Parameters
    ----------
    s_squared : ndarray of complex
        In rad²/s², not 0.
    elastic, inertial : ndarray of complex
        c and p there.
    beam : Beam
        Stiffness and length of the beam; its density is in p.
    tip_mass_kg : float
    """
    stiffness, length = beam.bending_stiffness_n_m2, beam.length_m
    f, u, f_slope, u_slope = _functions(-(length**4) * inertial / elastic)
    per_mass = s_squared / (length * stiffness * inertial)
    mass_ratio = tip_mass_kg * per_mass
    inverse = 1 / (1 - mass_ratio * f)
    loaded = (f + mass_ratio * u) * inverse
    by_ratio = (u + loaded * f) * inverse
    slope = (f_slope + mass_ratio * u_slope + mass_ratio * loaded * f_slope) * inverse
    per_length = -stiffness / length
    return LoadedResponse(
        response=per_length * elastic * loaded,
        by_elastic=per_length * (loaded - slope),
        by_inertial=per_length * elastic / inertial * (slope - mass_ratio * by_ratio),
        by_mass=per_length * elastic * per_mass * by_ratio,
    )


def _with_offsets(
    found: LoadedResponse,
    elastic: Complex,
    inertial: Complex,
    beam: Beam,
    stiffness_offsets: tuple[float, ...],
) -> LoadedResponse:
    """Give modes 2, 3, … of a beam on a rigid clamp their stiffness offsets."""
    length, stiffness = beam.length_m, beam.bending_stiffness_n_m2
    total, by_elastic, by_inertial = np.zeros((3, *np.shape(elastic)), dtype=np.complex128)
    z = clamped_free_eigenvalues(1 + len(stiffness_offsets))[1:]
    for k4, offset in zip((z / length) ** 4, stiffness_offsets, strict=True):
        # a² EI k⁴, with the participation a² = 4 L³ / z⁴
        weight, stiffer = 4 * stiffness / length, 1 + offset
        before = 1 / (elastic * k4 + inertial)
        after = 1 / (elastic * k4 * stiffer + inertial)
        total += weight * inertial**2 * elastic * offset * before * after
        by_elastic += weight * inertial**2 * (stiffer * after**2 - before**2)
        by_inertial += weight * elastic**2 * k4 * ((stiffer * after) ** 2 - before**2)
    return replace(
        found,
        response=found.response + total,
        by_elastic=found.by_elastic + by_elastic,
        by_inertial=found.by_inertial + by_inertial,
    )


Slopes = dict[str, Callable[[], Complex]]
"""Derivatives of a response by the names of parameters, each computed on demand."""


def differentiated_response(
    log_s: Complex,
    s_squared: Complex,
    beam: Beam,
    damping: Damping,
    tip_mass_kg: float,
    stiffness_offsets: tuple[float, ...] = (),
) -> tuple[LoadedResponse, Slopes]:
    """Return G with a tip mass on a rigid clamp, and its derivatives by any parameter.

    Parameters
    ----------
    log_s, s_squared : ndarray of complex
        Logarithm and square of the Laplace variable, which is not 0.
    beam, damping
        Parameters of the exact model.
    tip_mass_kg
        Point mass at the tip.
    stiffness_offsets
        As in `LoadedBeam`, fixed.

    Returns
    -------
    response : LoadedResponse
    slopes : dict of str to callable
        By `rigd.beam.PARAMETERS` except the length, and by ``tip_mass_kg``.
    """
    s_alpha = np.exp(damping.alpha * log_s).astype(np.complex128)
    s_lambda = np.exp(damping.lambda_ * log_s).astype(np.complex128)
    inertia = beam.density_over_stiffness * s_squared
    elastic, inertial = 1 + damping.zeta * s_alpha, inertia + damping.gamma * s_lambda
    found = loaded_response(s_squared, elastic, inertial, beam, tip_mass_kg)
    if stiffness_offsets:
        found = _with_offsets(found, elastic, inertial, beam, stiffness_offsets)
    return found, {
        "zeta": lambda: found.by_elastic * s_alpha,
        "alpha": lambda: found.by_elastic * (damping.zeta * log_s * s_alpha),
        "gamma": lambda: found.by_inertial * s_lambda,
        "lambda": lambda: found.by_inertial * (damping.gamma * log_s * s_lambda),
        "ln_density_over_stiffness": lambda: found.by_inertial * inertia,
        "ln_stiffness": lambda: found.response - tip_mass_kg * found.by_mass,
        "tip_mass_kg": lambda: found.by_mass,
    }


@dataclass(frozen=True, slots=True)
class LoadedBeam:
    """Beam with a tip mass on an elastic clamp, uniform or with modal stiffness offsets.

    Attributes
    ----------
    beam : Beam
    damping : Damping
    tip_mass_kg : float
    root_compliance_rad_per_nm : float
    stiffness_offsets : tuple of float
        Relative differences of the stiffness of modes 2, 3, … from the uniform beam's. With them
        the coupling torque (`transfer`, `poles`, `zeros`) and the motion of the tip are defined,
        but not the shear, and not together with a tip mass.
    """

    beam: Beam
    damping: Damping
    tip_mass_kg: float = 0.0
    root_compliance_rad_per_nm: float = 0.0
    stiffness_offsets: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.tip_mass_kg and any(self.stiffness_offsets):
            raise ValueError("A tip mass and modes of their own stiffness exclude each other.")

    @property
    def plain(self) -> bool:
        """Whether it is a uniform beam with a free tip on a rigid clamp."""
        return not (
            self.tip_mass_kg or self.root_compliance_rad_per_nm or any(self.stiffness_offsets)
        )

    def with_frequencies(self, frequency_hz: Sequence[float]) -> "LoadedBeam":
        """Return the beam with given frequencies of some modes, by a stiffness offset for each.

        Parameters
        ----------
        frequency_hz
            Frequencies of the free decay of modes 1, 2, …; the density follows from the first.

        Raises
        ------
        ValueError
            If one of these modes of the beam does not oscillate.
        """
        z = clamped_free_eigenvalues(len(frequency_hz))
        wanted_rad_s = 2 * math.pi * np.array(frequency_hz)
        found = LoadedBeam(self.beam, self.damping)
        stiffness = np.ones(z.size)
        for _ in range(2):  # damping moves them a little
            own_rad_s = found.poles(z)[:, 0].imag
            if not bool((own_rad_s > 0).all()):
                raise ValueError("A mode of the beam does not oscillate.")
            stiffness *= (wanted_rad_s / own_rad_s) ** 2
            density_kg_per_m = self.beam.density_kg_per_m / float(stiffness[0])
            found = LoadedBeam(
                replace(self.beam, density_kg_per_m=density_kg_per_m),
                self.damping,
                stiffness_offsets=tuple((stiffness[1:] / stiffness[0] - 1).tolist()),
            )
        return found

    def transfer(self, s: Complex) -> Complex:
        """Return the coupling torque per motor angle in N·m/rad, in the shape of `s` (not 0)."""
        response = self.at(s).response
        return response / (1 + self.root_compliance_rad_per_nm * response)

    def transfer_and_gradient(self, s: Complex, wrt: Sequence[str]) -> tuple[Complex, Complex]:
        """Return the transfer function and its derivatives with respect to parameters.

        Parameters
        ----------
        s
            As for `transfer`.
        wrt
            Names of `rigd.beam.PARAMETERS`, ``tip_mass_kg`` and ``root_compliance_rad_per_nm``.

        Returns
        -------
        transfer : complex ndarray, shape of `s`
        gradient : complex ndarray, shape ``(len(wrt), *shape of s)``
        """
        at, by = self._differentiated(s)
        factor = 1 / (1 + self.root_compliance_rad_per_nm * at.response)
        gradient = np.array([by[name]() for name in wrt], dtype=np.complex128)
        return at.response * factor, gradient * factor * factor

    def pole_gradients(self, poles_rad_s: Complex, wrt: Sequence[str]) -> Complex:
        """Differentiate poles with respect to parameters; shape (n, len(wrt)).

        Computed as for roots of ``1/G + kappa``. At the pole of a beam on a rigid clamp G is
        infinite, but close to it the ratios of its derivatives are accurate.

        Parameters
        ----------
        poles_rad_s : ndarray of complex, shape (n,)
            Poles, as of `poles`.
        wrt
            Names as of `transfer_and_gradient`; those without effect on a pole give 0.
        """
        aside = 0.0 if self.root_compliance_rad_per_nm else _NEXT_TO_POLE
        s = poles_rad_s * (1 - aside)
        at, by = self._differentiated(s)
        slope = self.slope(s, at)
        moved = np.zeros((s.size, len(wrt)), dtype=np.complex128)
        for column, name in zip(moved.T, wrt, strict=True):
            if name in by:
                column[:] = -by[name]() / slope
        return moved

    def _uniform(self) -> None:
        """Raise if the beam is not uniform."""
        if any(self.stiffness_offsets):
            raise ValueError("Of modes of their own stiffness the shear is not known.")

    def _differentiated(self, s: Complex) -> tuple[LoadedResponse, Slopes]:
        """Return `at` with the derivatives on a rigid clamp, that by its compliance at 0."""
        at, by = differentiated_response(
            np.log(s),
            s * s,
            self.beam,
            self.damping,
            self.tip_mass_kg,
            self.stiffness_offsets,
        )
        return at, by | {"root_compliance_rad_per_nm": lambda: -at.response * at.response}

    def tip_slope(self, s: Complex) -> Complex:
        """Return the slope of the tip against the root per motor angle, in the shape of `s`."""
        return self.tip_response(s)[1]

    def tip_response(self, s: Complex) -> tuple[Complex, Complex]:
        """Return displacement (m/rad) and slope of the tip per motor angle, relative to the root.

        Parameters
        ----------
        s
            As for `transfer`.
        """
        grid, tip = PointForceGrid(s, self.beam, self.damping), self.beam.length_m
        displacement, slope = grid.per_angle(tip) - tip, grid.per_angle(tip, 1) - 1
        elastic, inertial = self.factors(s)
        z = clamped_free_eigenvalues(1 + len(self.stiffness_offsets))
        tip_slopes = 2 * z * root_shear_ratio(z.size) / tip
        for index, offset in enumerate(self.stiffness_offsets, start=1):
            # Mode i contributes -p b / (c k⁴ (1 + d) + p); b is its part of a rigid rotation.
            k4, turn = (z[index] / tip) ** 4, 2 * (-1) ** index * tip / z[index] ** 2
            more = inertial * turn * elastic * k4 * offset
            more = more / ((elastic * k4 + inertial) * (elastic * k4 * (1 + offset) + inertial))
            displacement = displacement + 2 * more
            slope = slope + tip_slopes[index] * more
        if self.tip_mass_kg:
            push = self._push(s, grid)
            displacement = displacement + grid.per_force(tip, tip) * push
            slope = slope + grid.per_force(tip, tip, 1) * push
        root = 1 / (1 + self.root_compliance_rad_per_nm * self.at(s).response)
        return displacement * root, slope * root

    def _push(self, s: Complex, grid: PointForceGrid) -> Complex:
        """Return the force on the tip, per angle of the root, that accelerates the tip mass."""
        tip, load = self.beam.length_m, self.tip_mass_kg * s * s
        push: Complex = -load * grid.per_angle(tip) / (1 + load * grid.per_force(tip, tip))
        return push

    def shear(self, s: Complex) -> Complex:
        """Return the motor's force on the beam per motor angle in N/rad, in the shape of `s`."""
        self._uniform()
        grid = PointForceGrid(s, self.beam, self.damping)
        shear = grid.shear_per_angle()
        if self.tip_mass_kg:
            shear = shear + grid.shear_per_force(self.beam.length_m) * self._push(s, grid)
        if self.root_compliance_rad_per_nm:
            shear = shear / (1 + self.root_compliance_rad_per_nm * self.at(s).response)
        return shear

    def at(self, s: Complex) -> LoadedResponse:
        """Return the torque for a rigid clamp, with its derivatives."""
        elastic, inertial = self.factors(s)
        found = loaded_response(s * s, elastic, inertial, self.beam, self.tip_mass_kg)
        if not any(self.stiffness_offsets):
            return found
        return _with_offsets(found, elastic, inertial, self.beam, self.stiffness_offsets)

    def residues(self, poles_rad_s: Complex) -> Complex:
        """Return residues of the coupling torque per angular acceleration, ``G(s) / s²``, at poles.

        A mode whose pair of poles is p and its conjugate adds ``2 Re(r exp(p t))`` to the response
        to a unit change of the angular velocity.

        Parameters
        ----------
        poles_rad_s : ndarray of complex, shape (n,)
            As of `poles`.

        Returns
        -------
        ndarray of complex, shape (n,)
            In N·m s.
        """
        # On a rigid clamp G is infinite at a pole, but close to it the ratio is accurate.
        aside = 0.0 if self.root_compliance_rad_per_nm else _NEXT_TO_POLE
        s = poles_rad_s * (1 - aside)
        at = self.at(s)
        residues: Complex = -(at.response**2) / self.slope(s, at) / s**2
        return residues

    def factors(self, s: Complex) -> tuple[Complex, Complex]:
        """Return elastic factor c and inertial factor p."""
        log_s, damping = np.log(s), self.damping
        elastic = 1 + damping.zeta * np.exp(damping.alpha * log_s).astype(np.complex128)
        external = damping.gamma * np.exp(damping.lambda_ * log_s).astype(np.complex128)
        return elastic, self.beam.density_over_stiffness * s * s + external

    def slope(self, s: Complex, at: LoadedResponse) -> Complex:
        """Differentiate `LoadedResponse.response` by s.

        Parameters
        ----------
        s
            As for `transfer`.
        at
            Value of `at` there.
        """
        log_s, damping = np.log(s), self.damping
        internal = damping.zeta * damping.alpha * np.exp(damping.alpha * log_s)
        external = damping.gamma * damping.lambda_ * np.exp(damping.lambda_ * log_s)
        inertial = 2 * self.beam.density_over_stiffness * s * s + external
        by_log_s: Complex = (
            at.by_elastic * internal + at.by_inertial * inertial + 2 * self.tip_mass_kg * at.by_mass
        )
        return by_log_s / s

    def poles(self, z: Real, near_rad_s: Complex | None = None) -> Complex:
        """Return both poles of each mode with locked hub, shape (len(z), 2), in rad/s.

        They are followed from those of the beam on a rigid clamp while mass and compliance grow.

        Parameters
        ----------
        z : ndarray
            Clamped-free eigenvalues of the modes.
        near_rad_s : ndarray of complex, shape (len(z),), optional
            As for `rigd.beam._modes.poles_for_eigenvalues`, in the order of the modes.

        Returns
        -------
        ndarray of complex
            As of `rigd.beam._modes.poles_for_eigenvalues`; NaN where a path was lost.
        """
        if near_rad_s is not None and bool((near_rad_s.imag > 0).all()):
            found = self._newton(near_rad_s, _CLOSELY, zeros=False)
            if bool((np.abs(found / near_rad_s - 1) < CLOSE_BY).all()):
                return np.column_stack([found, found.conj()])
        return self._followed(z, zeros=False)

    def zeros(self, z: Real) -> Complex:
        """Return the zeros of the response, in pairs as in `poles`.

        Parameters
        ----------
        z : ndarray
            Roots of ``tan z = tanh z``: those of the uniform beam.
        """
        return self._followed(z, zeros=True)

    def _followed(self, z: Real, *, zeros: bool) -> Complex:
        """Follow poles or zeros from those of the uniform beam."""
        offsets = np.array(self.stiffness_offsets)
        if not zeros and offsets.size:
            # On a rigid clamp they are exactly those of the stiffness k⁴ (1 + d).
            z = z.copy()
            z[1 : 1 + offsets.size] *= (1 + offsets[: z.size - 1]) ** 0.25
        found = poles_for_eigenvalues(z, self.beam, self.damping).astype(np.complex128)
        rigid = self.tip_mass_kg == 0 and self.root_compliance_rad_per_nm == 0
        if rigid and not (zeros and offsets.any()):
            return found
        known = ~np.isnan(found[:, 0])
        # One of a conjugate pair suffices; without oscillation both have to be found.
        turning = found[known][:, 0].imag != 0
        others = found[known][~turning][:, 1]
        here = np.concatenate([found[known][:, 0], others])
        here *= 1 - _ASIDE  # G is infinite at an undamped pole
        # Relative to the beam's own values: a change that moves the poles little needs few steps.
        change = self.tip_mass_kg / (self.beam.density_kg_per_m * self.beam.length_m)
        turned = self.beam.bending_stiffness_n_m2 / self.beam.length_m
        change = max(change, self.root_compliance_rad_per_nm * turned)
        if zeros:
            change = max(change, float(np.abs(offsets).max(initial=0.0)))
        steps = min(max(math.ceil(change / _CHANGE_PER_STEP), 2), _HOMOTOPY_STEPS)
        before = here
        for step in range(1, steps + 1):
            fraction = step / steps
            partly = LoadedBeam(
                self.beam,
                self.damping,
                fraction * self.tip_mass_kg,
                fraction * self.root_compliance_rad_per_nm,
                tuple((fraction if zeros else 1.0) * offsets),
            )
            last = step == steps
            start = 2 * here - before if step > 1 else here
            before, here = here, partly._newton(start, _CONVERGED if last else _NEARLY, zeros=zeros)
        first = here[: turning.size]
        second = first.conj()
        second[~turning] = here[turning.size :]
        found[known] = np.column_stack([first, second])
        return found

    def _newton(self, s: Complex, converged: float, *, zeros: bool) -> Complex:
        """Find roots of ``1/G + kappa``, or of G, from close starts; NaN where none is found.

        Parameters
        ----------
        s
            Starts.
        converged
            Relative length of the last step.
        zeros
            Whether roots of G are searched for.
        """
        start = s
        with np.errstate(all="ignore"):
            for _ in range(_NEWTON_STEPS):
                at = self.at(s)
                step = at.response / self.slope(s, at)
                step *= -1 if zeros else 1 + self.root_compliance_rad_per_nm * at.response
                s = s + step
                if not np.nanmax(np.abs(step / s), initial=0.0) > converged:
                    break
            # Far away every step is a short one.
            found = (np.abs(step) < max(converged, 1e-9) * np.abs(s)) & (
                np.abs(s) < _FARTHEST * np.abs(start)
            )
            return np.where(found, s, np.nan + 0j)


def _functions(q: Complex) -> tuple[Complex, Complex, Complex, Complex]:
    """Return F, U, q F' and q U'."""
    q = np.asarray(q, dtype=np.complex128)
    f, u, b = np.empty((3, *q.shape), dtype=np.complex128)
    series = np.abs(q) < _SERIES_LIMIT
    if series.any():
        low = q[series]
        divisor, *numerators = np.polynomial.polynomial.polyval(low, _SERIES)
        for out, numerator in zip((f, u, b), numerators, strict=True):
            out[series] = low * numerator / divisor
    if not series.all():
        for out, values in zip((f, u, b), _scaled(q[~series]), strict=True):
            out[~series] = values
    return f, u, 0.25 * (f + u + f * f), 0.5 * (u + b) + 0.25 * u * f


def _scaled(q: Complex) -> tuple[Complex, Complex, Complex]:
    """Return F, U and z² B from decaying exponentials only."""
    # Real functions of q: their values above the real axis, mirrored, are those below.
    below = q.imag < 0
    z = np.sqrt(np.sqrt(np.where(below, q.conj(), q)))
    decay, turn = np.exp(-z), np.exp(1j * z)
    a, b = decay * decay, turn * turn
    reciprocal = 1 / (4 * decay * turn + (1 + a) * (1 + b))
    sine, cosine = 1j * (1 - b) * (1 + a), (1 + b) * (1 - a)
    found = (
        z * (sine - cosine) * reciprocal,
        2j * z**2 * (1 - a) * (1 - b) * reciprocal,
        z**3 * (sine + cosine) * reciprocal,
    )
    first, second, third = (np.where(below, values.conj(), values) for values in found)
    return first, second, third
