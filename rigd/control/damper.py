"""Active damping of the beam: the motor that holds it yields to its torque like a dashpot.

A motor whose speed is proportional to the torque of the beam takes energy out of every mode of any
beam. The damper moves the reference in this way; a lead compensates the lag of the loop, and slow
torques are filtered out, so that the motor stays in position. The stability with loop, delays and
beam is checked on the closed loop.
"""

from dataclasses import dataclass, replace
from math import exp
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from rigd.control._closed_loop import ClosedLoop

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

_STRENGTH = 0.25
"""Speed per torque, times the beam's inertia and the frequency of its first mode: the damping ratio
becomes about half of that. Twice as much gains little, and is less stable at the third mode."""
_HALVINGS = 5
_STIFFNESSES = (0.8, 1.0, 1.25)
"""Stiffnesses of the beam, over the profile's, for which the loop has to be stable."""
_SLOW = 0.25
"""Corner below which torques are filtered out, over the frequency of the first mode."""


@dataclass(frozen=True, slots=True)
class DamperSettings:
    """Settings of the active damping, for one rig."""

    yield_rad_per_nm_s: float
    """Speed of the reference per torque of the beam."""
    lead_s: float
    """Lead that compensates the lag of the loop."""
    slow_rad_s: float
    """Corner below which torques are filtered out."""
    fast_rad_s: float
    """Corner above which torques are filtered out."""


class VibrationDamper:
    """Moves a reference so that the beam's vibration decays.

    Parameters
    ----------
    settings
        From `design_damper`.
    rate_hz
        Ticks a second.

    Examples
    --------
    >>> from rigd.control.damper import DamperSettings, VibrationDamper
    >>> damper = VibrationDamper(DamperSettings(10.0, 0.025, 4.0, 320.0), rate_hz=1000)
    >>> damper.step(0.01) < 0  # a positive torque of the beam moves the reference backward
    True
    """

    def __init__(self, settings: DamperSettings, rate_hz: float) -> None:
        self._law = _Law(settings, rate_hz)
        self._state = 0.0, 0.0, 0.0

    def step(self, coupling_torque_nm: float) -> float:
        """Return the movement of the reference in this tick, in rad.

        Parameters
        ----------
        coupling_torque_nm
            Measured torque.
        """
        self._state, moved_rad = self._law.advance(self._state, coupling_torque_nm)
        return moved_rad


_Signal = TypeVar("_Signal", float, Real)


class _Law:
    """Recursion over numbers in the control loop, or over rows of its states in the design."""

    def __init__(self, settings: DamperSettings, rate_hz: float) -> None:
        self._gain = settings.yield_rad_per_nm_s / rate_hz
        self._lead = settings.yield_rad_per_nm_s * settings.lead_s
        self._take = 1.0 - exp(-settings.fast_rad_s / rate_hz)
        self._leak = 1.0 - exp(-settings.slow_rad_s / rate_hz)

    def advance(
        self, state: tuple[_Signal, _Signal, _Signal], torque: _Signal
    ) -> tuple[tuple[_Signal, _Signal, _Signal], _Signal]:
        """Return the next state (both filters, leaky integral) and the movement."""
        fast, slow, yielded = state
        fast = fast + self._take * (torque - fast)
        slow = slow + self._leak * (fast - slow)
        swing = fast - slow
        yielded = yielded - self._leak * yielded + self._gain * swing
        return (fast, slow, yielded), -yielded - self._lead * swing


def design_damper(loop: "ClosedLoop") -> DamperSettings | None:
    """Choose the active damping of a rig.

    Parameters
    ----------
    loop
        Closed loop of the rig.

    Returns
    -------
    DamperSettings or None
        The strongest damping that leaves the loop stable on beams of several stiffnesses with
        almost no damping of their own; None without one, or without a beam.

    Raises
    ------
    RealisationError
        If such a beam cannot be realised.
    """
    # Imported here: the control process uses a finished design, and starts sooner without these.
    from rigd.beam import undamped_frequencies_rad_s
    from rigd.control._closed_loop import MAX_GROWTH_PER_S, close_loop, light_beam

    model = loop.model
    if model.beam is None:
        return None
    first_rad_s = float(undamped_frequencies_rad_s(model.beam, 1)[0])
    settings = DamperSettings(
        yield_rad_per_nm_s=_STRENGTH / (model.beam.inertia_kg_m2 * first_rad_s),
        lead_s=2.0 / model.settings.pole_rad_s,
        slow_rad_s=_SLOW * first_rad_s,
        fast_rad_s=4.0 * model.settings.pole_rad_s,
    )
    stiffness = model.beam.bending_stiffness_n_m2
    beams = [replace(model.beam, bending_stiffness_n_m2=part * stiffness) for part in _STIFFNESSES]
    loops = [close_loop(light_beam(model, beam)) for beam in beams]
    for _ in range(_HALVINGS):
        growths = [damped_poles(each, settings).real.max() for each in loops]
        # The same growth as without it is allowed, on beams with almost no damping of their own.
        if max(growths) <= MAX_GROWTH_PER_S:
            return settings
        settings = replace(settings, yield_rad_per_nm_s=0.5 * settings.yield_rad_per_nm_s)
    return None


def damped_poles(loop: "ClosedLoop", settings: DamperSettings) -> Complex:
    """Return the poles of a closed loop with active damping, in rad/s.

    Parameters
    ----------
    loop
        Closed loop without it.
    settings
        Active damping.
    """
    from rigd.control._closed_loop import continuous_poles

    n, rate_hz = loop.b.size, loop.model.rate_hz
    reading = next(cut.reading for cut in loop.cuts if cut.name == "torque reading")
    fast, slow, yielded = np.eye(3, n + 3, n)
    states, moved = _Law(settings, rate_hz).advance(
        (fast, slow, yielded), np.append(reading, np.zeros(3))
    )
    a = np.zeros((n + 3, n + 3))
    a[:n, :n] = loop.a
    a[:n] += np.outer(loop.b, moved)
    a[n:] = states
    return continuous_poles(a, rate_hz)
