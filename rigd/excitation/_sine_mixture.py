"""Steady sines within the limits of a rig, and their best mixture for the target precisions."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, pi
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rigd.beam import Pole
from rigd.excitation._beam_estimate import BAND_HZ, BeamEstimate
from rigd.excitation._fisher_information import covariance_of, plant_responses, whitened_kernels
from rigd.excitation._shortest_move import MovePlant
from rigd.excitation._sweeps import SIDE_BAND_OFFSET
from rigd.excitation.moves import quintic
from rigd.excitation.targets import Quantities

RealArray = NDArray[np.float64]

_SINE_OFFSETS_HALF_WIDTHS: Final = (-4.0, -2.0, -1.0, 0.0, 1.0, 2.0, 4.0)
"""Distances of the forecast's steady sines from a mode, in half-power half-widths of the mode."""

_MIXTURE_SEARCH_STEPS: Final = 60
"""Number of multiplicative steps in the search for a mixture of steady sines."""

UNREACHABLE_TIME_S: Final = 1e5
"""Time in s above which the targets count as never reached."""


def steady_sines(
    estimate: BeamEstimate, modes: Sequence[Pole], plant: MovePlant, limits: RealArray
) -> tuple[RealArray, RealArray]:
    """Return frequencies and largest allowed amplitudes of the forecast's steady sines.

    The results are frequencies in Hz and amplitudes of the angle in rad, each of shape (m,).
    `limits` are those of angle, speed, tracking error, torques of motor and coupling, and slope.
    """
    relative_frequency_offsets = [
        (
            *(beam_mode.damping_ratio * np.array(_SINE_OFFSETS_HALF_WIDTHS)),
            -SIDE_BAND_OFFSET,
            SIDE_BAND_OFFSET,
        )
        for beam_mode in modes
    ]
    frequency_hz = np.array(
        [
            beam_mode.frequency_hz * (1.0 + relative_offset)
            for beam_mode, mode_offsets in zip(modes, relative_frequency_offsets, strict=True)
            for relative_offset in mode_offsets
        ]
    )
    frequency_hz = frequency_hz[(frequency_hz > 0.0) & (frequency_hz < BAND_HZ)]
    s = 2j * pi * frequency_hz
    _, torque_response, slope_response = plant_responses(estimate, s)
    # The response to a short pulse gives the torque for the motor's own inertia, and its lag.
    pulse_reference_rad = np.zeros(round(plant.rate_hz))
    pulse_rise = quintic(0.01, plant.rate_hz)
    pulse_reference_rad[: 2 * pulse_rise.size] = 1e-3 * np.concatenate(
        [pulse_rise, pulse_rise[::-1]]
    )
    pulse_response = plant.respond(pulse_reference_rad)
    laplace_factors = np.exp(-np.outer(s, np.arange(pulse_reference_rad.size) / plant.rate_hz))
    angle_transform = laplace_factors @ pulse_response.angle_rad
    relative_error_response = (
        laplace_factors @ (pulse_reference_rad - pulse_response.angle_rad) / angle_transform
    )
    motor_torque_response = (
        laplace_factors
        @ (pulse_response.torque_nm - pulse_response.coupling_torque_nm)
        / angle_transform
    )
    limit_fractions = np.abs(
        [
            np.ones_like(s),
            s,
            relative_error_response,
            motor_torque_response + torque_response,
            torque_response,
            slope_response,
        ]
    )
    return frequency_hz, 1.0 / (limit_fractions / limits[:, None]).max(axis=0)


@dataclass(frozen=True, slots=True, eq=False)
class SineMixture:
    """Durations of steady sines that reach all target precisions soonest, ring-up neglected."""

    times_s: RealArray
    """Time in s for which each sine lasts; shape (m,)."""
    weights: RealArray
    """Weights of q combinations of the k derivatives of the torque, whose sum of squares is the
    information that brings the targets closer; shape (q, k)."""


