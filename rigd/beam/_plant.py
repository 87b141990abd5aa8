"""Plant: beam, damping, ends and torque channel, with response, poles and zeros."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rigd.beam._model import GRADIENT_NAMES, Beam, Damping, TransferGrid
from rigd.beam._modes import (
    SAME_ROOT_TOLERANCE,
    clamped_free_eigenvalues,
    pole_gradient,
    poles_for_eigenvalues,
    root_shear_ratio,
)
from rigd.beam._parameters import (
    BEAM_PARAMETERS,
    DAMPING_PARAMETERS,
    END_PARAMETERS,
    FILTER_PARAMETERS,
    OFFSET_PREFIX,
    parameter_named,
)
from rigd.beam._plant_roots import CLOSE_START_TOLERANCE, Pole, follow_roots, newton_roots
from rigd.beam._point_force import PointForceGrid
from rigd.beam._tip_mass import (
    DerivativeFunctions,
    LoadedResponse,
    add_stiffness_offsets,
    differentiated_response,
    loaded_response,
    uniform_tip_response,
)

RealArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


_BUTTERWORTH_RECIPROCAL_Q: Final = 2**0.5
"""Reciprocal quality factor of a second-order Butterworth filter."""
_PLANT_PARAMETERS: Final = (
    "delay_s",
    "tool_inertia_kg_m2",
    "root_compliance_rad_per_nm",
    "tip_mass_kg",
    *FILTER_PARAMETERS,
)
"""Names of the parameters that are attributes of `Plant`."""
_ATTRIBUTE_NAMES: Final = {"lambda": "lambda_"}
"""Map from a damping parameter's name to its attribute, if the two names differ."""

_RELATIVE_POLE_DISTANCE = 1e-8
"""Relative distance from a pole at which the response and its derivatives are evaluated.

At the pole itself of a rigidly clamped beam they are infinite.

The distance is the square root of the relative rounding error of G there."""


