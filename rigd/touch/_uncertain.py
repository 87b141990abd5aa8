"""Effects of uncertainties on the innovations of a touch.

The uncertainties are those of the model's parameters, the time steps of the integration, the free
motion and the encoder's steps, with their effects on the instant of touch.
"""

import numpy as np
from numpy.typing import NDArray

from rigd.touch._free_motion import SPLINE_FADE_SAMPLES, STEPS_PER_SAMPLE, TouchRecord
from rigd.touch._kernels import contact_kernels
from rigd.touch._physical import ObstacleContact, WhitenedWindow
from rigd.touch._tables import TouchTables

Real = NDArray[np.float64]


def uncertainty_effects(
    tables: TouchTables, record: TouchRecord, likeliest: Real, window: WhitenedWindow
) -> Real:
    """Return the effects of r uncertainties on the innovations, for one standard deviation each.

    The shape is (c, n, r), with c = 1 for torque alone and 2 for torque and base shear.

    Parameters
    ----------
    tables
        Precomputed quantities of the model at the record's rate.
    record
        Samples around the touch.
    likeliest
        Position, instant and logarithm of the stiffness of the likeliest obstacle, shape (1, 3).
    window
        Innovations from a sample that is certainly before the touch to the end.
    """
    motion, quiet = window.motion, window.first
    finest_effect = ObstacleContact(tables.finest, tables.x_m, motion).predict(likeliest, window)[
        0
    ][0]
    contact = ObstacleContact(tables.middle, tables.x_m, motion)
    middle_effect = contact.predict(likeliest, window)[0][0]
    effects = [
        finest_effect - middle_effect,
        *_free_motion_effects(tables, contact, likeliest[0], window),
        *_encoder_noise_effects(tables, contact, likeliest[0], window),
    ]
    span = slice(window.first, window.end)
    residual = motion.innovations[:, span] - middle_effect
    x = float(likeliest[0, 0])
    nearby_m = min(x, tables.x_m[-1] - 1.5e-3) + 1e-3 * np.arange(-1.5, 2.0)
    for free in tables.changed:
        changed = free.at_positions(nearby_m).motion(
            record, quiet, quiet - 4, motion.angle_transform
        )
        kernels = contact_kernels(
            free.model.beam,
            free.model.damping,
            np.array([x]),
            tables.middle.step_s,
            round((motion.t[-1] - likeliest[0, 1]) / tables.middle.step_s) + 4,
            free.model.sensor_filter,
        )
        effect, _ = ObstacleContact(kernels, nearby_m, changed).predict(
            likeliest, window, kernels=kernels
        )
        effects.append(changed.innovations[:, span] - effect[0] - residual)
    return np.stack(effects, axis=-1)


def _free_motion_effects(
    tables: TouchTables, contact: ObstacleContact, likeliest: Real, window: WhitenedWindow
) -> Real:
    """Return the effects of the free motion's uncertainty on the innovations, (q, c, n).

    They include the effects through the contact, such as another instant of touch.
    """
    motion = window.motion
    spread = motion.spread
    count = motion.ringing.poles.size * 2
    position_fraction = likeliest[:1] / tables.model.beam.length_m
    steps = motion.displacement_m.shape[1]
    # Times from the record's beginning, as for the amplitudes.
    t = motion.first_s + tables.model.angle_delay_s + motion.step_s * np.arange(steps)
    displacement_m = motion.ringing.at_positions(position_fraction).displacement(t, spread[:count])[
        0
    ]
    direct = motion.design[:, window.first : window.end] @ spread
    return direct.transpose(2, 0, 1) + contact.effect_of_changed_motion(
        likeliest, window, displacement_m.T
    )


def _encoder_noise_effects(
    tables: TouchTables, contact: ObstacleContact, likeliest: Real, window: WhitenedWindow
) -> Real:
    """Return the effects of the encoder's noise through the contact on the innovations.

    There is one for each sample of the angle; the shape is (samples, c, n).
    """
    motion = window.motion
    samples = np.arange(window.first, window.end)
    nearest = int(np.argmin(np.abs(tables.x_m - likeliest[0])))
    sample_displacement = tables.free.displacement_per_sample(nearest, samples.size + 8)
    # Columns begin four samples before the window.
    window_steps = np.arange(motion.displacement_m.shape[1]) - 4 * STEPS_PER_SAMPLE
    index = (
        window_steps[None, :]
        - STEPS_PER_SAMPLE * (samples - window.first - SPLINE_FADE_SAMPLES)[:, None]
    )
    displacement_m = np.where(
        (index >= 0) & (index < sample_displacement.size),
        sample_displacement[np.clip(index, 0, sample_displacement.size - 1)],
        0.0,
    )
    return contact.effect_of_changed_motion(
        likeliest, window, motion.angle_noise_rad * displacement_m
    )
