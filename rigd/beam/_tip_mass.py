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
    SAME_ROOT_TOLERANCE,
    clamped_free_eigenvalues,
    poles_for_eigenvalues,
    root_shear_ratio,
)
from rigd.beam._point_force import PointForceGrid

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

_SERIES_LIMIT = 40.0
"""Magnitude of q below which power series replace the closed form, which cancels there."""
_POWERS_OF_MINUS_FOUR = (-4.0) ** np.arange(10)
_SERIES_COEFFICIENTS = np.array(
    [
        [scale * _POWERS_OF_MINUS_FOUR[k] / math.factorial(4 * k + last) for k in range(10)]
        for scale, last in ((1.0, 0), (4.0, 3), (4.0, 2), (2.0, 1))
    ]
).T
_SERIES_COEFFICIENTS[0, 0] += 1.0
"""Coefficients of power series in q, shape (powers, 4).

The first column is ``1 + cos z cosh z``, the others are the numerators of F, U and z² B over q."""

_MAX_HOMOTOPY_STEPS = 12
"""Largest number of steps in which the tip mass and the clamp's compliance grow from zero."""
_CHANGE_PER_STEP = 0.02
"""Growth of tip mass and compliance in one step while poles are followed.

It is relative to the mass and the compliance of the beam itself."""
_MAX_NEWTON_STEPS = 60
"""Largest number of Newton's iterations."""
_NEWTON_TOLERANCE = 1e-10
"""Relative length of Newton's last step: the error is of the order of its square."""
_CLOSE_START_TOLERANCE = 1e-6
"""Relative length of Newton's last step from a start close to the root.

Convergence is quadratic there from the first step on."""
_INTERMEDIATE_TOLERANCE = 1e-4
"""Relative length of Newton's last step before tip mass and compliance have their full size."""
_MAX_ROOT_TO_START_RATIO = 10.0
"""Largest ratio of a root to the start of Newton's method that is accepted."""
_START_POLE_DISTANCE = 1e-7
"""Relative distance of the first starts from the poles, where G of an undamped beam is infinite."""
_POLE_DISTANCE = 1e-8
"""Relative distance from a pole at which the response and its derivatives are evaluated.

At the pole itself of a rigidly clamped beam they are infinite.

It is the square root of the rounding error relative to G there."""


@dataclass(frozen=True, slots=True, eq=False)
class LoadedResponse:
    """Coupling torque per motor angle of the beam with a tip mass, and its derivatives.

    All arrays have the shape of s. Each derivative holds the other two of c, p and the tip mass
    constant, and the bending stiffness and length as well.
    """

    response: Complex
    """Coupling torque per motor angle in N·m/rad."""
    by_elastic: Complex
    """Derivative of the response with respect to the elastic factor c."""
    by_inertial: Complex
    """Derivative of the response with respect to the inertial factor p."""
    by_mass: Complex
    """Derivative of the response with respect to the tip mass, in N·m/(rad kg)."""


def loaded_response(
    s_squared: Complex,
    elastic_factor: Complex,
    inertial_factor: Complex,
    beam: Beam,
    tip_mass_kg: float,
) -> LoadedResponse:
    """Return the coupling torque per angle of a rigidly clamped beam with a tip mass.

    Parameters
    ----------
    s_squared : ndarray of complex
        Square of the Laplace variable in rad²/s², not 0.
    elastic_factor, inertial_factor : ndarray of complex
        Elastic factor c and inertial factor p at these s.
    beam : Beam
        Beam with this stiffness and length. Its density is not used: p contains it.
    tip_mass_kg : float
        Point mass at the tip.
    """
    stiffness_n_m2, length_m = beam.bending_stiffness_n_m2, beam.length_m
    f, u, f_slope, u_slope = _response_functions(-(length_m**4) * inertial_factor / elastic_factor)
    per_mass = s_squared / (length_m * stiffness_n_m2 * inertial_factor)
    mass_ratio = tip_mass_kg * per_mass
    inverse_factor = 1 / (1 - mass_ratio * f)
    loaded_f = (f + mass_ratio * u) * inverse_factor
    by_ratio = (u + loaded_f * f) * inverse_factor
    loaded_slope = (
        f_slope + mass_ratio * u_slope + mass_ratio * loaded_f * f_slope
    ) * inverse_factor
    per_length = -stiffness_n_m2 / length_m
    return LoadedResponse(
        response=per_length * elastic_factor * loaded_f,
        by_elastic=per_length * (loaded_f - loaded_slope),
        by_inertial=per_length
        * elastic_factor
        / inertial_factor
        * (loaded_slope - mass_ratio * by_ratio),
        by_mass=per_length * elastic_factor * per_mass * by_ratio,
    )


