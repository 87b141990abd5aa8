"""First-order change of the torque by air drag if the beam or the drag law changes.

The torque by drag is not linear in the motion, so no frequency response function describes it. In a
fit it is computed for one beam and drag law and removed from the measured torque. If beam or drag
law change, the torque changes linearly (`DragExpansion`) with

* the poles of the modes, on which the motion near a resonance depends,
* the external damping ``gamma s^lambda`` at these poles, since it also drives the modes,
* the logarithm of the mass per length, which the force has to move,
* the delay between the channels,
* the drag itself.

The first four follow from a fit's unknowns. The drag is a free parameter: its spectra are projected
out like those of a free decay. Fits and computations of the drag torque alternate until they agree.

Without drag a resonance peak grows without limit as the damping falls. With drag it hardly grows:
to second order in a pole, the changes of the linear torque and of the torque by drag nearly cancel.
The linear torque is therefore expanded to first order in the poles, too: its change beyond first
order is subtracted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify.drag_torque import LOWEST_MODE_INDICES
from rigd.beam import BEAM_PARAMETERS

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from analysis.identify.drag_torque import DragLaw, DragResponse
    from rigd.beam import Plant, Pole

    RealArray = NDArray[np.float64]
    ComplexArray = NDArray[np.complex128]

_EXTERNAL_PARAMETERS: Final = ("gamma", "lambda")
"""Parameters of the external damping."""


@dataclass(frozen=True, slots=True, eq=False)
class DragExpansion:
    """First-order expansion of the drag torque about one beam and drag, as spectra in the band.

    Attributes
    ----------
    plant : Plant
        Rig and beam for which the drag torque was removed from the record.
    law : DragLaw
        Drag law for which the drag torque was removed from the record.
    response : DragResponse
        Response of this beam to drag.
    band_spectrum : callable
        Function from torque samples, at the times of the angle, to their spectrum in the band.
    pole_derivatives : dict of int to ndarray of complex, shape (2, K)
        Derivatives by the real and the imaginary part of the upper pole of each mode.
    external_damping_derivatives : ndarray of complex, shape (2, 2, K)
        Derivatives by the external damping that drives each of the two lowest modes, as in
        `DragTorque`.
    ln_density_derivative, delay_derivative : ndarray of complex, shape (K,)
        Derivatives by ln(mass per length) and by the delay of the torque.
    law_derivatives : ndarray of complex, shape (2, K)
        Derivatives by `DragLaw.constant_m` and `DragLaw.decreasing_coefficient`.
    mean_speed_m_s, top_speed_m_s : float
        Mean and highest speed of the beam, as in `DragTorque`.
    """

    plant: Plant
    law: DragLaw
    response: DragResponse
    band_spectrum: Callable[[RealArray], ComplexArray]
    pole_derivatives: dict[int, ComplexArray]
    external_damping_derivatives: ComplexArray
    ln_density_derivative: ComplexArray
    delay_derivative: ComplexArray
    law_derivatives: ComplexArray
    mean_speed_m_s: float
    top_speed_m_s: float

    def torque_change_to(
        self,
        plant: Plant,
        poles: Sequence[Pole],
        parameter_names: Sequence[str],
        parameter_slopes: RealArray,
    ) -> tuple[ComplexArray, ComplexArray]:
        """Return the change of the drag torque if another beam replaces this one.

        The spectrum of the change in the band, shape (K,), is returned with its derivatives by the
        k unknowns of the other beam, shape (k, K). `plant` is the rig with the other beam, and
        `poles` are the poles of that beam, differentiated by its unknowns. `parameter_slopes`,
        shape (len(parameter_names), k), are the derivatives of the parameters by the unknowns, with
        density over stiffness and stiffness as logarithms.
        """
        derivative_spectra = [self.ln_density_derivative]
        own_density, other_density = self.plant.beam.density_kg_per_m, plant.beam.density_kg_per_m
        parameter_steps = [np.log(other_density / own_density)]
        # ln(mass per length) is the sum of ln(rho/EI) and ln(EI).
        step_slopes = [
            _parameter_rows(parameter_slopes, parameter_names, BEAM_PARAMETERS).sum(axis=0)
        ]
        for external_derivative, damping_change in zip(
            self.external_damping_derivatives, self._external_damping_terms(plant), strict=True
        ):
            derivative_spectra += list(external_derivative)
            parameter_steps += damping_change[:, 0].tolist()
            step_slopes += list(
                damping_change[:, 1:]
                @ _parameter_rows(parameter_slopes, parameter_names, _EXTERNAL_PARAMETERS)
            )
        derivative_spectra.append(self.delay_derivative)
        parameter_steps.append(plant.delay_s - self.plant.delay_s)
        step_slopes += list(_parameter_rows(parameter_slopes, parameter_names, ("delay_s",)))
        # A real view suffices, since the spectra are multiplied by real numbers only.
        real_spectra = np.array(derivative_spectra).view(np.float64)
        torque_change: ComplexArray = (np.array(parameter_steps) @ real_spectra).view(np.complex128)
        torque_jacobian: ComplexArray = (np.array(step_slopes).T @ real_spectra).view(np.complex128)
        change_by_poles, jacobian_by_poles = self.torque_change_by_poles(
            poles, parameter_slopes.shape[1]
        )
        return torque_change + change_by_poles, torque_jacobian + jacobian_by_poles

    def torque_change_by_poles(
        self, poles: Sequence[Pole], unknown_count: int
    ) -> tuple[ComplexArray, ComplexArray]:
        """Return the change of the drag torque due to the poles of another beam.

        The spectrum of the change, shape (K,), is returned with its derivatives by the unknowns,
        shape (unknown_count, K). The poles are differentiated by the unknowns.
        """
        torque_change = np.zeros(self.delay_derivative.size, dtype=np.complex128)
        jacobian = np.zeros((unknown_count, torque_change.size), dtype=np.complex128)
        for pole in poles:
            if pole.mode not in self.pole_derivatives or not pole.oscillates:
                continue
            own_pole = complex(self.response.poles[pole.mode - 1])
            pole_step = pole.at_rad_s - own_pole
            remainder, remainder_slopes = self._torque_beyond_first_order(
                pole.mode, own_pole, pole.at_rad_s
            )
            by_real, by_imaginary = self.pole_derivatives[pole.mode]
            torque_change += pole_step.real * by_real + pole_step.imag * by_imaginary - remainder
            by_real_at_pole, by_imaginary_at_pole = (
                self.pole_derivatives[pole.mode] - remainder_slopes
            )
            jacobian += np.outer(pole.derivative.real, by_real_at_pole)
            jacobian += np.outer(pole.derivative.imag, by_imaginary_at_pole)
        return torque_change, jacobian

    def _external_damping_terms(self, plant: Plant) -> list[RealArray]:
        """Return the external damping of another beam minus that of this beam, for two modes.

        The difference is taken at the pole of each mode, without an expansion in lambda:
        ``gamma s^lambda`` is not linear in lambda, and a fit with insignificant external damping
        may move lambda anywhere in its range.

        For each mode, the difference is ``c_0 + c_1 s``. The rows of an array of shape (2, 3) are
        c_0 and c_1, each with its derivatives by gamma and lambda.
        """
        own_damping, other_damping = self.plant.damping, plant.damping
        linear_terms = []
        for s in self.response.poles[LOWEST_MODE_INDICES].tolist():
            if not s.imag > 0:  # no such oscillation
                linear_terms.append(np.zeros((2, 3)))
                continue
            log_s, per_gamma = np.log(s), s**other_damping.lambda_
            damping_difference = (
                other_damping.gamma * per_gamma - own_damping.gamma * s**own_damping.lambda_
            )
            damping_and_slopes = np.array(
                [damping_difference, per_gamma, other_damping.gamma * log_s * per_gamma]
            )
            linear_term = damping_and_slopes.imag / s.imag
            linear_terms.append(
                np.array([damping_and_slopes.real - linear_term * s.real, linear_term])
            )
        return linear_terms

    def _torque_beyond_first_order(
        self, mode_number: int, own_pole: complex, other_pole: complex
    ) -> tuple[ComplexArray, ComplexArray]:
        """Return the change of one mode's torque with its pole, without the first-order part.

        The spectrum has the shape (K,). It is returned with its derivatives by the real and the
        imaginary part of the pole, shape (2, K). `own_pole` (of the beam for which the drag was
        computed) and `other_pole` (of the changed beam) have a positive frequency, in rad/s.
        """
        s, torque_spectrum = self.response.s, self.response.modal_torque(mode_number)
        pole_step = other_pole - own_pole
        own_term, own_conjugate_term = 1 / (s - own_pole), 1 / (s - own_pole.conjugate())
        other_term, other_conjugate_term = 1 / (s - other_pole), 1 / (s - other_pole.conjugate())
        term_ratio = other_term * other_conjugate_term / (own_term * own_conjugate_term)
        first_order_change = pole_step * own_term + pole_step.conjugate() * own_conjugate_term
        derivative_by_real_part = term_ratio * (other_term + other_conjugate_term) - (
            own_term + own_conjugate_term
        )
        derivative_by_imaginary_part = 1j * (
            term_ratio * (other_term - other_conjugate_term) - (own_term - own_conjugate_term)
        )
        remainder_transforms = torque_spectrum * np.array(
            [
                term_ratio - 1 - first_order_change,
                derivative_by_real_part,
                derivative_by_imaginary_part,
            ]
        )
        remainder, *remainder_slopes = self.band_spectrum(
            self.response.to_time_series(remainder_transforms)
        )
        return remainder, np.array(remainder_slopes)


def _parameter_rows(
    derivatives: RealArray, derivative_names: Sequence[str], wanted_names: Sequence[str]
) -> RealArray:
    """Return the rows of `derivatives` for the wanted parameters, shape (n, k).

    `derivative_names` are the parameters of all rows. A parameter that is not among them gets
    zeros.
    """
    zero_row = np.zeros(derivatives.shape[1])
    return np.array(
        [
            derivatives[derivative_names.index(parameter_name)]
            if parameter_name in derivative_names
            else zero_row
            for parameter_name in wanted_names
        ]
    )
