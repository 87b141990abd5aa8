"""Signatures of touches: what the innovations look like in the first ticks after a contact.

A touch far from the root shows late and with many signs, a soft one rises slowly. For a grid of
places and a few shapes of the force the exact model tells torque and base shear, with the motor
held; the filter of the innovations makes of them what the detector has to look for.
"""

from dataclasses import dataclass
from math import pi
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rigd.beam import Beam, Damping, PointForceGrid
from rigd.touch._innovations import InnovationFilter, Noise, ObservedBeam, observed_beam
from rigd.touch._sensor_filter import NO_FILTER, SensorFilter

if TYPE_CHECKING:  # a loop that watches does not read models
    from rigd.touch._model import TouchModel

Real = NDArray[np.float64]

_PLACES = np.array([0.05, 0.1, 0.16, 0.23, 0.31, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.98])
"""As shares of the length."""
_PULSES_S = (1.5e-3, 6e-3)
"""Half sines: hard obstacles let go of the beam at once."""
_RISE_S = 0.03
"""A soft one pushes harder and harder."""
_AGES_S = (3e-3, 5e-3, 7e-3, 10e-3, 14e-3, 24e-3)
"""Time from the contact to the tick that is judged."""
_FINER = 8
"""Steps of the calculation in a tick."""
_WRAPPED = 10.0
"""The end of the transform's period wraps around to exp(-10) of itself."""


@dataclass(frozen=True, slots=True, eq=False)
class WatchedBeam:
    """What a `TouchDetector` knows of a beam."""

    observed: ObservedBeam
    """The beam as it moves freely, with its noise."""
    signatures: Real
    """What a touch looks like, from `signatures`."""


def watched_beam(model: "TouchModel", rate_hz: float, noise: Noise) -> WatchedBeam:
    """Prepare the detection of touches.

    Parameters
    ----------
    model
        The beam.
    rate_hz
        Ticks a second.
    noise
        Noise of the channels.
    """
    observed = observed_beam(
        model.beam,
        model.damping,
        rate_hz,
        noise,
        tool_inertia_kg_m2=model.tool_inertia_kg_m2,
        torque_after_angle_s=model.wrench_delay_s - model.angle_delay_s,
        sensor_filter=model.sensor_filter,
    )
    looks = signatures(model.beam, model.damping, rate_hz, observed, model.sensor_filter)
    return WatchedBeam(observed, looks)


def signatures(
    beam: Beam,
    damping: Damping,
    rate_hz: float,
    model: ObservedBeam,
    sensor_filter: SensorFilter = NO_FILTER,
) -> Real:
    """Return unit vectors of the last innovations, one for each place, shape of force and age.

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
        Torque and shear of the oldest tick first.
    """
    ages = [max(1, round(age_s * rate_hz)) for age_s in _AGES_S]
    ticks = max(ages)
    step_s = 1 / (_FINER * rate_hz)
    steps = 8 * _FINER * ticks
    t = np.arange(steps) * step_s
    shift = _WRAPPED / (steps * step_s)
    grown = np.exp(shift * t)
    s = shift + 2j * pi * np.fft.rfftfreq(steps, step_s)
    grid = PointForceGrid(s, beam, damping)
    places = beam.length_m * _PLACES
    per_force = np.stack([grid.torque_per_force(places), grid.shear_per_force(places)])
    per_force *= sensor_filter.response(s)[:, None]
    forces = [np.where(t < pulse, np.sin(pi * t / pulse), 0.0) for pulse in _PULSES_S]
    forces.append(np.minimum(t / _RISE_S, 1.0))

    found = []
    for force in forces:
        transform = np.fft.rfft(force / grown)[:, None]
        readings = np.fft.irfft(per_force * transform, steps, axis=1) * grown[:, None]
        for torque, shear in np.moveaxis(readings[:, ::_FINER], -1, 0):
            white = _whitened(model, torque[: ticks + 1], shear[: ticks + 1])[1:]
            for age in ages:
                vector = np.zeros((ticks, 2))
                vector[ticks - age :] = white[:age]
                found.append(vector.ravel())
    rows = np.array(found)
    size = np.linalg.norm(rows, axis=1)
    told: Real = rows[size > 0] / size[size > 0, None]
    return told


def _whitened(model: ObservedBeam, torque: Real, shear: Real) -> Real:
    filter_ = InnovationFilter(model)
    white = np.empty((torque.size, 2))
    for tick, readings in enumerate(zip(torque.tolist(), shear.tolist(), strict=True)):
        filter_.step(0.0, *readings)
        white[tick] = filter_.whitened
    return white