def _add_stiffness_offsets(
    uniform_response: LoadedResponse,
    elastic_factor: Complex,
    inertial_factor: Complex,
    beam: Beam,
    stiffness_offsets: tuple[float, ...],
) -> LoadedResponse:
    """Return the torque per angle with the stiffness offsets of modes 2, 3, … included."""
    length_m, stiffness_n_m2 = beam.length_m, beam.bending_stiffness_n_m2
    total_response, by_elastic, by_inertial = np.zeros(
        (3, *np.shape(elastic_factor)), dtype=np.complex128
    )
    z = clamped_free_eigenvalues(1 + len(stiffness_offsets))[1:]
    for k4, offset in zip((z / length_m) ** 4, stiffness_offsets, strict=True):
        # a² EI k⁴, with the participation a² = 4 L³ / z⁴
        mode_weight, stiffer_mode = 4 * stiffness_n_m2 / length_m, 1 + offset
        uniform_mode = 1 / (elastic_factor * k4 + inertial_factor)
        offset_mode = 1 / (elastic_factor * k4 * stiffer_mode + inertial_factor)
        total_response += (
            mode_weight * inertial_factor**2 * elastic_factor * offset * uniform_mode * offset_mode
        )
        by_elastic += (
            mode_weight * inertial_factor**2 * (stiffer_mode * offset_mode**2 - uniform_mode**2)
        )
        by_inertial += (
            mode_weight
            * elastic_factor**2
            * k4
            * ((stiffer_mode * offset_mode) ** 2 - uniform_mode**2)
        )
    return replace(
        uniform_response,
        response=uniform_response.response + total_response,
        by_elastic=uniform_response.by_elastic + by_elastic,
        by_inertial=uniform_response.by_inertial + by_inertial,
    )


Slopes = dict[str, Callable[[], Complex]]
"""Map from a parameter's name to a function that computes the response's derivative by it."""


def differentiated_response(
    log_s: Complex,
    s_squared: Complex,
    beam: Beam,
    damping: Damping,
    tip_mass_kg: float,
    stiffness_offsets: tuple[float, ...] = (),
) -> tuple[LoadedResponse, Slopes]:
    """Return the torque per angle of a rigidly clamped beam with a tip mass, and its derivatives.

    Parameters
    ----------
    log_s, s_squared : ndarray of complex
        Logarithm and square of the Laplace variable, which is not 0.
    beam, damping
        Parameters of the exact model.
    tip_mass_kg
        Point mass at the tip.
    stiffness_offsets
        As in `LoadedBeam`; no derivative with respect to them is returned.

    Returns
    -------
    response : LoadedResponse
        Coupling torque per motor angle.
    slopes : dict of str to callable
        Functions that compute the derivative with respect to a parameter, by its name in
        `rigd.beam.GRADIENT_NAMES` or ``tip_mass_kg``.
    """
    s_alpha = np.exp(damping.alpha * log_s).astype(np.complex128)
    s_lambda = np.exp(damping.lambda_ * log_s).astype(np.complex128)
    inertial_term = beam.density_over_stiffness * s_squared
    elastic_factor, inertial_factor = (
        1 + damping.zeta * s_alpha,
        inertial_term + damping.gamma * s_lambda,
    )
    response = loaded_response(s_squared, elastic_factor, inertial_factor, beam, tip_mass_kg)
    if stiffness_offsets:
        response = _add_stiffness_offsets(
            response, elastic_factor, inertial_factor, beam, stiffness_offsets
        )
    return response, {
        "zeta": lambda: response.by_elastic * s_alpha,
        "alpha": lambda: response.by_elastic * (damping.zeta * log_s * s_alpha),
        "gamma": lambda: response.by_inertial * s_lambda,
        "lambda": lambda: response.by_inertial * (damping.gamma * log_s * s_lambda),
        "ln_density_over_stiffness": lambda: response.by_inertial * inertial_term,
        "ln_stiffness": lambda: response.response - tip_mass_kg * response.by_mass,
        "tip_mass_kg": lambda: response.by_mass,
    }