@dataclass(frozen=True, slots=True)
class Plant:
    """Beam with damping, ends and torque channel: all that determines the torque for an angle.

    Examples
    --------
    >>> import numpy as np
    >>> from rigd.beam import Beam, Damping, Plant, clamped_free_eigenvalues
    >>> beam = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.0903)
    >>> plant = Plant(beam, Damping(zeta=7e-5), tip_mass_kg=1e-4)
    >>> poles = plant.poles(clamped_free_eigenvalues(2))[:, 0]
    >>> print(np.round(poles.imag / (2 * np.pi), 2))
    [ 2.45 15.39]
    """

    beam: Beam
    """Uniform beam without the tip mass."""
    damping: Damping
    """Internal and external damping of the beam."""
    delay_s: float = 0.0
    """Delay of the measured torque relative to the measured angle."""
    tool_inertia_kg_m2: float = 0.0
    """Inertia between torque sensor and beam. It is on the motor's side of the clamp's compliance:
    the bolted parts are stiff, and the grip on the beam yields."""
    stiffness_offsets: tuple[float, ...] = ()
    """Relative differences of the stiffness of modes 2, 3, … from the uniform beam's. With them the
    coupling torque (`transfer`, `poles`, `zeros`) and the motion of the tip are defined, but not
    the shear, and not together with a tip mass."""
    root_compliance_rad_per_nm: float = 0.0
    """Rotation of the clamp per torque on the beam's root."""
    tip_mass_kg: float = 0.0
    """Point mass at the beam's tip."""
    filter_time_constant_s: float = 0.0
    """Time constant of a first-order low-pass filter in the torque channel."""
    second_order_filter_time_constant_s: float = 0.0
    """Reciprocal corner frequency (rad/s) of a second-order Butterworth filter in the torque
    channel."""

    def __post_init__(self) -> None:
        if self.tip_mass_kg and any(self.stiffness_offsets):
            raise ValueError("A tip mass and modes of their own stiffness exclude each other.")

    @classmethod
    def from_parameters(cls, length_m: float, values: Mapping[str, float]) -> "Plant":
        """Return the plant with given parameters; absent ones are 0, orders of damping 1.

        Parameters
        ----------
        length_m
            Length of the beam.
        values
            Values by the names of `PARAMETERS`, with both of `BEAM_PARAMETERS`.

        Raises
        ------
        ValueError
            If a name is not that of a plant's parameter.
        """
        return cls(Beam(length_m, 1.0, 1.0), Damping()).with_parameters(values)

    def with_parameters(self, values: Mapping[str, float]) -> "Plant":
        """Return the plant with other values of some parameters.

        Parameters
        ----------
        values
            Values by the names of `parameters`. A change of the ratio ``density_over_stiffness``
            leaves the bending stiffness unchanged, and vice versa.

        Raises
        ------
        ValueError
            If a name is not that of a plant's parameter.
        """
        attribute_changes: dict[str, Any] = {}
        damping_changes: dict[str, float] = {}
        stiffness_offset_by_mode = dict(enumerate(self.stiffness_offsets, start=2))
        for name, value in values.items():
            if name in DAMPING_PARAMETERS:
                damping_changes[_ATTRIBUTE_NAMES.get(name, name)] = value
            elif name in _PLANT_PARAMETERS:
                attribute_changes[name] = value
            elif name.startswith(OFFSET_PREFIX):
                stiffness_offset_by_mode[int(name.removeprefix(OFFSET_PREFIX))] = value
            elif name not in BEAM_PARAMETERS:
                raise ValueError(f"{name!r} is not a parameter of a plant.")
        if not values.keys().isdisjoint(BEAM_PARAMETERS):
            density_over_stiffness, stiffness_n_m2 = (
                values.get(name, getattr(self.beam, name)) for name in BEAM_PARAMETERS
            )
            attribute_changes["beam"] = Beam(
                self.beam.length_m, density_over_stiffness * stiffness_n_m2, stiffness_n_m2
            )
        if damping_changes:
            attribute_changes["damping"] = replace(self.damping, **damping_changes)
        attribute_changes["stiffness_offsets"] = tuple(
            stiffness_offset_by_mode.get(mode_number, 0.0)
            for mode_number in range(2, max(stiffness_offset_by_mode, default=1) + 1)
        )
        return replace(self, **attribute_changes)

    @property
    def parameters(self) -> dict[str, float]:
        """Values of the plant's parameters by name.

        The names are zeta, alpha, gamma, lambda, `BEAM_PARAMETERS`, delay and tool inertia, those
        of the stiffness offsets, and those of ends and filters whose value is not 0.
        """
        return {
            **{
                name: getattr(self.damping, _ATTRIBUTE_NAMES.get(name, name))
                for name in DAMPING_PARAMETERS
            },
            **{name: getattr(self.beam, name) for name in BEAM_PARAMETERS},
            "delay_s": self.delay_s,
            "tool_inertia_kg_m2": self.tool_inertia_kg_m2,
            **{
                f"{OFFSET_PREFIX}{mode_number}": stiffness_offset
                for mode_number, stiffness_offset in enumerate(self.stiffness_offsets, start=2)
            },
            **{name: value for name, value in self.optional_parameters.items() if value},
        }

    @property
    def optional_parameters(self) -> dict[str, float]:
        """Values of ends and filters by name, zeros included."""
        return {name: getattr(self, name) for name in _PLANT_PARAMETERS[2:]}

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> "Plant":
        """Return the plant that a JSON object describes, the inverse of `as_dict`.

        Parameters
        ----------
        document
            Object with ``beam``, with the keys of `Beam`, and ``damping``, with zeta, alpha, gamma
            and lambda; delay, tool inertia, ends, filters and ``stiffness_offsets`` are optional.
            Other keys are ignored.

        Raises
        ------
        KeyError
            If a key is missing.
        TypeError, ValueError, AttributeError
            If a value is not a number.
        """
        beam, damping = document["beam"], document["damping"]
        return cls(
            Beam(**{field.name: float(beam[field.name]) for field in fields(Beam)}),
            Damping(*(float(damping[name]) for name in DAMPING_PARAMETERS)),
            stiffness_offsets=tuple(map(float, document.get("stiffness_offsets", ()))),
            **{name: float(document.get(name, 0.0)) for name in _PLANT_PARAMETERS},
        )

    def raise_if_invalid(self) -> None:
        """Raise ValueError if a parameter is not finite or out of its range."""
        for name, value in asdict(self.beam).items():
            if not (value > 0.0 and math.isfinite(value)):
                raise ValueError(f"{name} = {value}")
        for name, value in self.parameters.items():
            if not (parameter_named(name).is_valid(value) and math.isfinite(value)):
                raise ValueError(f"{name} = {value}")

    def as_dict(self) -> dict[str, Any]:
        """Return the plant as a JSON object, which `from_dict` reads."""
        return asdict(self) | {
            "damping": {name: self.parameters[name] for name in DAMPING_PARAMETERS}
        }

    @property
    def is_uniform_cantilever(self) -> bool:
        """Whether the beam is uniform, has a free tip and is clamped rigidly."""
        return not (
            self.tip_mass_kg or self.root_compliance_rad_per_nm or any(self.stiffness_offsets)
        )

    def with_frequencies(self, frequency_hz: Sequence[float]) -> "Plant":
        """Return a plant whose first modes have the given frequencies, by stiffness offsets.

        It has no tip mass and a rigid clamp.

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
        target_frequency_rad_s = 2 * math.pi * np.array(frequency_hz)
        offset_plant = replace(
            self, stiffness_offsets=(), root_compliance_rad_per_nm=0.0, tip_mass_kg=0.0
        )
        relative_stiffness = np.ones(z.size)
        for _ in range(2):  # damping shifts the frequencies a little
            present_frequency_rad_s = offset_plant.poles(z)[:, 0].imag
            if not bool((present_frequency_rad_s > 0).all()):
                raise ValueError("A mode of the beam does not oscillate.")
            relative_stiffness *= (target_frequency_rad_s / present_frequency_rad_s) ** 2
            density_kg_per_m = self.beam.density_kg_per_m / float(relative_stiffness[0])
            offset_plant = replace(
                offset_plant,
                beam=replace(self.beam, density_kg_per_m=density_kg_per_m),
                stiffness_offsets=tuple(
                    (relative_stiffness[1:] / relative_stiffness[0] - 1).tolist()
                ),
            )
        return offset_plant

    def transfer(self, s: ArrayLike) -> ComplexArray:
        """Return the torque on the beam per motor angle in N·m/rad, in the shape of `s` (not 0)."""
        s = np.asarray(s, dtype=np.complex128)
        if self.is_uniform_cantilever:
            return TransferGrid(s).evaluate(self.beam, self.damping)
        response = self.rigid_clamp_response(s).response
        return response / (1 + self.root_compliance_rad_per_nm * response)

    def transfer_and_gradient(
        self, s: ArrayLike, gradient_parameters: Sequence[str]
    ) -> tuple[ComplexArray, ComplexArray]:
        """Return the coupling torque per motor angle and its derivatives for given parameters.

        Parameters
        ----------
        s
            Laplace variable in rad/s, not 0.
        gradient_parameters
            Names of `rigd.beam.GRADIENT_NAMES`, ``tip_mass_kg`` and ``root_compliance_rad_per_nm``.

        Returns
        -------
        transfer : complex ndarray, shape of `s`
            Coupling torque per motor angle in N·m/rad.
        gradient : complex ndarray, shape ``(len(gradient_parameters), *shape of s)``
            Derivative of `transfer` with respect to each parameter.
        """
        s = np.asarray(s, dtype=np.complex128)
        if self.is_uniform_cantilever and set(gradient_parameters) <= set(GRADIENT_NAMES):
            return TransferGrid(s).evaluate_with_gradient(
                self.beam, self.damping, gradient_parameters
            )
        clamped_response, derivative_functions = self._response_and_slopes(s)
        clamp_factor = 1 / (1 + self.root_compliance_rad_per_nm * clamped_response.response)
        gradient = np.array(
            [derivative_functions[parameter_name]() for parameter_name in gradient_parameters],
            dtype=np.complex128,
        )
        return clamped_response.response * clamp_factor, gradient * clamp_factor * clamp_factor

    def channel_response(self, s: ArrayLike) -> ComplexArray:
        """Return the dimensionless transfer function of the torque channel's delay and filters.

        Parameters
        ----------
        s
            Laplace variable in rad/s.
        """
        s = np.asarray(s, dtype=np.complex128)
        response: ComplexArray = np.exp(-self.delay_s * s)
        for linear_coefficient, quadratic_coefficient in self.filter_denominators:
            response /= 1 + s * (linear_coefficient + s * quadratic_coefficient)
        return response

    @property
    def filter_denominators(self) -> tuple[tuple[float, float], ...]:
        """Coefficients of s and s² in the denominators of the torque channel's filters."""
        first_s, second_s = self.filter_time_constant_s, self.second_order_filter_time_constant_s
        filter_denominators = (
            (first_s, 0.0),
            (_BUTTERWORTH_RECIPROCAL_Q * second_s, second_s * second_s),
        )
        return tuple(lag for lag in filter_denominators if any(lag))

    def pole_gradients(
        self, poles_rad_s: ComplexArray, gradient_parameters: Sequence[str]
    ) -> ComplexArray:
        """Return the derivatives of n poles with respect to k parameters, shape (n, k).

        The poles are treated as roots of ``1/G + kappa``. At the pole of a beam on a rigid clamp G
        is infinite, but close to the pole the ratios of its derivatives are accurate.

        Parameters
        ----------
        poles_rad_s : ndarray of complex, shape (n,)
            Poles, as returned by `poles`.
        gradient_parameters
            Parameter names as for `transfer_and_gradient`. The derivative with respect to a
            parameter that does not affect the poles is 0.
        """
        pole_distance = 0.0 if self.root_compliance_rad_per_nm else _RELATIVE_POLE_DISTANCE
        s = poles_rad_s * (1 - pole_distance)
        clamped_response, derivative_functions = self._response_and_slopes(s)
        response_slope = self.derivative_by_s(s, clamped_response)
        gradients = np.zeros((s.size, len(gradient_parameters)), dtype=np.complex128)
        for gradient_column, parameter_name in zip(gradients.T, gradient_parameters, strict=True):
            if parameter_name in derivative_functions:
                gradient_column[:] = -derivative_functions[parameter_name]() / response_slope
        return gradients

    def _require_uniform(self) -> None:
        """Raise ValueError if the beam has stiffness offsets."""
        if any(self.stiffness_offsets):
            raise ValueError("The shear of modes with their own stiffness is not known.")

    def _response_and_slopes(self, s: ComplexArray) -> tuple[LoadedResponse, DerivativeFunctions]:
        """Return the coupling torque per angle on a rigid clamp, and functions for its derivatives.

        The derivative with respect to the clamp's compliance is that at a compliance of 0.
        """
        clamped_response, derivative_functions = differentiated_response(
            np.log(s),
            s * s,
            self.beam,
            self.damping,
            self.tip_mass_kg,
            self.stiffness_offsets,
        )
        return clamped_response, derivative_functions | {
            "root_compliance_rad_per_nm": lambda: (
                -clamped_response.response * clamped_response.response
            )
        }

    def tip_slope(self, s: ArrayLike) -> ComplexArray:
        """Return the slope of the tip relative to the root per motor angle, in the shape of `s`."""
        return self.tip_response(s)[1]

    def tip_response(self, s: ArrayLike) -> tuple[ComplexArray, ComplexArray]:
        """Return the tip's displacement (m/rad) and slope per motor angle, relative to the root.

        Parameters
        ----------
        s
            Laplace variable in rad/s, not 0.
        """
        s = np.asarray(s, dtype=np.complex128)
        if self.is_uniform_cantilever:
            displacement, slope_per_angle = uniform_tip_response(self.beam, self.damping, s)
            displacement -= self.beam.length_m
            slope_per_angle -= 1
            return displacement, slope_per_angle
        force_grid, tip_m = PointForceGrid(s, self.beam, self.damping), self.beam.length_m
        displacement, slope_per_angle = (
            force_grid.displacement_per_angle(tip_m) - tip_m,
            force_grid.displacement_per_angle(tip_m, 1) - 1,
        )
        elastic_factor, inertial_factor = self.elastic_and_inertial_factors(s)
        z = clamped_free_eigenvalues(1 + len(self.stiffness_offsets))
        tip_slopes = 2 * z * root_shear_ratio(z.size) / tip_m
        for offset_index, stiffness_offset in enumerate(self.stiffness_offsets, start=1):
            # Mode i contributes -p b / (c k⁴ (1 + d) + p); b is its part of a rigid rotation.
            k4, rotation_part = (
                (z[offset_index] / tip_m) ** 4,
                2 * (-1) ** offset_index * tip_m / z[offset_index] ** 2,
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
            displacement = (
                displacement + force_grid.displacement_per_force(tip_m, tip_m) * tip_force
            )
            slope_per_angle = (
                slope_per_angle + force_grid.displacement_per_force(tip_m, tip_m, 1) * tip_force
            )
        clamp_factor = 1 / (
            1 + self.root_compliance_rad_per_nm * self.rigid_clamp_response(s).response
        )
        return displacement * clamp_factor, slope_per_angle * clamp_factor

    def _tip_force_per_angle(self, s: ComplexArray, force_grid: PointForceGrid) -> ComplexArray:
        """Return the force in N/rad that the tip mass exerts on the beam per angle of the root."""
        tip_m, inertial_load = self.beam.length_m, self.tip_mass_kg * s * s
        tip_force: ComplexArray = (
            -inertial_load
            * force_grid.displacement_per_angle(tip_m)
            / (1 + inertial_load * force_grid.displacement_per_force(tip_m, tip_m))
        )
        return tip_force

    def shear_response(self, s: ComplexArray) -> ComplexArray:
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

    def rigid_clamp_response(self, s: ComplexArray) -> LoadedResponse:
        """Return the torque per angle at `s` (rad/s) that the beam would have on a rigid clamp."""
        elastic_factor, inertial_factor = self.elastic_and_inertial_factors(s)
        response = loaded_response(
            s * s, elastic_factor, inertial_factor, self.beam, self.tip_mass_kg
        )
        if not any(self.stiffness_offsets):
            return response
        return add_stiffness_offsets(
            response, elastic_factor, inertial_factor, self.beam, self.stiffness_offsets
        )

    def residues(self, poles_rad_s: ComplexArray) -> ComplexArray:
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
        pole_distance = 0.0 if self.root_compliance_rad_per_nm else _RELATIVE_POLE_DISTANCE
        s = poles_rad_s * (1 - pole_distance)
        clamped_response = self.rigid_clamp_response(s)
        residues: ComplexArray = (
            -(clamped_response.response**2) / self.derivative_by_s(s, clamped_response) / s**2
        )
        return residues

    def elastic_and_inertial_factors(self, s: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Return the elastic factor c and the inertial factor p at `s` (rad/s)."""
        log_s, damping = np.log(s), self.damping
        elastic_factor = 1 + damping.zeta * np.exp(damping.alpha * log_s).astype(np.complex128)
        external_term = damping.gamma * np.exp(damping.lambda_ * log_s).astype(np.complex128)
        return elastic_factor, self.beam.density_over_stiffness * s * s + external_term

    def derivative_by_s(self, s: ComplexArray, clamped_response: LoadedResponse) -> ComplexArray:
        """Return dG/ds, with G the coupling torque per motor angle of the beam on a rigid clamp.

        Parameters
        ----------
        s
            Laplace variable in rad/s, not 0.
        clamped_response
            Response on a rigid clamp at `s`, as returned by `rigid_clamp_response`.
        """
        log_s, damping = np.log(s), self.damping
        internal_term = damping.zeta * damping.alpha * np.exp(damping.alpha * log_s)
        external_term = damping.gamma * damping.lambda_ * np.exp(damping.lambda_ * log_s)
        inertial_factor = 2 * self.beam.density_over_stiffness * s * s + external_term
        slope_by_log_s: ComplexArray = (
            clamped_response.slope_by_elastic_factor * internal_term
            + clamped_response.slope_by_inertial_factor * inertial_factor
            + 2 * self.tip_mass_kg * clamped_response.slope_by_mass
        )
        return slope_by_log_s / s

    def poles(self, z: RealArray, expected_roots_rad_s: ComplexArray | None = None) -> ComplexArray:
        """Return both poles of each mode with locked hub, shape (len(z), 2), in rad/s.

        The poles are followed from those of the beam on a rigid clamp without a tip mass while mass
        and compliance grow to their values.

        Parameters
        ----------
        z : ndarray
            Clamped-free eigenvalues of the modes.
        expected_roots_rad_s : ndarray of complex, shape (len(z),), optional
            Expected poles in the upper half plane in rad/s, one per mode, from which the search
            starts.

        Returns
        -------
        ndarray of complex
            Conjugate pairs (positive frequency first) or two real poles. A row is NaN if the pole
            could not be followed.
        """
        if expected_roots_rad_s is not None and bool((expected_roots_rad_s.imag > 0).all()):
            upper_poles = self._newton_roots(
                expected_roots_rad_s, CLOSE_START_TOLERANCE, find_zeros=False
            )
            if bool((np.abs(upper_poles / expected_roots_rad_s - 1) < SAME_ROOT_TOLERANCE).all()):
                return np.column_stack([upper_poles, upper_poles.conj()])
        return self._follow_roots(z, find_zeros=False)

    def zeros(self, z: RealArray) -> ComplexArray:
        """Return the zeros of the coupling torque per angle in rad/s, in pairs as in `poles`.

        Parameters
        ----------
        z : ndarray
            Roots of ``tan z = tanh z``, which determine the zeros of the uniform beam.
        """
        return self._follow_roots(z, find_zeros=True)

    def _follow_roots(self, z: RealArray, *, find_zeros: bool) -> ComplexArray:
        """Return poles or zeros, followed from those of the uniform beam with eigenvalues `z`."""
        stiffness_offsets = np.array(self.stiffness_offsets)
        if not find_zeros and stiffness_offsets.size:
            # On a rigid clamp the poles are exactly those of the stiffness k⁴ (1 + d).
            z = z.copy()
            z[1 : 1 + stiffness_offsets.size] *= (1 + stiffness_offsets[: z.size - 1]) ** 0.25
        roots = poles_for_eigenvalues(z, self.beam, self.damping).astype(np.complex128)
        has_ideal_ends = self.tip_mass_kg == 0 and self.root_compliance_rad_per_nm == 0
        if has_ideal_ends and not (find_zeros and stiffness_offsets.any()):
            return roots
        relative_change = self.tip_mass_kg / (self.beam.density_kg_per_m * self.beam.length_m)
        stiffness_nm_per_rad = self.beam.bending_stiffness_n_m2 / self.beam.length_m
        relative_change = max(
            relative_change, self.root_compliance_rad_per_nm * stiffness_nm_per_rad
        )
        if find_zeros:
            relative_change = max(
                relative_change, float(np.abs(stiffness_offsets).max(initial=0.0))
            )

        def roots_near(
            change_fraction: float, start_roots: ComplexArray, step_tolerance: float
        ) -> ComplexArray:
            partial_plant = replace(
                self,
                tip_mass_kg=change_fraction * self.tip_mass_kg,
                root_compliance_rad_per_nm=change_fraction * self.root_compliance_rad_per_nm,
                stiffness_offsets=tuple(
                    (change_fraction if find_zeros else 1.0) * stiffness_offsets
                ),
            )
            return partial_plant._newton_roots(start_roots, step_tolerance, find_zeros=find_zeros)

        return follow_roots(roots, relative_change, roots_near)

    def _newton_roots(
        self, s: ComplexArray, step_tolerance: float, *, find_zeros: bool
    ) -> ComplexArray:
        """Return the roots near `s` of ``1/G + kappa``, or of G if `find_zeros` is true."""

        def newton_step(s: ComplexArray) -> ComplexArray:
            clamped_response = self.rigid_clamp_response(s)
            step_factor = (
                -1
                if find_zeros
                else 1 + self.root_compliance_rad_per_nm * clamped_response.response
            )
            newton_step_rad_s: ComplexArray = (
                clamped_response.response / self.derivative_by_s(s, clamped_response) * step_factor
            )
            return newton_step_rad_s

        return newton_roots(newton_step, s, step_tolerance)

    def mode_poles(
        self,
        mode_count: int,
        gradient_parameters: Sequence[str] = (),
        expected_roots_rad_s: Sequence[complex] = (),
    ) -> tuple[Pole, ...]:
        """Return the poles of the first modes, with their derivatives for given parameters.

        A mode for which no pole is found is left out.

        Parameters
        ----------
        mode_count
            Number of modes.
        gradient_parameters
            Names of parameters as for `transfer_and_gradient`. The derivative with respect to a
            parameter that does not affect the poles is 0.
        expected_roots_rad_s
            Approximate poles in the order of the modes, if all are known.
        """
        start_poles = (
            np.array(expected_roots_rad_s) if len(expected_roots_rad_s) == mode_count > 0 else None
        )
        z = clamped_free_eigenvalues(mode_count)
        has_end_parameters = bool(self.tip_mass_kg or self.root_compliance_rad_per_nm)
        if has_end_parameters:
            pole_pairs = self.poles(z, start_poles)
        else:
            # On a rigid clamp the poles are exactly those of the stiffness k⁴ (1 + d).
            for mode_index, stiffness_offset in enumerate(
                self.stiffness_offsets[: mode_count - 1], start=1
            ):
                z[mode_index] *= (1 + stiffness_offset) ** 0.25
            pole_pairs = poles_for_eigenvalues(z, self.beam, self.damping, start_poles).astype(
                np.complex128, copy=False
            )
        modes_and_poles = [
            (mode_index, complex(pole))
            for mode_index, pole_pair in enumerate(pole_pairs)
            if not np.isnan(pole_pair).any()
            for pole in pole_pair[: 1 if pole_pair[0].imag else 2]
        ]
        if has_end_parameters or not set(END_PARAMETERS).isdisjoint(gradient_parameters):
            poles_rad_s = np.array([pole for _, pole in modes_and_poles], dtype=np.complex128)
            derivatives = [*self.pole_gradients(poles_rad_s, gradient_parameters)]
        else:
            k4_per_m4 = (z / self.beam.length_m) ** 4
            derivatives = [
                pole_gradient(
                    pole, float(k4_per_m4[mode_index]), self.beam, self.damping, gradient_parameters
                )
                for mode_index, pole in modes_and_poles
            ]
        return tuple(
            Pole(mode_index + 1, pole, derivative.astype(np.complex128, copy=False))
            for (mode_index, pole), derivative in zip(modes_and_poles, derivatives, strict=True)
        )
