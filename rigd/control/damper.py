"""Active damping of the beam: the motor that holds it yields to its torque like a dashpot.

A motor whose speed is proportional to the torque of the beam takes energy out of every mode of any
beam. The damper moves the reference in this way. A lead compensates the lag of the loop, and slow
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

RealArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_RELATIVE_DAMPER_GAIN = 0.25
"""Speed of the reference per torque, times the beam's inertia and the frequency of its first mode.
The damping ratio becomes about half of this number. Twice as much gains little, and is less stable
at the third mode."""
_MAX_GAIN_HALVINGS = 5
"""Largest number of times that the strength of the damping is halved to make the loop stable."""
_STIFFNESS_RATIOS = (0.8, 1.0, 1.25)
"""Ratios of the beam's stiffness to the profile's for which the loop must be stable."""
_HIGH_PASS_CORNER_RATIO = 0.25
"""Frequency below which torques are filtered out, relative to that of the first mode."""


@dataclass(frozen=True, slots=True)
class DamperSettings:
    """Settings of the active damping of one rig's beam: gain, lead and corners of the filters."""

    gain_rad_per_nm_s: float
    """Speed of the reference per torque of the beam."""
    lead_s: float
    """Lead time that compensates the lag of the loop."""
    high_pass_rad_s: float
    """Corner frequency below which torques are filtered out."""
    low_pass_rad_s: float
    """Corner frequency above which torques are filtered out."""


class VibrationDamper:
    """Active damper: moves the reference angle of the motor so that the beam's vibration decays.

    Parameters
    ----------
    settings
        Settings from `design_damper`.
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
        self._damping_law = _DampingLaw(settings, rate_hz)
        self._state = 0.0, 0.0, 0.0

    def step(self, coupling_torque_nm: float) -> float:
        """Return the displacement of the reference from its resting angle in this tick, in rad.

        Parameters
        ----------
        coupling_torque_nm
            Measured coupling torque.
        """
        self._state, displacement_rad = self._damping_law.advance(self._state, coupling_torque_nm)
        return displacement_rad


_Signal = TypeVar("_Signal", float, RealArray)


class _DampingLaw:
    """Control law of the active damping, applied tick by tick.

    It works with numbers in the control loop, and with row vectors of states in the design.
    """

    def __init__(self, settings: DamperSettings, rate_hz: float) -> None:
        self._gain = settings.gain_rad_per_nm_s / rate_hz
        self._lead = settings.gain_rad_per_nm_s * settings.lead_s
        self._low_pass_coefficient = 1.0 - exp(-settings.low_pass_rad_s / rate_hz)
        self._high_pass_coefficient = 1.0 - exp(-settings.high_pass_rad_s / rate_hz)

    def advance(
        self, law_state: tuple[_Signal, _Signal, _Signal], torque_value: _Signal
    ) -> tuple[tuple[_Signal, _Signal, _Signal], _Signal]:
        """Compute one tick: return the next state, and the displacement of the reference in rad.

        The state consists of both filters and the leaky integral.
        """
        low_passed_torque, slow_torque, leaky_integral = law_state
        low_passed_torque = low_passed_torque + self._low_pass_coefficient * (
            torque_value - low_passed_torque
        )
        slow_torque = slow_torque + self._high_pass_coefficient * (low_passed_torque - slow_torque)
        filtered_torque = low_passed_torque - slow_torque
        leaky_integral = (
            leaky_integral
            - self._high_pass_coefficient * leaky_integral
            + self._gain * filtered_torque
        )
        return (
            low_passed_torque,
            slow_torque,
            leaky_integral,
        ), -leaky_integral - self._lead * filtered_torque


def design_damper(closed_loop: "ClosedLoop") -> DamperSettings | None:
    """Return the settings of the active damping for a rig, or None if none is stable.

    Parameters
    ----------
    closed_loop
        Closed loop of the rig.

    Returns
    -------
    DamperSettings or None
        The strongest damping with which the loop is stable on beams of several stiffnesses with
        almost no damping of their own. None if no such damping is found, or there is no beam.

    Raises
    ------
    RealisationError
        If such a beam cannot be realised.
    """
    # Imported here: the control process uses a finished design, and starts sooner without these.
    from rigd.beam import undamped_frequencies_rad_s
    from rigd.control._closed_loop import (
        MAX_OSCILLATION_GROWTH_PER_S,
        close_loop,
        lightly_damped_model,
    )

    loop_model = closed_loop.model
    if (plant := loop_model.plant) is None:
        return None
    first_mode_rad_s = float(undamped_frequencies_rad_s(plant.beam, 1)[0])
    settings = DamperSettings(
        gain_rad_per_nm_s=_RELATIVE_DAMPER_GAIN / (plant.beam.inertia_kg_m2 * first_mode_rad_s),
        lead_s=2.0 / loop_model.settings.pole_rad_s,
        high_pass_rad_s=_HIGH_PASS_CORNER_RATIO * first_mode_rad_s,
        low_pass_rad_s=4.0 * loop_model.settings.pole_rad_s,
    )
    bending_stiffness_n_m2 = plant.beam.bending_stiffness_n_m2
    varied_beams = [
        replace(plant.beam, bending_stiffness_n_m2=stiffness_ratio * bending_stiffness_n_m2)
        for stiffness_ratio in _STIFFNESS_RATIOS
    ]
    lightly_damped_loops = [
        close_loop(lightly_damped_model(loop_model, replace(plant, beam=beam)))
        for beam in varied_beams
    ]
    for _ in range(_MAX_GAIN_HALVINGS):
        growth_rates_per_s = [
            damped_poles(damped_loop, settings).real.max() for damped_loop in lightly_damped_loops
        ]
        # The same growth as without it is allowed, on beams with almost no damping of their own.
        if max(growth_rates_per_s) <= MAX_OSCILLATION_GROWTH_PER_S:
            return settings
        settings = replace(settings, gain_rad_per_nm_s=0.5 * settings.gain_rad_per_nm_s)
    return None


def damped_poles(closed_loop: "ClosedLoop", settings: DamperSettings) -> ComplexArray:
    """Return the poles of a closed loop with active damping, in rad/s.

    Parameters
    ----------
    closed_loop
        Closed loop without active damping.
    settings
        Settings of the active damping.
    """
    from rigd.control._closed_loop import continuous_poles

    n, rate_hz = closed_loop.b.size, closed_loop.model.rate_hz
    torque_reading = next(
        opening.reading_row for opening in closed_loop.openings if opening.name == "torque reading"
    )
    fast_row, slow_row, leaky_integral = np.eye(3, n + 3, n)
    next_states, displacement = _DampingLaw(settings, rate_hz).advance(
        (fast_row, slow_row, leaky_integral), np.append(torque_reading, np.zeros(3))
    )
    a = np.zeros((n + 3, n + 3))
    a[:n, :n] = closed_loop.a
    a[:n] += np.outer(closed_loop.b, displacement)
    a[n:] = next_states
    return continuous_poles(a, rate_hz)
