"""Signatures of touches: the innovations in the first ticks after a contact.

A touch far from the root appears late and with many sign changes. The torque of a soft obstacle
rises slowly, and a hard obstacle releases the beam at once. The contact is linear except for the
release, so that its time course does not depend on the speed. With the motor held, the contact is
computed for obstacles of a grid of positions and stiffnesses. The filter of the innovations turns
torque and base shear into the signatures for the detector. Of several similar signatures one is
enough.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rigd.beam import Beam, Damping
from rigd.touch._contact import contact_responses, integrate_contact
from rigd.touch._innovations import ChannelNoise, InnovationFilter, ObservedBeam, observed_beam
from rigd.touch._kernels import contact_kernels
from rigd.touch._sensor_filter import NO_FILTER, SensorFilter

if TYPE_CHECKING:  # the control loop does not import models
    from rigd.touch._model import TouchModel

Real = NDArray[np.float64]

_POSITION_FRACTIONS = np.linspace(0.04, 1.0, 33)
"""Positions of the signatures' obstacles, as fractions of the beam's length."""
_STIFFNESSES_N_PER_M = np.array([1e2, 2e2, 4e2, 1e3, 3e3, 1e4, 3e4, 1e5])
"""Stiffnesses of the signatures' obstacles."""
_CONTACT_AGES_S = np.array([2, 3, 4, 5, 6, 7, 8, 10, 12, 14, 17, 20, 24]) * 1e-3
"""Times in s from the contact to the tick at which a signature is compared."""
_CONTACT_PHASES = 2
"""Number of instants of the contact within a tick, since bending waves change their sign from tick
to tick."""
_STEPS_PER_TICK = 16
"""Number of time steps of the calculation in a tick."""
_REDUNDANT_CORRELATION = 0.9
"""Correlation of two signatures above which one of them is redundant: of 6864 signatures 500
remain."""


@dataclass(frozen=True, slots=True, eq=False)
class DetectorModel:
    """Beam model and effects of touches on it, with which a `TouchDetector` compares readings."""

    observed: ObservedBeam
    """Model of the free beam, with the noise of its readings."""
    signatures: Real
    """Signatures of touches from the function `signatures`, shape (signatures, 2 · ticks)."""


def detector_model(model: "TouchModel", rate_hz: float, noise_stds: ChannelNoise) -> DetectorModel:
    """Return the model and the signatures of a beam, with which touches are detected.

    Parameters
    ----------
    model
        Model of the beam.
    rate_hz
        Ticks a second.
    noise_stds
        Noise of torque, base shear and angle.
    """
    observed_model = observed_beam(
        model.plant.beam,
        model.plant.damping,
        rate_hz,
        noise_stds,
        tool_inertia_kg_m2=model.plant.tool_inertia_kg_m2,
        torque_after_angle_s=model.wrench_delay_s - model.angle_delay_s,
        sensor_filter=model.sensor_filter,
    )
    unit_signatures = signatures(
        model.plant.beam, model.plant.damping, rate_hz, observed_model, model.sensor_filter
    )
    return DetectorModel(observed_model, unit_signatures)


def signatures(
    beam: Beam,
    damping: Damping,
    rate_hz: float,
    model: ObservedBeam,
    sensor_filter: SensorFilter = NO_FILTER,
) -> Real:
    """Return the signatures of touches: the innovations in the last ticks after a contact.

    They are unit vectors for contacts of several positions, stiffnesses and ages.

    Parameters
    ----------
    beam, damping
        Parameters of the exact model.
    rate_hz
        Ticks a second.
    model
        Filter of the innovations.
    sensor_filter
        Filters of the wrench.

    Returns
    -------
    ndarray of shape (signatures, 2 · ticks)
        Innovations of torque and shear for each tick, the oldest tick first.
    """
    ages_ticks = np.maximum(1, np.round(_CONTACT_AGES_S * rate_hz)).astype(int)
    tick_count = int(ages_ticks.max())
    step_s = 1 / (_STEPS_PER_TICK * rate_hz)
    positions_m = beam.length_m * _POSITION_FRACTIONS
    kernels = contact_kernels(
        beam, damping, positions_m, step_s, _STEPS_PER_TICK * tick_count + 1, sensor_filter
    )
    approaches_m = positions_m[:, None] * step_s * np.arange(kernels.steps)
    impulse_responses = _impulse_responses(model, tick_count)

    signature_blocks = []
    for stiffness_n_per_m in _STIFFNESSES_N_PER_M:
        forces_n = integrate_contact(
            kernels.displacement, approaches_m, np.full(positions_m.size, stiffness_n_per_m), step_s
        )
        tick_readings = contact_responses(
            (kernels.torque, kernels.shear),
            forces_n,
            _STEPS_PER_TICK // _CONTACT_PHASES,
            _CONTACT_PHASES * tick_count + 1,
        )
        for tick_phase in range(1, _CONTACT_PHASES + 1):
            tick_forces = (
                tick_readings[:, :, tick_phase::_CONTACT_PHASES]
                .transpose(0, 2, 1)
                .reshape(-1, 2 * tick_count)
            )
            innovations = tick_forces @ impulse_responses
            for age in ages_ticks:
                age_rows = np.zeros_like(innovations)
                age_rows[:, 2 * (tick_count - age) :] = innovations[:, : 2 * age]
                signature_blocks.append(age_rows)
    all_signatures = np.concatenate(signature_blocks)
    norms = np.linalg.norm(all_signatures, axis=1)
    return _select_dissimilar(all_signatures[norms > 0] / norms[norms > 0, None])


def _impulse_responses(model: ObservedBeam, ticks: int) -> Real:
    """Return the matrix from torque and shear of each tick to the innovations of each tick.

    The shape is (2 · ticks, 2 · ticks).
    """
    response_matrix = np.zeros((2 * ticks, 2 * ticks))
    for channel_index, unit_impulse in enumerate(((1.0, 0.0), (0.0, 1.0))):
        innovation_filter = InnovationFilter(model)
        for tick in range(ticks):
            innovation_filter.step(0.0, *(unit_impulse if tick == 0 else (0.0, 0.0)))
            for row_begin in range(ticks - tick):
                at = 2 * (row_begin + tick)
                response_matrix[2 * row_begin + channel_index, at : at + 2] = (
                    innovation_filter.whitened
                )
    return response_matrix


def _select_dissimilar(unit_vectors: Real) -> Real:
    """Return a selection of unit vectors such that every other vector is similar to one of them.

    Each selected vector is the one that is least similar to those selected before.
    """
    selected_rows = [0]
    similarities = np.abs(unit_vectors @ unit_vectors[0])
    while similarities.min() < _REDUNDANT_CORRELATION:
        farthest_row = int(similarities.argmin())
        selected_rows.append(farthest_row)
        np.maximum(
            similarities, np.abs(unit_vectors @ unit_vectors[farthest_row]), out=similarities
        )
    return unit_vectors[selected_rows]
