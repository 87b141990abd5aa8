"""Response of a plant from motor angle to measured torque, on a fixed grid of s.

It is::

    H(s) = (R(s) + J_tool s²) Q(s) exp(-s tau),    R = G / (1 + kappa G)

G is the exact model of the beam (`rigd.beam._model`), with a tip mass or deviating stiffness of
single modes that of `rigd.beam._tip_mass`. kappa is the clamp's compliance, between tool and beam.
Q is the response of the low-pass filters of the torque channel, ``1 / (1 + tau_1 s)`` and
``1 / (1 + sqrt(2) tau_2 s + tau_2² s²)`` (Butterworth), and tau is the delay of the torque channel
relative to the angle channel.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rigd.beam._model import GRADIENT_NAMES, TransferGrid
from rigd.beam._plant import Plant
from rigd.beam._tip_mass import differentiated_response


class ResponseGrid:
    """Evaluates the transfer function from motor angle to torque on a grid of the variable s.

    It also evaluates its derivatives with respect to parameters of the plant.

    Parameters
    ----------
    s : array_like of complex, shape (n,)
        Laplace variable in rad/s, not 0.
    """

    __slots__ = ("_beam_grid", "_log_s", "_s", "_s_squared")

    def __init__(self, s: ArrayLike) -> None:
        self._s = np.asarray(s, dtype=np.complex128)
        self._s_squared = self._s * self._s
        self._log_s = np.log(self._s)
        self._beam_grid = TransferGrid(self._s)

    @property
    def s(self) -> NDArray[np.complex128]:
        """Return the grid of the Laplace variable in rad/s, shape (n,)."""
        return self._s

    def evaluate(
        self,
        plant: Plant,
        gradient_parameters: Sequence[str] = (),
        angle_transform: NDArray[np.complex128] | float = 1.0,
    ) -> NDArray[np.complex128]:
        """Return the Laplace transform of a plant's torque for a motor angle, and its derivatives.

        With the angle 1 this is the transfer function in N·m/rad.

        Parameters
        ----------
        plant : Plant
            Plant whose torque is computed.
        gradient_parameters : sequence of str
            Names of k parameters: `GRADIENT_NAMES`, "delay_s", "tool_inertia_kg_m2".
            The torque is differentiated with respect to each while all others are constant.
        angle_transform : ndarray of complex, shape (n,), or float
            Laplace transform of the motor angle at the grid's s.

        Returns
        -------
        ndarray of complex, shape (1 + k, n)
            Transform of the torque, then the derivatives in the order of `gradient_parameters`.
        """
        total_response, derivatives = self._beam_response(plant, gradient_parameters)
        if plant.root_compliance_rad_per_nm:
            clamp_factor = 1 / (1 + plant.root_compliance_rad_per_nm * total_response)
            for parameter_name in derivatives:
                derivatives[parameter_name] = derivatives[parameter_name] * clamp_factor**2
            total_response = total_response * clamp_factor
        total_response += plant.tool_inertia_kg_m2 * self._s_squared
        derivatives["tool_inertia_kg_m2"] = self._s_squared
        channel_times_angle = plant.channel_response(self._s) * angle_transform
        if "delay_s" in gradient_parameters:
            derivatives["delay_s"] = -self._s * total_response
        spectra = np.empty(
            (1 + len(gradient_parameters), channel_times_angle.size), dtype=np.complex128
        )
        for out, response_row in zip(
            spectra,
            [
                total_response,
                *(derivatives[parameter_name] for parameter_name in gradient_parameters),
            ],
            strict=True,
        ):
            np.multiply(response_row, channel_times_angle, out=out)
        return spectra

    def _beam_response(
        self, plant: Plant, gradient_parameters: Sequence[str]
    ) -> tuple[NDArray[np.complex128], dict[str, NDArray[np.complex128]]]:
        """Return the transfer function G of the beam on a rigid clamp, and its derivatives.

        G is the torque over the motor angle, in N·m/rad. The derivatives are with respect to the
        parameters in `gradient_parameters` on which G depends, by the parameters' names.
        """
        beam_parameter_names = [
            parameter_name
            for parameter_name in gradient_parameters
            if parameter_name in GRADIENT_NAMES
        ]
        if plant.tip_mass_kg or plant.stiffness_offsets:
            loaded_response, derivatives = differentiated_response(
                self._log_s,
                self._s_squared,
                plant.beam,
                plant.damping,
                plant.tip_mass_kg,
                plant.stiffness_offsets,
            )
            return loaded_response.response, {
                parameter_name: derivatives[parameter_name]()
                for parameter_name in beam_parameter_names
            }
        if not beam_parameter_names:
            return self._beam_grid.evaluate(plant.beam, plant.damping), {}
        beam_response, derivative_rows = self._beam_grid.evaluate_with_gradient(
            plant.beam, plant.damping, beam_parameter_names
        )
        return beam_response, dict(zip(beam_parameter_names, derivative_rows, strict=True))
