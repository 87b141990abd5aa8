"""Templates of contacts: the innovations that a contact causes in the ticks after it begins.

The detector correlates innovations with these templates (matched filters). A touch far from the
root appears late and with many sign changes. The torque of a soft obstacle rises slowly, and a hard
obstacle releases the beam at once. The contact is linear except for the release, so that its time
course does not depend on the speed. Contacts at several positions with several stiffnesses are
computed for a motor at rest. The innovation filter turns their torque and base shear into
templates. Only one of several similar templates is stored.
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

RealArray = NDArray[np.float64]

_POSITION_FRACTIONS = np.linspace(0.04, 1.0, 33)
"""Positions of the templates' obstacles, as fractions of the beam's length."""
_CONTACT_STIFFNESSES_N_PER_M = np.array([1e2, 2e2, 4e2, 1e3, 3e3, 1e4, 3e4, 1e5])
"""Stiffnesses of the templates' obstacles."""
_CONTACT_AGES_S = np.array([2, 3, 4, 5, 6, 7, 8, 10, 12, 14, 17, 20, 24]) * 1e-3
"""Times in s from the beginning of a contact to the tick in which its template is compared."""
_CONTACT_PHASE_COUNT = 2
"""Number of instants within a tick at which contacts begin; one is too few, because bending waves
change their sign from tick to tick."""
_STEPS_PER_TICK = 16
"""Number of time steps of the integration in a tick."""
_MAX_TEMPLATE_CORRELATION = 0.9
"""Correlation of two templates above which one of them is redundant: of 6864 templates 500
remain."""


@dataclass(frozen=True, slots=True, eq=False)
class DetectorModel:
    """Beam model and templates of contacts for a `TouchDetector`."""

    observed_beam: ObservedBeam
    """Model of the free beam that computes the innovations."""
    templates: RealArray
    """Templates from the function `contact_templates`, shape (templates, 2 · ticks)."""


def detector_model(model: "TouchModel", rate_hz: float, noise_stds: ChannelNoise) -> DetectorModel:
    """Return the model and the templates with which a `TouchDetector` detects touches.

    Parameters
    ----------
    model
        Model of the beam.
    rate_hz
        Ticks a second.
    noise_stds
        Standard deviations of the noise of torque, base shear and angle.
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
    templates = contact_templates(
        model.plant.beam, model.plant.damping, rate_hz, observed_model, model.sensor_filter
    )
    return DetectorModel(observed_model, templates)


def contact_templates(
    beam: Beam,
    damping: Damping,
    rate_hz: float,
    model: ObservedBeam,
    sensor_filter: SensorFilter = NO_FILTER,
) -> RealArray:
    """Return templates of contacts: unit vectors of the innovations that a contact causes.

    The contacts have several positions, stiffnesses and times since their beginning.

    Parameters
    ----------
    beam, damping
        Parameters of the exact model.
    rate_hz
        Ticks a second.
    model
        Model from `observed_beam`, whose innovations are computed.
    sensor_filter
        Filters of the wrench.

    Returns
    -------
    ndarray of shape (templates, 2 · ticks)
        Innovations of torque and shear in turn for the last ticks, the oldest tick first.
    """
    contact_ages_ticks = np.maximum(1, np.round(_CONTACT_AGES_S * rate_hz)).astype(int)
    tick_count = int(contact_ages_ticks.max())
    step_s = 1 / (_STEPS_PER_TICK * rate_hz)
    positions_m = beam.length_m * _POSITION_FRACTIONS
    kernels = contact_kernels(
        beam, damping, positions_m, step_s, _STEPS_PER_TICK * tick_count + 1, sensor_filter
    )
    approaches_m = positions_m[:, None] * step_s * np.arange(kernels.step_count)
    impulse_responses = _impulse_responses(model, tick_count)

    template_blocks = []
    for stiffness_n_per_m in _CONTACT_STIFFNESSES_N_PER_M:
        forces_n = integrate_contact(
            kernels.displacement_m_per_n,
            approaches_m,
            np.full(positions_m.size, stiffness_n_per_m),
            step_s,
        )
        tick_readings = contact_responses(
            (kernels.torque_nm_per_n, kernels.shear_per_n),
            forces_n,
            _STEPS_PER_TICK // _CONTACT_PHASE_COUNT,
            _CONTACT_PHASE_COUNT * tick_count + 1,
        )
        for tick_phase in range(1, _CONTACT_PHASE_COUNT + 1):
            tick_forces = (
                tick_readings[:, :, tick_phase::_CONTACT_PHASE_COUNT]
                .transpose(0, 2, 1)
                .reshape(-1, 2 * tick_count)
            )
            innovations = tick_forces @ impulse_responses
            for age in contact_ages_ticks:
                aged_templates = np.zeros_like(innovations)
                aged_templates[:, 2 * (tick_count - age) :] = innovations[:, : 2 * age]
                template_blocks.append(aged_templates)
    all_templates = np.concatenate(template_blocks)
    template_norms = np.linalg.norm(all_templates, axis=1)
    return _select_dissimilar(
        all_templates[template_norms > 0] / template_norms[template_norms > 0, None]
    )


def _impulse_responses(model: ObservedBeam, tick_count: int) -> RealArray:
    """Return the matrix M with ``innovations = readings @ M``, shape (2 · ticks, 2 · ticks).

    Both row vectors have torque and shear in turn for each tick.
    """
    response_matrix = np.zeros((2 * tick_count, 2 * tick_count))
    for channel_index, unit_impulse in enumerate(((1.0, 0.0), (0.0, 1.0))):
        innovation_filter = InnovationFilter(model)
        for tick in range(tick_count):
            innovation_filter.step(0.0, *(unit_impulse if tick == 0 else (0.0, 0.0)))
            for row_begin in range(tick_count - tick):
                first_column = 2 * (row_begin + tick)
                response_matrix[2 * row_begin + channel_index, first_column : first_column + 2] = (
                    innovation_filter.whitened
                )
    return response_matrix


def _select_dissimilar(unit_vectors: RealArray) -> RealArray:
    """Return a subset of unit vectors such that every other vector is similar to one of the subset.

    Each vector that is added is the least similar to those selected before.
    """
    selected_rows = [0]
    similarities = np.abs(unit_vectors @ unit_vectors[0])
    while similarities.min() < _MAX_TEMPLATE_CORRELATION:
        least_similar_row = int(similarities.argmin())
        selected_rows.append(least_similar_row)
        np.maximum(
            similarities, np.abs(unit_vectors @ unit_vectors[least_similar_row]), out=similarities
        )
    return unit_vectors[selected_rows]
