"""Impact on the beam: one pulse of force that does not depend on the beam's motion."""

import numpy as np
from numpy.typing import NDArray

from rigd.touch._kernels import ContactKernels
from rigd.touch._obstacle_contact import ObstacleContact, ParameterRanges, WhitenedWindow

RealArray = NDArray[np.float64]

_IMPACT_DURATIONS_S = np.array([1e-3, 2e-3, 4e-3, 8e-3, 16e-3, 32e-3])
"""Durations of the pulse in s from which the search starts."""


class ImpactResponse:
    """Model of the effect of an impact, a half-sine pulse of force, on torque and base shear.

    A candidate has four columns: position in m, instant in s, logarithm of the duration in s, and
    peak of the force in N. The search starts at every `position_stride`-th position of the kernels,
    which have the time steps of the integration.
    """

    __slots__ = ("_contact", "_kernels", "_position_stride")

    def __init__(
        self, obstacle_contact: ObstacleContact, kernels: ContactKernels, position_stride: int
    ) -> None:
        self._contact, self._kernels, self._position_stride = (
            obstacle_contact,
            kernels,
            position_stride,
        )

    def predict(self, parameters: RealArray, sample_window: WhitenedWindow) -> RealArray:
        """Return the effect of impacts (k, 4) on torque and base shear, shape (k, c, samples)."""
        motion_without_touch = sample_window.motion
        last_time_s = motion_without_touch.t[sample_window.end_sample - 1]
        step_count = int(np.ceil((last_time_s - parameters[:, 1].min()) / self._kernels.step_s)) + 3
        step_count = min(step_count, self._kernels.step_count)
        local_kernels = self._kernels.at_positions(parameters[:, 0], step_count)
        pulse_phase = np.arange(step_count) * self._kernels.step_s / np.exp(parameters[:, 2:3])
        forces_n = parameters[:, 3:4] * np.sin(np.pi * np.minimum(pulse_phase, 1.0))
        kernel_tables = (local_kernels.torque_nm_per_n, local_kernels.shear_per_n)[
            : motion_without_touch.noise_stds.size
        ]
        return self._contact.force_effects(kernel_tables, forces_n, parameters[:, 1], sample_window)

    def start_candidates(
        self, sample_window: WhitenedWindow, latest_sample: int, impact_count: int
    ) -> RealArray:
        """Return the likeliest candidates of a grid of impacts, shape (impact_count, 4).

        The grid has positions, instants up to `latest_sample`, and durations; the peak is fitted by
        least squares.
        """
        positions_m = self._kernels.x_m[:: self._position_stride]
        impact_grid = np.stack(
            [
                grid_axis.ravel()
                for grid_axis in np.meshgrid(
                    positions_m, np.log(_IMPACT_DURATIONS_S), [1.0], indexing="ij"
                )
            ],
            axis=1,
        )
        first_time_s = sample_window.motion.t[sample_window.first_sample]
        unit_effects = self.predict(np.insert(impact_grid, 1, first_time_s, axis=1), sample_window)
        candidate_parts = []
        for sample_index in range(sample_window.first_sample, latest_sample + 1):
            delay_samples = sample_index - sample_window.first_sample
            delayed_effect = np.zeros_like(unit_effects)
            delayed_effect[:, :, delay_samples:] = unit_effects[
                :, :, : unit_effects.shape[2] - delay_samples
            ]
            delayed_effects = sample_window.whitened_innovations - sample_window.residuals(
                delayed_effect
            )
            effect_power = np.einsum("kn,kn->k", delayed_effects, delayed_effects) + 1e-300
            peak_forces_n = delayed_effects @ sample_window.whitened_innovations / effect_power
            chi2_reduction = peak_forces_n**2 * effect_power
            best_rows = np.argsort(-chi2_reduction)[:impact_count]
            candidate_parts.append(
                np.column_stack(
                    [
                        -chi2_reduction[best_rows],
                        impact_grid[best_rows, 0],
                        np.full(best_rows.size, sample_window.motion.t[sample_index]),
                        impact_grid[best_rows, 1],
                        peak_forces_n[best_rows],
                    ]
                )
            )
        all_candidates = np.concatenate(candidate_parts)
        return all_candidates[np.argsort(all_candidates[:, 0])[:impact_count], 1:]

    @staticmethod
    def parameter_ranges(
        position_range_m: tuple[float, float], instant_range_s: tuple[float, float]
    ) -> ParameterRanges:
        """Return bounds and step sizes of the four parameters of an impact."""
        return ParameterRanges(
            lower_limits=np.array([position_range_m[0], instant_range_s[0], np.log(3e-4), -100.0]),
            upper_limits=np.array([position_range_m[1], instant_range_s[1], np.log(0.1), 100.0]),
            derivative_step=np.array([2e-4, 2e-5, 1e-2, 1e-3]),
            significant_change=np.array([3e-3, 1e-3, 0.3, 0.5]),
            smallest_std=np.array([1.5e-4, 1e-5, 2e-2, 5e-3]),
            largest_std=np.array([0.02, 2e-3, 1.0, 0.3]),
        )
