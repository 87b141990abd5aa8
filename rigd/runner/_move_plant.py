"""Rig model for the planning of moves: its closed loop, optionally with an identified beam."""

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
"""Number of modes that a move leaves at rest; higher modes are too weak to be observed."""
_UNSURE = 0.01
"""Assumed relative uncertainty of the mode frequencies of a profile's beam."""
_FILTERS = 1.2
"""Largest reference acceleration over the acceleration of the free motor at peak torque. It exceeds
1 because the filters of the loop smooth the reference."""
_SETTLED = 5.0
"""Settling time of the loop, in time constants."""
_DRAWS = 4
"""Number of noise realisations for the predicted vibration after a move."""


def loop_model_with(profile: Profile, found: IdentifiedBeam | None) -> LoopModel:
    """Return the loop model of a rig with an identified beam and its channel parameters."""
    model = profile.loop_model()
    if found is None:
        return model
    model = with_beam(model, found.loaded_beam)
    if found.tool_inertia_kg_m2 is not None:
        model = replace(model, tool_inertia_kg_m2=found.tool_inertia_kg_m2)
    if found.delay_s is not None:
        # Only the difference of the two delays is identified, and neither can be negative.
        angle_s = max(model.angle_delay_s, -found.delay_s)
        model = replace(model, angle_delay_s=angle_s, torque_delay_s=angle_s + found.delay_s)
    return model


def with_beam(model: LoopModel, loaded: LoadedBeam) -> LoopModel:
    """Return a loop model with another loaded beam."""
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
    """Return the rig model for the planning of a move; `found` is None without an analysis."""
    # The friction compensation (tanh of the speed) is not linear: its maximum is subtracted.
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
    """Return the noise of one torque reading: simulated noise, or the resolution of the sensor."""
    rig = profile.rig
    axes = np.array(rig.sensor.resolution)
    if rig.simulation is not None:
        axes = np.repeat([rig.simulation.force_noise_n, rig.simulation.torque_noise_nm], 3)
    return float(np.linalg.norm(np.array(rig.sensor.projection) * axes))


def mode_poles(loop: ClosedLoop) -> tuple[Complex, Complex]:
    """Return the poles of the beam with locked hub and of the closed loop, in rad/s, (m,) each.

    One pole of each pair is returned, for the lowest modes that oscillate below half the Nyquist
    frequency. While the motor is held, the closed loop vibrates: its poles are near those of the
    beam with locked hub, and differ from them where the loop damps a mode.
    """
    model = loop.model
    locked = model.loaded_beam.poles(clamped_free_eigenvalues(_MOST_MODES))[:, 0]
    locked = locked[(locked.imag > 0.0) & (np.abs(locked) < 0.5 * math.pi * model.rate_hz)]
    closed = [loop.poles_rad_s[np.argmin(np.abs(loop.poles_rad_s - s))] for s in locked]
    return locked, np.array(closed)
