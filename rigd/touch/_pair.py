"""Contact with two obstacles at rest, of which the second is touched with or after the first.

Each force also bends the beam at the other position, so that both contacts are integrated together.
Two soft obstacles that are touched at about the same time have a similar effect to one obstacle
between them. Every touch that one obstacle explains is therefore tested for a second obstacle.
"""

import numpy as np
from numpy.typing import NDArray

from rigd.touch._contact import integrate_two_contacts
from rigd.touch._kernels import ContactKernels, CrossKernels
from rigd.touch._obstacle_contact import (
    MIN_LN_STIFFNESS,
    ObstacleContact,
    ParameterRanges,
    WhitenedWindow,
)

RealArray = NDArray[np.float64]

_SECOND_TOUCH_DELAYS_S = np.array([0.0, 0.008, 0.025, 0.06])
"""Times in s from the first to the second touch from which the search starts, if the first obstacle
did not slow the beam."""
_TRIAL_POSITION_COUNT = 12
"""Number of positions of the second obstacle among which the search chooses its starts."""
_TRIAL_STIFFNESS_N_PER_M = 100.0
"""Stiffness of the second obstacle for which first-order effects are computed; they are scaled in
proportion to the stiffness."""
_RELATIVE_EQUIVALENT_POSITIONS = np.array([[0.6, 1.6], [0.8, 1.3], [0.6, 2.5]])
"""Positions of two obstacles with about the effect of one, divided by the position of the one. Each
of the two exerts half of its moment."""
_MAX_APPROACH_DISTANCE_M = 0.3
"""Largest distance in m from the free beam to the second obstacle at the first touch."""