@dataclass(frozen=True, slots=True)
class LoadedBeam:
    """Beam with a tip mass on an elastic clamp, uniform or with modal stiffness offsets.

    Attributes
    ----------
    beam : Beam
        Uniform beam without the tip mass.
    damping : Damping
        Internal and external damping of the beam.
    tip_mass_kg : float
        Point mass at the tip.
    root_compliance_rad_per_nm : float
        Rotation of the clamp per torque on the beam's root.
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
    def is_uniform_cantilever(self) -> bool:
        """Whether the beam is uniform, has a free tip and is clamped rigidly."""
        return not (
            self.tip_mass_kg or self.root_compliance_rad_per_nm or any(self.stiffness_offsets)
        )

    def with_frequencies(self, frequency_hz: Sequence[float]) -> "LoadedBeam":
        """Return a beam whose first modes have the given frequencies, by stiffness offsets.

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
        target_rad_s = 2 * math.pi * np.array(frequency_hz)
        offset_beam = LoadedBeam(self.beam, self.damping)
        relative_stiffness = np.ones(z.size)
        for _ in range(2):  # damping shifts the frequencies a little
            present_rad_s = offset_beam.poles(z)[:, 0].imag
            if not bool((present_rad_s > 0).all()):
                raise ValueError("A mode of the beam does not oscillate.")
            relative_stiffness *= (target_rad_s / present_rad_s) ** 2
            density_kg_per_m = self.beam.density_kg_per_m / float(relative_stiffness[0])
            offset_beam = LoadedBeam(
                replace(self.beam, density_kg_per_m=density_kg_per_m),
                self.damping,
                stiffness_offsets=tuple(
                    (relative_stiffness[1:] / relative_stiffness[0] - 1).tolist()
                ),
            )
        return offset_beam

    def transfer(self, s: Complex) -> Complex:
        """Return the coupling torque per motor angle in N·m/rad, in the shape of `s` (not 0)."""
        response = self.rigid_clamp_response(s).response
        return response / (1 + self.root_compliance_rad_per_nm * response)

    def transfer_and_gradient(self, s: Complex, wrt: Sequence[str]) -> tuple[Complex, Complex]:
        """Return the coupling torque per motor angle and its derivatives by parameters.

        Parameters
        ----------
        s
            Laplace variable in rad/s, not 0.
        wrt
            Names of `rigd.beam.GRADIENT_NAMES`, ``tip_mass_kg`` and ``root_compliance_rad_per_nm``.

        Returns
        -------
        transfer : complex ndarray, shape of `s`
            Coupling torque per motor angle in N·m/rad.
        gradient : complex ndarray, shape ``(len(wrt), *shape of s)``
            Its derivative with respect to each parameter.
        """
        at, by = self._response_and_slopes(s)
        clamp_factor = 1 / (1 + self.root_compliance_rad_per_nm * at.response)
        gradient = np.array([by[parameter_name]() for parameter_name in wrt], dtype=np.complex128)
        return at.response * clamp_factor, gradient * clamp_factor * clamp_factor

    def pole_gradients(self, poles_rad_s: Complex, wrt: Sequence[str]) -> Complex:
        """Return the derivatives of poles with respect to parameters, shape (n, len(wrt)).

        The poles are treated as roots of ``1/G + kappa``. At the pole of a beam on a rigid clamp G
        is infinite, but close to the pole the ratios of its derivatives are accurate.

        Parameters
        ----------
        poles_rad_s : ndarray of complex, shape (n,)
            Poles, as returned by `poles`.
        wrt
            Parameter names as for `transfer_and_gradient`. The derivative with respect to a
            parameter that does not affect the poles is 0.
        """
        pole_distance = 0.0 if self.root_compliance_rad_per_nm else _POLE_DISTANCE
        s = poles_rad_s * (1 - pole_distance)
        at, by = self._response_and_slopes(s)
        response_slope = self.derivative_by_s(s, at)
        gradients = np.zeros((s.size, len(wrt)), dtype=np.complex128)
        for gradient_column, parameter_name in zip(gradients.T, wrt, strict=True):
            if parameter_name in by:
                gradient_column[:] = -by[parameter_name]() / response_slope
        return gradients

    def _require_uniform(self) -> None:
        """Raise ValueError if the beam has stiffness offsets."""
        if any(self.stiffness_offsets):
            raise ValueError("Of modes of their own stiffness the shear is not known.")

    def _response_and_slopes(self, s: Complex) -> tuple[LoadedResponse, Slopes]:
        """Return the coupling torque per angle on a rigid clamp, and functions for its derivatives.

        The derivative with respect to the clamp's compliance is that at a compliance of 0.
        """
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
        """Return the tip's slope relative to the root's per motor angle, in the shape of `s`."""
        return self.tip_response(s)[1]

    def tip_response(self, s: Complex) -> tuple[Complex, Complex]:
        """Return the tip's displacement (m/rad) and slope per motor angle, relative to the root.

        Parameters
        ----------
        s
            Laplace variable in rad/s, not 0.
        """
        force_grid, tip = PointForceGrid(s, self.beam, self.damping), self.beam.length_m
        displacement, slope_per_angle = (
            force_grid.per_angle(tip) - tip,
            force_grid.per_angle(tip, 1) - 1,
        )
        elastic_factor, inertial_factor = self.elastic_and_inertial_factors(s)
        z = clamped_free_eigenvalues(1 + len(self.stiffness_offsets))
        tip_slopes = 2 * z * root_shear_ratio(z.size) / tip
        for offset_index, stiffness_offset in enumerate(self.stiffness_offsets, start=1):
            # Mode i contributes -p b / (c k⁴ (1 + d) + p); b is its part of a rigid rotation.
            k4, rotation_part = (
                (z[offset_index] / tip) ** 4,
                2 * (-1) ** offset_index * tip / z[offset_index] ** 2,
            )
            offset_term = inertial_factor * rotation_part * elastic_factor * k4 * stiffness_offset
            offset_term = offset_term / (
                (elastic_factor * k4 + inertial_factor)
                * (elastic_factor * k4 * (1 + stiffness_offset) + inertial_factor)
            )
            displacement = displacement + 2 * offset_term
            slope_per_angle = slope_per_angle + tip_slopes[offset_index] * offset_term
        if self.tip_mass_kg:
            tip_force = self._tip_force_per_angle(s, force_grid)
            displacement = displacement + force_grid.per_force(tip, tip) * tip_force
            slope_per_angle = slope_per_angle + force_grid.per_force(tip, tip, 1) * tip_force
        clamp_factor = 1 / (
            1 + self.root_compliance_rad_per_nm * self.rigid_clamp_response(s).response
        )
        return displacement * clamp_factor, slope_per_angle * clamp_factor

    def _tip_force_per_angle(self, s: Complex, force_grid: PointForceGrid) -> Complex:
        """Return the force in N/rad that the tip mass exerts on the beam per angle of the root."""
        tip, inertial_load = self.beam.length_m, self.tip_mass_kg * s * s
        tip_force: Complex = (
            -inertial_load
            * force_grid.per_angle(tip)
            / (1 + inertial_load * force_grid.per_force(tip, tip))
        )
        return tip_force

    def shear(self, s: Complex) -> Complex:
        """Return the motor's transverse force on the beam per motor angle in N/rad at `s`."""
        self._require_uniform()
        force_grid = PointForceGrid(s, self.beam, self.damping)
        shear_per_angle = force_grid.shear_per_angle()
        if self.tip_mass_kg:
            shear_per_angle = shear_per_angle + force_grid.shear_per_force(
                self.beam.length_m
            ) * self._tip_force_per_angle(s, force_grid)
        if self.root_compliance_rad_per_nm:
            shear_per_angle = shear_per_angle / (
                1 + self.root_compliance_rad_per_nm * self.rigid_clamp_response(s).response
            )
        return shear_per_angle

    def rigid_clamp_response(self, s: Complex) -> LoadedResponse:
        """Return the torque per angle at `s` (rad/s) that the beam would have on a rigid clamp."""
        elastic_factor, inertial_factor = self.elastic_and_inertial_factors(s)
        response = loaded_response(
            s * s, elastic_factor, inertial_factor, self.beam, self.tip_mass_kg
        )
        if not any(self.stiffness_offsets):
            return response
        return _add_stiffness_offsets(
            response, elastic_factor, inertial_factor, self.beam, self.stiffness_offsets
        )

    def residues(self, poles_rad_s: Complex) -> Complex:
        """Return the residues of the coupling torque per angular acceleration at poles.

        The torque per angular acceleration is ``G(s) / s²``. A mode with the pole p, its conjugate
        and the residue r adds ``2 Re(r exp(p t))`` to the torque after a unit change of the angular
        velocity.

        Parameters
        ----------
        poles_rad_s : ndarray of complex, shape (n,)
            Poles, as returned by `poles`.

        Returns
        -------
        ndarray of complex, shape (n,)
            Residue at each pole, in N·m s.
        """
        # On a rigid clamp G is infinite at a pole, but close to it the ratio is accurate.
        pole_distance = 0.0 if self.root_compliance_rad_per_nm else _POLE_DISTANCE
        s = poles_rad_s * (1 - pole_distance)
        at = self.rigid_clamp_response(s)
        residues: Complex = -(at.response**2) / self.derivative_by_s(s, at) / s**2
        return residues

    def elastic_and_inertial_factors(self, s: Complex) -> tuple[Complex, Complex]:
        """Return the elastic factor c and the inertial factor p at `s` (rad/s)."""
        log_s, damping = np.log(s), self.damping
        elastic_factor = 1 + damping.zeta * np.exp(damping.alpha * log_s).astype(np.complex128)
        external = damping.gamma * np.exp(damping.lambda_ * log_s).astype(np.complex128)
        return elastic_factor, self.beam.density_over_stiffness * s * s + external

    def derivative_by_s(self, s: Complex, at: LoadedResponse) -> Complex:
        """Return the derivative by s of the coupling torque per angle on a rigid clamp.

        Parameters
        ----------
        s
            Laplace variable in rad/s, not 0.
        at
            Response on a rigid clamp at `s`, as returned by `rigid_clamp_response`.
        """
        log_s, damping = np.log(s), self.damping
        internal = damping.zeta * damping.alpha * np.exp(damping.alpha * log_s)
        external = damping.gamma * damping.lambda_ * np.exp(damping.lambda_ * log_s)
        inertial_factor = 2 * self.beam.density_over_stiffness * s * s + external
        by_log_s: Complex = (
            at.by_elastic * internal
            + at.by_inertial * inertial_factor
            + 2 * self.tip_mass_kg * at.by_mass
        )
        return by_log_s / s

    def poles(self, z: Real, near_rad_s: Complex | None = None) -> Complex:
        """Return both poles of each mode with locked hub, shape (len(z), 2), in rad/s.

        The poles are followed from those of the beam on a rigid clamp without a tip mass while mass
        and compliance grow to their values.

        Parameters
        ----------
        z : ndarray
            Clamped-free eigenvalues of the modes.
        near_rad_s : ndarray of complex, shape (len(z),), optional
            Expected poles in the upper half plane in rad/s, one per mode, from which the search
            starts.

        Returns
        -------
        ndarray of complex
            Conjugate pairs (positive frequency first) or two real poles. A row is NaN if the pole
            could not be followed.
        """
        if near_rad_s is not None and bool((near_rad_s.imag > 0).all()):
            upper_poles = self._newton_roots(near_rad_s, _CLOSE_START_TOLERANCE, zeros=False)
            if bool((np.abs(upper_poles / near_rad_s - 1) < SAME_ROOT_TOLERANCE).all()):
                return np.column_stack([upper_poles, upper_poles.conj()])
        return self._followed_roots(z, zeros=False)

    def zeros(self, z: Real) -> Complex:
        """Return the zeros of the coupling torque per angle in rad/s, in pairs as in `poles`.

        Parameters
        ----------
        z : ndarray
            Roots of ``tan z = tanh z``, which determine the zeros of the uniform beam.
        """
        return self._followed_roots(z, zeros=True)

    def _followed_roots(self, z: Real, *, zeros: bool) -> Complex:
        """Return poles or zeros, followed from those of the uniform beam on a rigid clamp.

        A row is NaN if the path was lost.
        """
        stiffness_offsets = np.array(self.stiffness_offsets)
        if not zeros and stiffness_offsets.size:
            # On a rigid clamp the poles are exactly those of the stiffness k⁴ (1 + d).
            z = z.copy()
            z[1 : 1 + stiffness_offsets.size] *= (1 + stiffness_offsets[: z.size - 1]) ** 0.25
        roots = poles_for_eigenvalues(z, self.beam, self.damping).astype(np.complex128)
        is_rigid = self.tip_mass_kg == 0 and self.root_compliance_rad_per_nm == 0
        if is_rigid and not (zeros and stiffness_offsets.any()):
            return roots
        has_root = ~np.isnan(roots[:, 0])
        # One of a conjugate pair suffices; without oscillation both have to be found.
        oscillating = roots[has_root][:, 0].imag != 0
        second_real_poles = roots[has_root][~oscillating][:, 1]
        current_roots = np.concatenate([roots[has_root][:, 0], second_real_poles])
        current_roots *= 1 - _START_POLE_DISTANCE  # G is infinite at an undamped pole
        # Relative to the beam's own values: a change that moves the poles little needs few steps.
        relative_change = self.tip_mass_kg / (self.beam.density_kg_per_m * self.beam.length_m)
        stiffness_nm_per_rad = self.beam.bending_stiffness_n_m2 / self.beam.length_m
        relative_change = max(
            relative_change, self.root_compliance_rad_per_nm * stiffness_nm_per_rad
        )
        if zeros:
            relative_change = max(
                relative_change, float(np.abs(stiffness_offsets).max(initial=0.0))
            )
        step_count = min(max(math.ceil(relative_change / _CHANGE_PER_STEP), 2), _MAX_HOMOTOPY_STEPS)
        previous_roots = current_roots
        for step_number in range(1, step_count + 1):
            fraction = step_number / step_count
            partial_beam = LoadedBeam(
                self.beam,
                self.damping,
                fraction * self.tip_mass_kg,
                fraction * self.root_compliance_rad_per_nm,
                tuple((fraction if zeros else 1.0) * stiffness_offsets),
            )
            is_last_step = step_number == step_count
            start_roots = 2 * current_roots - previous_roots if step_number > 1 else current_roots
            previous_roots, current_roots = (
                current_roots,
                partial_beam._newton_roots(
                    start_roots,
                    _NEWTON_TOLERANCE if is_last_step else _INTERMEDIATE_TOLERANCE,
                    zeros=zeros,
                ),
            )
        first_roots = current_roots[: oscillating.size]
        second_roots = first_roots.conj()
        second_roots[~oscillating] = current_roots[oscillating.size :]
        roots[has_root] = np.column_stack([first_roots, second_roots])
        return roots

    def _newton_roots(self, s: Complex, step_tolerance: float, *, zeros: bool) -> Complex:
        """Return the roots of ``1/G + kappa``, or with `zeros` of G, that Newton's method finds.

        `s` has the start values; `step_tolerance` is the relative length of the last step. The
        result is NaN where no root is found near its start.
        """
        start_roots = s
        with np.errstate(all="ignore"):
            for _ in range(_MAX_NEWTON_STEPS):
                at = self.rigid_clamp_response(s)
                newton_step = at.response / self.derivative_by_s(s, at)
                newton_step *= -1 if zeros else 1 + self.root_compliance_rad_per_nm * at.response
                s = s + newton_step
                if not np.nanmax(np.abs(newton_step / s), initial=0.0) > step_tolerance:
                    break
            # Far from any root every step is short, too.
            has_converged = (np.abs(newton_step) < max(step_tolerance, 1e-9) * np.abs(s)) & (
                np.abs(s) < _MAX_ROOT_TO_START_RATIO * np.abs(start_roots)
            )
            return np.where(has_converged, s, np.nan + 0j)


