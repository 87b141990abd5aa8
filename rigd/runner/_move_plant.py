"""Model of motor, beam and closed loop that is used to plan moves."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rigd.beam import clamped_free_eigenvalues
from rigd.control import (
    ClosedLoop,
    Disturbances,
    LoopModel,
    check_stability,
    close_loop,
    simulate_disturbed,
)
from rigd.excitation import MovePlant
from rigd.identified_beam import IdentifiedBeam
from rigd.profile import Profile

RealArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_MAX_MOVE_MODES = 6
"""Maximum number of modes whose vibration a move suppresses; higher modes are negligible."""
_DEFAULT_FREQUENCY_UNCERTAINTY = 0.01
"""Assumed relative uncertainty of the mode frequencies of the profile's beam."""
_MAX_REFERENCE_ACCELERATION_RATIO = 1.2
"""Ratio of the largest reference acceleration to the motor's acceleration at peak torque without
load. It exceeds 1 because the filters of the loop smooth the reference."""
_SETTLING_TIME_CONSTANTS = 5.0
"""Settling time of the closed loop as a multiple of its time constant."""
_NOISE_REALISATIONS = 4
"""Number of noise realisations from which the vibration after a move is predicted."""


def loop_model_with(profile: Profile, identified_beam: IdentifiedBeam | None) -> LoopModel:
    """Return the model of a rig's control loop, with the identified beam and delay if given.

    If `identified_beam` is None, all values are those of the profile.
    """
    loop_model = profile.loop_model()
    if identified_beam is None:
        return loop_model
    # Only the difference of the two delays is identified, and neither can be negative.
    delay_s = identified_beam.plant.delay_s
    angle_delay_s = max(loop_model.angle_delay_s, -delay_s)
    return replace(
        loop_model,
        plant=identified_beam.plant,
        angle_delay_s=angle_delay_s,
        torque_delay_s=angle_delay_s + delay_s,
    )


def move_plant_of(
    profile: Profile,
    loop_model: LoopModel,
    coupling_limit_nm: float,
    identified_beam: IdentifiedBeam | None = None,
) -> MovePlant:
    """Return the model of motor, beam and closed loop that is used to plan a move.

    `coupling_limit_nm` is the largest coupling torque that the sensor can measure. `loop_model`
    contains the beam; `identified_beam` states its uncertainty, or is None for the beam of the
    profile.
    """
    # The friction compensation (tanh of the speed) is not linear, and its maximum is subtracted
    # from the available torque.
    uncompensated_settings = replace(loop_model.settings, friction_compensation_nm=0.0)
    uncompensated_loop = close_loop(replace(loop_model, settings=uncompensated_settings))
    check_stability(uncompensated_loop)
    locked_hub_poles, closed_loop_poles = mode_poles(uncompensated_loop)
    # Torque of a mode for the angle's acceleration: 2 Re(r exp(p t)), r its residue in G(s)/s².
    assert loop_model.plant is not None
    torque_per_angle = 2.0 * np.abs(loop_model.plant.residues(locked_hub_poles))
    relative_frequency_uncertainty = (_DEFAULT_FREQUENCY_UNCERTAINTY,) * closed_loop_poles.size
    if identified_beam is not None:
        relative_frequency_uncertainty = identified_beam.pole_uncertainty(closed_loop_poles.size)
    control_motor, rig = profile.control_motor, profile.rig
    disturbances = Disturbances(
        control_motor.coulomb_nm, rig.encoder.resolution_rad, torque_noise_nm(profile)
    )
    compensated_loop = replace(uncompensated_loop, model=loop_model)

    def respond_disturbed(reference_rad: RealArray, mode_count: int) -> tuple[RealArray, RealArray]:
        disturbed_response = simulate_disturbed(
            compensated_loop,
            reference_rad,
            disturbances,
            mode_count=mode_count,
            draw_count=_NOISE_REALISATIONS,
        )
        return disturbed_response.angle_rad, disturbed_response.mode_torque_nm

    return MovePlant(
        rate_hz=loop_model.rate_hz,
        respond=uncompensated_loop.simulate,
        respond_disturbed=respond_disturbed,
        poles_rad_s=closed_loop_poles,
        torque_per_state_nm_s=torque_per_angle
        * np.abs(uncompensated_loop.response(np.abs(closed_loop_poles) / (2.0 * math.pi))),
        frequency_uncertainty=np.array(relative_frequency_uncertainty),
        torque_noise_nm=disturbances.torque_noise_nm,
        settling_s=_SETTLING_TIME_CONSTANTS / uncompensated_settings.pole_rad_s,
        peak_torque_nm=control_motor.peak_torque_nm,
        friction_nm=profile.control.friction_compensation_nm,
        max_acceleration_rad_s2=_MAX_REFERENCE_ACCELERATION_RATIO
        * control_motor.peak_torque_nm
        / control_motor.inertia_kg_m2,
        max_velocity_rad_s=profile.limits.velocity_rad_s,
        max_tracking_error_rad=profile.limits.tracking_error_rad,
        max_coupling_torque_nm=coupling_limit_nm,
        max_angle_rad=profile.limits.angle_rad,
        model=identified_beam,
    )


def torque_noise_nm(profile: Profile) -> float:
    """Return the standard deviation of the noise of a coupling torque reading, in N·m.

    It is computed from the simulated noise, or from the resolution of a real sensor.
    """
    rig = profile.rig
    axis_noise = np.array(rig.sensor.resolution)
    if rig.simulation is not None:
        axis_noise = np.repeat([rig.simulation.force_noise_n, rig.simulation.torque_noise_nm], 3)
    return float(np.linalg.norm(np.array(rig.sensor.projection) * axis_noise))


def mode_poles(closed_loop: ClosedLoop) -> tuple[ComplexArray, ComplexArray]:
    """Return the poles of the beam with locked hub, and the closed loop's poles, in rad/s.

    The arrays (m,) contain one pole of each conjugate pair, for the lowest modes that oscillate
    below half the Nyquist frequency. While the motor holds its angle, the beam vibrates with the
    poles of the closed loop. They are near those of the beam with locked hub, and differ if the
    loop damps a mode.
    """
    loop_model = closed_loop.model
    assert loop_model.plant is not None
    locked_hub_poles = loop_model.plant.poles(clamped_free_eigenvalues(_MAX_MOVE_MODES))[:, 0]
    locked_hub_poles = locked_hub_poles[
        (locked_hub_poles.imag > 0.0)
        & (np.abs(locked_hub_poles) < 0.5 * math.pi * loop_model.rate_hz)
    ]
    closed_loop_poles = [
        closed_loop.poles_rad_s[np.argmin(np.abs(closed_loop.poles_rad_s - s))]
        for s in locked_hub_poles
    ]
    return locked_hub_poles, np.array(closed_loop_poles)