class TwoObstacleContact:
    """Model of the beam's contact with two obstacles, for the record of one touch.

    Candidates have six columns. The first three are position, instant and logarithm of stiffness of
    the first obstacle. The others are the position of the second obstacle, its distance in m from
    the free beam at the instant of the first touch, and the logarithm of its stiffness. All kernels
    have the time steps of the integration.
    """

    __slots__ = ("_contact", "_cross_kernels", "_kernels")

    def __init__(
        self,
        obstacle_contact: ObstacleContact,
        kernels: ContactKernels,
        cross_kernels: CrossKernels,
    ) -> None:
        self._contact, self._kernels, self._cross_kernels = obstacle_contact, kernels, cross_kernels

    def predict(
        self, parameters: RealArray, sample_window: WhitenedWindow
    ) -> tuple[RealArray, RealArray]:
        """Return the effect of two obstacles on torque and shear, and the force of the first.

        The effect has the shape (k, c, samples); the force on the beam is in N, at the time steps
        from the touch on, shape (k, n).
        """
        obstacle_contact, instants_s = self._contact, parameters[:, 1]
        step_count = obstacle_contact.step_count(instants_s, sample_window)
        positions_m = parameters[:, 0], parameters[:, 3]
        local_kernels = [self._kernels.at_positions(x, step_count) for x in positions_m]
        (beyond_first_m, first_sign), (beyond_second_m, second_sign) = (
            obstacle_contact.motion_beyond_obstacle(x, instants_s, step_count) for x in positions_m
        )
        local_cross_kernels = (
            self._cross_kernels.between_positions(*positions_m, step_count)
            * (first_sign * second_sign)[:, None]
        )
        pressing_forces_n = integrate_two_contacts(
            (local_kernels[0].displacement_m_per_n, local_kernels[1].displacement_m_per_n),
            local_cross_kernels,
            (beyond_first_m, beyond_second_m - parameters[:, 4:5]),
            (np.exp(parameters[:, 2]), np.exp(parameters[:, 5])),
        )
        forces_n = (
            -first_sign[:, None] * pressing_forces_n[0],
            -second_sign[:, None] * pressing_forces_n[1],
        )
        channel_count = sample_window.motion.noise_stds.size
        first_effect, second_effect = (
            obstacle_contact.force_effects(
                (position_kernels.torque_nm_per_n, position_kernels.shear_per_n)[:channel_count],
                force_n,
                instants_s,
                sample_window,
            )
            for position_kernels, force_n in zip(local_kernels, forces_n, strict=True)
        )
        return first_effect + second_effect, forces_n[0]

    def predict_channels(self, parameters: RealArray, sample_window: WhitenedWindow) -> RealArray:
        """Return the effect of two obstacles on torque and shear, shape (k, c, samples).

        The arguments are those of `predict`.
        """
        return self.predict(parameters, sample_window)[0]

    def start_pairs(
        self,
        single_obstacle: RealArray,
        sample_window: WhitenedWindow,
        parameter_ranges: ParameterRanges,
        pair_count: int,
    ) -> RealArray:
        """Return pairs of obstacles from which the search starts, shape (k, 6).

        Some pairs have about the effect of the single obstacle that explains the record best;
        `pair_count` others have a second obstacle added to it, at the positions for which
        first-order effects predict the largest reduction of the residuals.
        """
        return np.vstack(
            [
                self.equivalent_pairs(single_obstacle, _RELATIVE_EQUIVALENT_POSITIONS),
                self._with_second_obstacle(
                    single_obstacle, sample_window, parameter_ranges, pair_count
                ),
            ]
        )

    @staticmethod
    def equivalent_pairs(single_obstacle: RealArray, relative_positions: RealArray) -> RealArray:
        """Return pairs of obstacles that have about the effect of a single one, shape (k, 6).

        The positions of a pair are relative to that of the single obstacle, shape (k, 2).
        """
        pairs: RealArray = np.tile(
            np.concatenate([single_obstacle, single_obstacle]), (len(relative_positions), 1)
        )
        pairs[:, [0, 3]] *= relative_positions
        pairs[:, [2, 5]] -= np.log(2 * relative_positions**2)
        pairs[:, 4] = 0.0
        return pairs

    def _with_second_obstacle(
        self,
        single_obstacle: RealArray,
        sample_window: WhitenedWindow,
        parameter_ranges: ParameterRanges,
        pair_count: int,
    ) -> RealArray:
        """Return pairs of the single obstacle and a likely second obstacle, shape (pair_count, 6).

        The likeliest ones are selected by the first-order effect of the second obstacle.
        """
        x_m = np.linspace(
            parameter_ranges.lower_limits[3],
            parameter_ranges.upper_limits[3],
            _TRIAL_POSITION_COUNT,
        )
        instants_s = np.full(_TRIAL_POSITION_COUNT, single_obstacle[1])
        step_count = self._contact.step_count(instants_s, sample_window)
        delay_steps = np.round(_SECOND_TOUCH_DELAYS_S / self._kernels.step_s).astype(np.intp)
        beyond_m, _ = self._contact.motion_beyond_obstacle(x_m, instants_s, step_count)
        distances_m = np.maximum(beyond_m[:, np.minimum(delay_steps, step_count - 1)], 0.0)
        trial_pair = np.concatenate([single_obstacle, [0.0, 0.0, np.log(_TRIAL_STIFFNESS_N_PER_M)]])
        pairs_with_second = np.tile(trial_pair, (_TRIAL_POSITION_COUNT * delay_steps.size, 1))
        pairs_with_second[:, 3], pairs_with_second[:, 4] = (
            np.repeat(x_m, delay_steps.size),
            distances_m.ravel(),
        )
        pair_without_second = np.concatenate(
            [single_obstacle, [x_m[-1], parameter_ranges.upper_limits[4], MIN_LN_STIFFNESS]]
        )
        pairs_with_changed_first = (
            pair_without_second + np.diag(parameter_ranges.derivative_step)[:3]
        )
        candidate_rows = np.vstack(
            [pair_without_second, pairs_with_changed_first, pairs_with_second]
        )
        residuals = sample_window.residuals(self.predict_channels(candidate_rows, sample_window))
        residual_without_second, second_effects = residuals[0], residuals[4:] - residuals[0]
        # Effects that changes of the first obstacle can have are removed by projection.
        q, triangle = np.linalg.qr(
            (
                (residuals[1:4] - residual_without_second)
                / parameter_ranges.derivative_step[:3, None]
            ).T
        )
        projected_effect = second_effects - (second_effects @ q) @ q.T
        effect_power = np.einsum("kn,kn->k", projected_effect, projected_effect) + 1e-300
        effect_factors = np.maximum(
            -(projected_effect @ residual_without_second) / effect_power, 0.0
        )
        chi2_reduction = (effect_factors**2 * effect_power).reshape(_TRIAL_POSITION_COUNT, -1)
        likeliest_positions = np.argsort(-chi2_reduction.max(axis=1))[:pair_count]
        chosen_rows = likeliest_positions * delay_steps.size + chi2_reduction[
            likeliest_positions
        ].argmax(axis=1)
        chosen_pairs: RealArray = pairs_with_second[chosen_rows]
        chosen_pairs[:, 5] += np.log(np.clip(effect_factors[chosen_rows], 0.1, 100.0))
        first_obstacle_residuals = (
            residual_without_second
            + effect_factors[chosen_rows, None] * second_effects[chosen_rows]
        ) @ q
        # Singular if a parameter has no effect: the first obstacle may not be reached by then.
        first_obstacle_changes = -first_obstacle_residuals @ np.linalg.pinv(triangle).T
        chosen_pairs[:, :3] += np.clip(
            first_obstacle_changes,
            -4 * parameter_ranges.significant_change[:3],
            4 * parameter_ranges.significant_change[:3],
        )
        return chosen_pairs

    @staticmethod
    def reverse_obstacle_order(parameters: RealArray) -> RealArray:
        """Return pairs with exchanged obstacles, touched at the same instant, shape (k, 6)."""
        reversed_pairs: RealArray = parameters[:, [3, 1, 5, 0, 4, 2]]
        reversed_pairs[:, 4] = 0.0
        return reversed_pairs

    @staticmethod
    def parameter_ranges(single_obstacle_ranges: ParameterRanges) -> ParameterRanges:
        """Return bounds and step sizes for two obstacles, from those of one obstacle at rest."""
        return ParameterRanges(
            lower_limits=np.concatenate(
                [
                    single_obstacle_ranges.lower_limits,
                    [
                        single_obstacle_ranges.lower_limits[0],
                        0.0,
                        single_obstacle_ranges.lower_limits[2],
                    ],
                ]
            ),
            upper_limits=np.concatenate(
                [
                    single_obstacle_ranges.upper_limits,
                    [
                        single_obstacle_ranges.upper_limits[0],
                        _MAX_APPROACH_DISTANCE_M,
                        single_obstacle_ranges.upper_limits[2],
                    ],
                ]
            ),
            derivative_step=np.concatenate(
                [single_obstacle_ranges.derivative_step, [2e-4, 2e-5, 2e-2]]
            ),
            significant_change=np.array([6e-3, 1e-3, 1.0, 6e-3, 1e-3, 1.0]),
            smallest_std=np.concatenate([single_obstacle_ranges.smallest_std, [1e-3, 2e-5, 2e-2]]),
            largest_std=np.array([0.05, 5e-3, 1.0, 0.2, 0.05, 2.0]),
        )
