"""Effects of uncertainties on the innovations of a touch, for the covariance of the residuals.

The sources are the model's parameters, the time steps of the integration, the fitted free motion
and the encoder's noise. Each effect includes that of another instant of touch.
"""

import numpy as np
from numpy.typing import NDArray

from rigd.touch._free_motion import SPLINE_FADE_SAMPLES, STEPS_PER_SAMPLE, TouchRecord
from rigd.touch._kernels import contact_kernels
from rigd.touch._obstacle_contact import ObstacleContact, WhitenedWindow
from rigd.touch._tables import TouchTables

RealArray = NDArray[np.float64]


def uncertainty_effects(
    touch_tables: TouchTables,
    touch_record: TouchRecord,
    likely_obstacle: RealArray,
    sample_window: WhitenedWindow,
) -> RealArray:
    """Return the effect of each uncertainty (one standard deviation) on innovations, (c, n, r).

    c is 1 for torque alone and 2 for torque and base shear, r the number of uncertainties. The
    likely obstacle has position, instant and logarithm of the stiffness, shape (1, 3). The window
    begins before the touch.
    """
    motion_without_touch, quiet_samples = sample_window.motion, sample_window.first_sample
    fine_step_effect = ObstacleContact(
        touch_tables.fine_kernels, touch_tables.x_m, motion_without_touch
    ).predict(likely_obstacle, sample_window)[0][0]
    obstacle_contact = ObstacleContact(
        touch_tables.middle_kernels, touch_tables.x_m, motion_without_touch
    )
    middle_step_effect = obstacle_contact.predict(likely_obstacle, sample_window)[0][0]
    effect_list = [
        fine_step_effect - middle_step_effect,
        *_free_motion_effects(touch_tables, obstacle_contact, likely_obstacle[0], sample_window),
        *_encoder_noise_effects(touch_tables, obstacle_contact, likely_obstacle[0], sample_window),
    ]
    window_slice = slice(sample_window.first_sample, sample_window.end_sample)
    residuals = motion_without_touch.innovations[:, window_slice] - middle_step_effect
    x = float(likely_obstacle[0, 0])
    nearby_positions_m = min(x, touch_tables.x_m[-1] - 1.5e-3) + 1e-3 * np.arange(-1.5, 2.0)
    for nearby_beam in touch_tables.changed_beams:
        changed_beam = nearby_beam.at_positions(nearby_positions_m).motion(
            touch_record, quiet_samples, quiet_samples - 4, motion_without_touch.angle_transform
        )
        nearby_kernels = contact_kernels(
            nearby_beam.model.plant.beam,
            nearby_beam.model.plant.damping,
            np.array([x]),
            touch_tables.middle_kernels.step_s,
            round(
                (motion_without_touch.t[-1] - likely_obstacle[0, 1])
                / touch_tables.middle_kernels.step_s
            )
            + 4,
            nearby_beam.model.sensor_filter,
        )
        position_effect, _ = ObstacleContact(
            nearby_kernels, nearby_positions_m, changed_beam
        ).predict(likely_obstacle, sample_window, kernels=nearby_kernels)
        effect_list.append(
            changed_beam.innovations[:, window_slice] - position_effect[0] - residuals
        )
    return np.stack(effect_list, axis=-1)


def _free_motion_effects(
    touch_tables: TouchTables,
    obstacle_contact: ObstacleContact,
    likely_obstacle: RealArray,
    sample_window: WhitenedWindow,
) -> RealArray:
    """Return the effects of the free motion's uncertainty on the innovations, shape (q, c, n).

    Each is the sum of the direct effect and the effect through the changed contact force.
    """
    motion_without_touch = sample_window.motion
    amplitude_cholesky = motion_without_touch.amplitude_cholesky
    amplitude_count = motion_without_touch.free_vibration.poles.size * 2
    position_fraction = likely_obstacle[:1] / touch_tables.model.plant.beam.length_m
    step_count = motion_without_touch.displacement_m.shape[1]
    # Times from the record's beginning, as for the amplitudes.
    t = (
        motion_without_touch.first_s
        + touch_tables.model.angle_delay_s
        + motion_without_touch.step_s * np.arange(step_count)
    )
    displacement_m = motion_without_touch.free_vibration.at_positions(
        position_fraction
    ).displacement(t, amplitude_cholesky[:amplitude_count])[0]
    direct_effects = (
        motion_without_touch.design_matrices[
            :, sample_window.first_sample : sample_window.end_sample
        ]
        @ amplitude_cholesky
    )
    return direct_effects.transpose(2, 0, 1) + obstacle_contact.effect_of_changed_motion(
        likely_obstacle, sample_window, displacement_m.T
    )


def _encoder_noise_effects(
    touch_tables: TouchTables,
    obstacle_contact: ObstacleContact,
    likely_obstacle: RealArray,
    sample_window: WhitenedWindow,
) -> RealArray:
    """Return the effects of the encoder's noise on the innovations, shape (samples, c, n).

    Each is the effect of the noise in one sample of the angle through the contact force.
    """
    motion_without_touch = sample_window.motion
    sample_indices = np.arange(sample_window.first_sample, sample_window.end_sample)
    nearest_position_index = int(np.argmin(np.abs(touch_tables.x_m - likely_obstacle[0])))
    sample_displacement = touch_tables.free_beam.displacement_per_sample(
        nearest_position_index, sample_indices.size + 8
    )
    # Columns begin four samples before the window.
    window_steps = np.arange(motion_without_touch.displacement_m.shape[1]) - 4 * STEPS_PER_SAMPLE
    response_index = (
        window_steps[None, :]
        - STEPS_PER_SAMPLE
        * (sample_indices - sample_window.first_sample - SPLINE_FADE_SAMPLES)[:, None]
    )
    displacement_m = np.where(
        (response_index >= 0) & (response_index < sample_displacement.size),
        sample_displacement[np.clip(response_index, 0, sample_displacement.size - 1)],
        0.0,
    )
    return obstacle_contact.effect_of_changed_motion(
        likely_obstacle, sample_window, motion_without_touch.angle_noise_rad * displacement_m
    )