def _response_functions(q: Complex) -> tuple[Complex, Complex, Complex, Complex]:
    """Return the loaded beam's dimensionless functions F and U at `q`, and q F' and q U'."""
    q = np.asarray(q, dtype=np.complex128)
    f, u, b = np.empty((3, *q.shape), dtype=np.complex128)
    is_small = np.abs(q) < _SERIES_LIMIT
    if is_small.any():
        small_q = q[is_small]
        series_divisor, *series_numerators = np.polynomial.polynomial.polyval(
            small_q, _SERIES_COEFFICIENTS
        )
        for out, series_numerator in zip((f, u, b), series_numerators, strict=True):
            out[is_small] = small_q * series_numerator / series_divisor
    if not is_small.all():
        for out, function_values in zip((f, u, b), _scaled_functions(q[~is_small]), strict=True):
            out[~is_small] = function_values
    return f, u, 0.25 * (f + u + f * f), 0.5 * (u + b) + 0.25 * u * f


def _scaled_functions(q: Complex) -> tuple[Complex, Complex, Complex]:
    """Return F, U and z² B at large `q`, computed from decaying exponentials only."""
    # F, U and B are real functions of q: values below the real axis mirror those above it.
    lower_half_plane = q.imag < 0
    z = np.sqrt(np.sqrt(np.where(lower_half_plane, q.conj(), q)))
    decay, rotation = np.exp(-z), np.exp(1j * z)
    a, b = decay * decay, rotation * rotation
    reciprocal = 1 / (4 * decay * rotation + (1 + a) * (1 + b))
    sine, cosine = 1j * (1 - b) * (1 + a), (1 + b) * (1 - a)
    scaled_values = (
        z * (sine - cosine) * reciprocal,
        2j * z**2 * (1 - a) * (1 - b) * reciprocal,
        z**3 * (sine + cosine) * reciprocal,
    )
    scaled_f, scaled_u, scaled_b = (
        np.where(lower_half_plane, function_values.conj(), function_values)
        for function_values in scaled_values
    )
    return scaled_f, scaled_u, scaled_b
