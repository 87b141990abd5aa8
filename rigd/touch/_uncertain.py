"""Effects of uncertainties on the innovations of a touch.

The uncertainties are those of the model's parameters, the time steps of the integration, the free
motion and the encoder's steps, with their effects on the instant of touch.
"""

import numpy as np
from numpy.typing import NDArray

from rigd.touch._free_motion import BEFORE, FINER, TouchRecord
from rigd.touch._kernels import contact_kernels
from rigd.touch._physical import Touching, WhitenedWindow
from rigd.touch._tables import Tables

Real = NDArray[np.float64]


def deviations(tables: Tables, record: TouchRecord, best: Real, whole: WhitenedWindow) -> Real:
    """Return the effects of r uncertainties on the innovations, for one standard deviation each.

    The shape is (c, n, r), with c = 1 for torque alone and 2 for torque and base shear.

    Parameters
    ----------
    tables
        Precomputed quantities of the model at the record's rate.
    record
        Samples around the touch.
    best
        Position, instant and logarithm of the stiffness of the likeliest obstacle, shape (1, 3).
    whole
        Innovations from a sample that is certainly before the touch to the end.
    """
    motion, quiet = whole.motion, whole.first
    fine = Touching(tables.finest, tables.x_m, motion).predicted(best, whole)[0][0]
    touching = Touching(tables.middle, tables.x_m, motion)
    middle = touching.predicted(best, whole)[0][0]
    columns = [
        fine - middle,
        *_ringing(tables, touching, best[0], whole),
        *_angle_noise(tables, touching, best[0], whole),
    ]
    span = slice(whole.first, whole.end)
    left = motion.innovations[:, span] - middle
    x = float(best[0, 0])
    near = min(x, tables.x_m[-1] - 1.5e-3) + 1e-3 * np.arange(-1.5, 2.0)
    for free in tables.changed:
        changed = free.at(near).motion(record, quiet, quiet - 4, motion.turned)
        kernels = contact_kernels(
            free.model.beam,
            free.model.damping,
            np.array([x]),
            tables.middle.step_s,
            round((motion.t[-1] - best[0, 1]) / tables.middle.step_s) + 4,
            free.model.sensor_filter,
        )
        effect, _ = Touching(kernels, near, changed).predicted(best, whole, kernels=kernels)
        columns.append(changed.innovations[:, span] - effect[0] - left)
    return np.stack(columns, axis=-1)


def _ringing(tables: Tables, touching: Touching, best: Real, whole: WhitenedWindow) -> Real:
    """Return the effects of the free motion's uncertainty on the innovations, (q, c, n).

    They include the effects through the contact, such as another instant of touch.
    """
    motion = whole.motion
    spread = motion.spread
    count = motion.ringing.poles.size * 2
    there = best[:1] / tables.model.beam.length_m
    columns = motion.displacement_m.shape[1]
    # Times from the record's beginning, as for the amplitudes.
    t = motion.first_s + tables.model.angle_delay_s + motion.step_s * np.arange(columns)
    moved = motion.ringing.at(there).displacement(t, spread[:count])[0]
    direct = motion.design[:, whole.first : whole.end] @ spread
    return direct.transpose(2, 0, 1) + touching.passed_on(best, whole, moved.T)


def _angle_noise(tables: Tables, touching: Touching, best: Real, whole: WhitenedWindow) -> Real:
    """Return the effects of the encoder's noise through the contact on the innovations.

    There is one for each sample of the angle; the shape is (samples, c, n).
    """
    motion = whole.motion
    samples = np.arange(whole.first, whole.end)
    nearest = int(np.argmin(np.abs(tables.x_m - best[0])))
    one = tables.free.per_sample(nearest, samples.size + 8)
    # Columns begin four samples before the window.
    late = np.arange(motion.displacement_m.shape[1]) - 4 * FINER
    index = late[None, :] - FINER * (samples - whole.first - BEFORE)[:, None]
    moved = np.where((index >= 0) & (index < one.size), one[np.clip(index, 0, one.size - 1)], 0.0)
    return touching.passed_on(best, whole, motion.angle_noise_rad * moved)