def best_mixture(
    fisher_information: RealArray,
    estimate: BeamEstimate,
    quantities: Quantities,
    frequency_hz: RealArray,
    angle_rad: RealArray,
    target_relaxation: float = 1.0,
) -> SineMixture:
    """Return durations of steady sines that together reach all target precisions soonest.

    The search takes multiplicative steps, as `time_fractions`, with a multiplier for each quantity.
    By the equivalence theorem all sines of the best mixture give the same information per second on
    the returned combinations, and no other sine gives more (V. V. Fedorov, Theory of optimal
    experiments, 1972).

    `fisher_information` is that of the present record, shape (k, k). The sines have m frequencies
    and amplitudes. All standard deviations may exceed their targets by the factor
    `target_relaxation`.
    """
    information_rates = _information_rates(estimate, frequency_hz, angle_rad)
    target_stds = np.array(
        [
            inf if precision.impossible_reason else precision.target_std
            for precision in quantities.quantity_precisions
        ]
    )
    scaled_gradients = quantities.gradients / (target_relaxation * target_stds[:, None])
    if not scaled_gradients.any():
        return SineMixture(np.zeros(frequency_hz.size), scaled_gradients)
    target_multipliers = np.ones(len(scaled_gradients))
    times_s = np.full(frequency_hz.size, 1.0 / frequency_hz.size)
    for _ in range(_MIXTURE_SEARCH_STEPS):
        covariance = covariance_of(
            fisher_information + np.tensordot(times_s, information_rates, axes=1), estimate
        )
        gain_directions = scaled_gradients @ covariance
        relative_variances = np.einsum("qi,qi->q", gain_directions, scaled_gradients)
        target_multipliers = target_multipliers * np.maximum(relative_variances, 1e-12) ** 0.5
        target_multipliers /= max(float(target_multipliers.sum()), 1e-300)
        gain_rates = np.einsum(
            "q,qi,fij,qj->f",
            target_multipliers,
            gain_directions,
            information_rates,
            gain_directions,
        )
        times_s = times_s * np.sqrt(
            gain_rates / max(float(times_s @ gain_rates / times_s.sum()), 1e-300)
        )
        # Scale the total time towards the targets, until they are met or the time is too long.
        times_s *= float(np.clip(np.sqrt(relative_variances.max()), 0.5, 2.0))
        if times_s.sum() > UNREACHABLE_TIME_S:
            break
    multiplier_scales = np.sqrt(
        target_multipliers / max(float(times_s @ gain_rates / times_s.sum()), 1e-300)
    )
    return SineMixture(times_s, multiplier_scales[:, None] * gain_directions)


def _information_rates(
    estimate: BeamEstimate, frequency_hz: RealArray, angle_rad: RealArray
) -> RealArray:
    """Return the Fisher information per second of each steady sine, shape (m, k, k)."""
    kernels = whitened_kernels(estimate, 2j * pi * frequency_hz, 1.0) * (angle_rad / 2.0**0.5)
    information_rates: RealArray = np.einsum("if,jf->fij", kernels, kernels.conj()).real
    return information_rates


def least_standard_deviations(
    fisher_information: RealArray,
    estimate: BeamEstimate,
    quantities: Quantities,
    frequency_hz: RealArray,
    angle_rad: RealArray,
    duration_s: float,
) -> RealArray:
    """Return the smallest standard deviation that each quantity can have in a record.

    For each quantity the mixture of sines, with the total duration `duration_s`, is the best for
    this quantity alone. The other arguments are those of `best_mixture`.
    """
    information_rates = _information_rates(estimate, frequency_hz, angle_rad)
    least_stds = np.empty(len(quantities.gradients))
    for row, gradient in enumerate(quantities.gradients):
        times_s = np.full(frequency_hz.size, duration_s / frequency_hz.size)
        for _ in range(_MIXTURE_SEARCH_STEPS):
            total_information = fisher_information + np.tensordot(
                times_s, information_rates, axes=1
            )
            gain_direction = gradient @ covariance_of(total_information, estimate)
            least_stds[row] = np.sqrt(max(float(gain_direction @ gradient), 0.0))
            times_s = times_s * np.sqrt(
                np.einsum("i,fij,j->f", gain_direction, information_rates, gain_direction)
            )
            times_s *= duration_s / max(float(times_s.sum()), 1e-300)
    return least_stds


def time_with_ring_up(times_s: RealArray, frequency_hz: RealArray, modes: Sequence[Pole]) -> float:
    """Return the time in s of a mixture of sines, plus the time in which its modes ring up.

    The information on the damping grows as ``1 - exp(-t / tau)`` at a constant amplitude.
    """
    total_s = float(times_s.sum())
    time_ratios = np.geomspace(1e-3, 1e3, 400)
    information_gain = (
        time_ratios - 2.0 * (1.0 - np.exp(-time_ratios)) + 0.5 * (1.0 - np.exp(-2.0 * time_ratios))
    )
    for beam_mode in modes:
        mode_range_hz = (
            1.5 * _SINE_OFFSETS_HALF_WIDTHS[-1] * beam_mode.damping_ratio * beam_mode.frequency_hz
        )
        time_at_mode_s = float(
            times_s[np.abs(frequency_hz - beam_mode.frequency_hz) < mode_range_hz].sum()
        )
        decay_s = -1.0 / beam_mode.at_rad_s.real
        if time_at_mode_s > 0.01 * total_s:
            total_s += (
                decay_s * float(np.interp(time_at_mode_s / decay_s, information_gain, time_ratios))
                - time_at_mode_s
            )
    return total_s
