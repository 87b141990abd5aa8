"""An impact from outside: one pulse of force that is independent of the antenna's motion."""

import numpy as np
from numpy.typing import NDArray

from rigd.touch._kernels import ContactKernels
from rigd.touch._obstacle_contact import ObstacleContact, ParameterRanges, WhitenedWindow

Real = NDArray[np.float64]

_DURATIONS_S = np.array([1e-3, 2e-3, 4e-3, 8e-3, 16e-3, 32e-3])
"""Durations of the pulse in s with which the search starts."""


class ImpactResponse:
    """Effect of an impact on the beam, a half-sine pulse of force, on torque and base shear.

    A candidate has four columns: position, instant, logarithm of the duration, and peak.

    Parameters
    ----------
    obstacle_contact
        Integration of the contact for the record.
    kernels
        Contact kernels on the time steps of the integration.
    position_stride
        Number of the kernels' positions from one starting position of the search to the next.
    """

    __slots__ = ("_contact", "_kernels", "_stride")

    def __init__(
        self, obstacle_contact: ObstacleContact, kernels: ContactKernels, position_stride: int
    ) -> None:
        self._contact, self._kernels, self._stride = obstacle_contact, kernels, position_stride

    def predict(self, parameters: Real, sample_window: WhitenedWindow) -> Real:
        """Return the effect of impacts on torque and base shear, shape (k, c, samples).

        Parameters
        ----------
        parameters
            Position, instant, logarithm of the duration and peak of each impact, shape (k, 4).
        sample_window
            Samples for which the effect is predicted.
        """
        free_motion = sample_window.motion
        last_time_s = free_motion.t[sample_window.end - 1]
        step_count = int(np.ceil((last_time_s - parameters[:, 1].min()) / self._kernels.step_s)) + 3
        step_count = min(step_count, self._kernels.steps)
        local_kernels = self._kernels.at_positions(parameters[:, 0], step_count)
        pulse_phase = np.arange(step_count) * self._kernels.step_s / np.exp(parameters[:, 2:3])
        forces_n = parameters[:, 3:4] * np.sin(np.pi * np.minimum(pulse_phase, 1.0))
        kernel_tables = (local_kernels.torque, local_kernels.shear)[: free_motion.noise.size]
        return self._contact.effects(kernel_tables, forces_n, parameters[:, 1], sample_window)

    def starts(self, sample_window: WhitenedWindow, latest_sample: int, impact_count: int) -> Real:
        """Return the likeliest impacts of a grid, each with its best peak, (impact_count, 4).

        Parameters
        ----------
        sample_window
            Whitened innovations with which the impacts are compared.
        latest_sample
            Index of the last sample at which the impact may begin.
        impact_count
            Number of impacts that are returned.
        """
        positions_m = self._kernels.x_m[:: self._stride]
        knock_grid = np.stack(
            [
                grid_axis.ravel()
                for grid_axis in np.meshgrid(
                    positions_m, np.log(_DURATIONS_S), [1.0], indexing="ij"
                )
            ],
            axis=1,
        )
        first_time_s = sample_window.motion.t[sample_window.first]
        unit_effects = self.predict(np.insert(knock_grid, 1, first_time_s, axis=1), sample_window)
        candidate_parts = []
        for sample_index in range(sample_window.first, latest_sample + 1):
            delay_samples = sample_index - sample_window.first
            delayed_effect = np.zeros_like(unit_effects)
            delayed_effect[:, :, delay_samples:] = unit_effects[
                :, :, : unit_effects.shape[2] - delay_samples
            ]
            delayed_effects = sample_window.data - sample_window.residuals(delayed_effect)
            effect_power = np.einsum("kn,kn->k", delayed_effects, delayed_effects) + 1e-300
            peaks_n = delayed_effects @ sample_window.data / effect_power
            chi2_gain = peaks_n**2 * effect_power
            best_rows = np.argsort(-chi2_gain)[:impact_count]
            candidate_parts.append(
                np.column_stack(
                    [
                        -chi2_gain[best_rows],
                        knock_grid[best_rows, 0],
                        np.full(best_rows.size, sample_window.motion.t[sample_index]),
                        knock_grid[best_rows, 1],
                        peaks_n[best_rows],
                    ]
                )
            )
        all_candidates = np.concatenate(candidate_parts)
        return all_candidates[np.argsort(all_candidates[:, 0])[:impact_count], 1:]

    @staticmethod
    def space(x_m: tuple[float, float], instants: tuple[float, float]) -> ParameterRanges:
        """Return the allowed ranges of an impact's four parameters.

        Parameters
        ----------
        x_m, instants
            Ends of the ranges of position and instant.
        """
        return ParameterRanges(
            low=np.array([x_m[0], instants[0], np.log(3e-4), -100.0]),
            high=np.array([x_m[1], instants[1], np.log(0.1), 100.0]),
            difference=np.array([2e-4, 2e-5, 1e-2, 1e-3]),
            scale=np.array([3e-3, 1e-3, 0.3, 0.5]),
            smallest_std=np.array([1.5e-4, 1e-5, 2e-2, 5e-3]),
            largest_std=np.array([0.02, 2e-3, 1.0, 0.3]),
        )
