"""The rig as the planning of moves knows it: its closed loop, with the beam of an analysis."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rigd.beam import LoadedBeam, clamped_free_eigenvalues
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

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

_MOST_MODES = 6
"""Modes that a move leaves at rest; those above are too weak to be seen."""
_UNSURE = 0.01
"""Relative uncertainty of the frequencies of a profile's beam, which nobody states."""
_FILTERS = 1.2
"""Acceleration of a move's reference over what the peak torque does to the motor alone: some more,
for the loop follows it through its filters."""
_SETTLED = 5.0
"""Time constants of the loop in which it follows up a reference."""
_DRAWS = 4
"""Draws of the noise from which the vibration after a move is predicted."""


def loop_model_with(profile: Profile, found: IdentifiedBeam | None) -> LoopModel:
    """Return the loop of a rig with an identified beam, and with the channels found with it.

    Parameters
    ----------
    profile
        Profile of the rig.
    found
        Beam of an analysis; None: the profile's.
    """
    model = profile.loop_model()
    if found is None:
        return model
    model = with_beam(model, found.loaded_beam)
    if found.tool_inertia_kg_m2 is not None:
        model = replace(model, tool_inertia_kg_m2=found.tool_inertia_kg_m2)
    if found.delay_s is not None:
        # Only the difference of both ages is identified, and neither can be negative.
        angle_s = max(model.angle_delay_s, -found.delay_s)
        model = replace(model, angle_delay_s=angle_s, torque_delay_s=angle_s + found.delay_s)
    return model


def with_beam(model: LoopModel, loaded: LoadedBeam) -> LoopModel:
    """Return a loop with another beam and what is at its ends.

    Parameters
    ----------
    model
        The loop.
    loaded
        The beam.
    """
    return replace(
        model,
        beam=loaded.beam,
        damping=loaded.damping,
        tip_mass_kg=loaded.tip_mass_kg,
        root_compliance_rad_per_nm=loaded.root_compliance_rad_per_nm,
        stiffness_offsets=loaded.stiffness_offsets,
    )


def move_plant_of(
    profile: Profile,
    model: LoopModel,
    coupling_limit_nm: float,
    found: IdentifiedBeam | None = None,
) -> MovePlant:
    """Return a rig for planning a move.

    Parameters
    ----------
    profile
        Profile of the rig.
    model
        Its loop, with the beam that the move is planned for.
    coupling_limit_nm
        Range of the sensor.
    found
        What an analysis says of that beam; None: it is a profile's or an estimate.

    Raises
    ------
    ControlDesignError
        If the loop is unstable with that beam.
    RealisationError
        If its damping cannot be realised.
    """
    # tanh of the speed is not linear: its largest value is taken off the torque.
    settings = replace(model.settings, friction_compensation_nm=0.0)
    loop = close_loop(replace(model, settings=settings))
    check_stability(loop)
    locked, ringing = mode_poles(loop)
    # Torque of a mode for the angle's acceleration: 2 Re(r exp(p t)), r its residue in G(s)/s².
    per_angle = 2.0 * np.abs(model.loaded_beam.residues(locked))
    uncertainty = (_UNSURE,) * ringing.size
    if found is not None:
        uncertainty = found.pole_uncertainty(ringing.size)
    motor, rig = profile.control_motor, profile.rig
    disturbances = Disturbances(
        motor.coulomb_nm, rig.encoder.resolution_rad, torque_noise_nm(profile)
    )
    compensated = replace(loop, model=model)

    def disturbed(reference_rad: Real, modes: int) -> tuple[Real, Real]:
        response = simulate_disturbed(
            compensated, reference_rad, disturbances, modes=modes, draws=_DRAWS
        )
        return response.angle_rad, response.mode_torque_nm

    return MovePlant(
        rate_hz=model.rate_hz,
        respond=loop.simulate,
        disturbed=disturbed,
        poles_rad_s=ringing,
        torque_per_state_nm_s=per_angle * np.abs(loop.response(np.abs(ringing) / (2.0 * math.pi))),
        frequency_uncertainty=np.array(uncertainty),
        torque_noise_nm=disturbances.torque_noise_nm,
        settling_s=_SETTLED / settings.pole_rad_s,
        peak_torque_nm=motor.peak_torque_nm,
        friction_nm=profile.control.friction_compensation_nm,
        largest_acceleration_rad_s2=_FILTERS * motor.peak_torque_nm / motor.inertia_kg_m2,
        velocity_rad_s=profile.limits.velocity_rad_s,
        tracking_error_rad=profile.limits.tracking_error_rad,
        coupling_torque_nm=coupling_limit_nm,
        angle_rad=profile.limits.angle_rad,
        model=found,
    )


def torque_noise_nm(profile: Profile) -> float:
    """Return the noise of one reading of the coupling torque, as the profile has it.

    Parameters
    ----------
    profile
        Profile of the rig: of a simulated one the noise, of another the resolution of its sensor.
    """
    rig = profile.rig
    axes = np.array(rig.sensor.resolution)
    if rig.simulation is not None:
        axes = np.repeat([rig.simulation.force_noise_n, rig.simulation.torque_noise_nm], 3)
    return float(np.linalg.norm(np.array(rig.sensor.projection) * axes))


def mode_poles(loop: ClosedLoop) -> tuple[Complex, Complex]:
    """Return the poles of the modes of the beam with locked hub, and of the closed loop, in rad/s.

    What rings on while the motor is held is the closed loop: its poles lie near those of the beam
    with locked hub, and where the loop damps them they differ.

    Parameters
    ----------
    loop
        Closed loop with a beam.

    Returns
    -------
    locked, closed : ndarray, shape (m,)
        One pole of each pair, of the lowest modes that oscillate and lie within reach of the ticks.
    """
    model = loop.model
    locked = model.loaded_beam.poles(clamped_free_eigenvalues(_MOST_MODES))[:, 0]
    locked = locked[(locked.imag > 0.0) & (np.abs(locked) < 0.5 * math.pi * model.rate_hz)]
    closed = [loop.poles_rad_s[np.argmin(np.abs(loop.poles_rad_s - s))] for s in locked]
    return locked, np.array(closed)
