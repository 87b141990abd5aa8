"""Records of rigs with defects: true properties of a rig, and the signals of its instruments.

The beam is of finite elements (`finite_element_beam`); nothing is taken from `rigd` or `analysis`.
A record is 136 s at 1 kHz: 1 s of rest, a chirp from 0.05 to 50 Hz in 120 s behind a motor loop of
20 Hz, 15 s of ring-down. The encoder has steps of 7e-5 rad, the torque sensor steps of 1.25e-4 N·m
and noise of 5 mN·m, white or coloured.

Linear rigs are computed on a shifted line of the Laplace plane, on a grid four times as fine as
the record's. A step in time conserves the state: the record after it is that of the changed beam
plus the free decay of the difference of the two states. The effect of drag is integrated in time.
Play, friction and the sensor's cubic gain act on signals.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from finite_element_beam import Complex, FiniteElementBeam, LockedHubMode, Real, resonance
from numpy.random import Generator
from scipy.fft import next_fast_len
from scipy.linalg import expm

RATE_HZ = 1000.0
REST_S, SWEEP_S, RECORD_S = 1.0, 120.0, 136.0
FIRST_HZ, LAST_HZ = 0.05, 50.0
LENGTH_M, DENSITY_KG_PER_M, STIFFNESS_N_M2 = 0.98, 4.7e-3, 0.090275
NOISE_NM = 5e-3
VISIBLE_PEAK = 2.0
"""Ratio of a mode's torque to the standard deviation of the noise above which it is visible."""

_ENCODER_RAD, _SENSOR_NM = 7e-5, 1.25e-4
_LOOP_RAD_S = 2 * np.pi * 20.0
_FINER = 4
_DECAY = 14.0
"""Aliases on the padded grid have decayed by exp(-14) = 1e-6; rounding has grown by 1e3."""
_VISIBLE_HZ = (0.3, 48.0)
_AIR_KG_M3, DRAG_COEFFICIENT = 1.2, 1.2
_MARCHED_MODES = 8
_DRAG_POINTS = 16
_LOCAL_POINTS = 2000


@dataclass(frozen=True, slots=True)
class DampingLaw:
    """Damping of the material and of the medium.

    Attributes
    ----------
    zeta, alpha : float or None
        Bending stiffness is multiplied by ``1 + zeta s^alpha``; None with relaxations.
    gamma, lambda_ : float
        The medium's force per length and deflection is ``gamma EI s^lambda``, EI as stated.
    relaxations : tuple of (strength, time_s)
        Bending stiffness is multiplied by ``1 + sum strength s time / (1 + s time)``.
    """

    zeta: float | None
    alpha: float | None
    gamma: float
    lambda_: float
    relaxations: tuple[tuple[float, float], ...] = ()

    def elastic(self, s: Complex) -> Complex:
        """Return the factor of the bending stiffness."""
        found = np.ones_like(s)
        if self.zeta is not None and self.alpha is not None:
            found = found + self.zeta * s**self.alpha
        for strength, time_s in self.relaxations:
            found = found + strength * s * time_s / (1 + s * time_s)
        return found

    def medium(self, s: Complex) -> Complex:
        """Return the force of the medium per length and deflection."""
        force: Complex = self.gamma * STIFFNESS_N_M2 * s**self.lambda_
        return force


def clamp_stiffness(clamp: tuple[float, float], s: Complex) -> Complex:
    """Return the stiffness of a clamp, from its value at rest and loss factor at 100 rad/s."""
    stiffness, loss = clamp
    found: Complex = stiffness * (1 + loss * (s / 100.0) ** 0.2 / np.sin(0.1 * np.pi))
    return found


def clamp_loss_factor(clamp: tuple[float, float], omega_rad_s: Real) -> Real:
    """Return the loss factor that a clamp adds to a mode; its energy fraction is 4 EI / (k L)."""
    stiffness = clamp_stiffness(clamp, 1j * omega_rad_s)
    found: Real = -4 * STIFFNESS_N_M2 / LENGTH_M * (1 / stiffness).imag
    return found


@dataclass(frozen=True, slots=True)
class TrueMode:
    """A mode of a rig with locked hub, and its residue in N·m/s.

    Attributes
    ----------
    mode : int
    frequency_hz, damping_ratio : float or None
        None where the rig has no such constant: with drag, damping depends on the motion.
    residue : complex
        Of measured torque per angle, at the pole of the upper half plane.
    peak_nm : float
        Largest torque of the mode in this record.
    visible : bool
        Swept, with a torque above `VISIBLE_PEAK` standard deviations of the noise.
    later_frequency_hz, later_damping_ratio : float, optional
        After a step in time.
    """

    mode: int
    frequency_hz: float | None
    damping_ratio: float | None
    residue: complex
    peak_nm: float
    visible: bool
    later_frequency_hz: float | None = None
    later_damping_ratio: float | None = None

    def document(self) -> dict[str, object]:
        """Return the mode as a JSON document."""
        return {
            "mode": self.mode,
            "frequency_hz": self.frequency_hz,
            "damping_ratio": self.damping_ratio,
            "residue": [self.residue.real, self.residue.imag],
            "peak_nm": self.peak_nm,
            "visible": self.visible,
            "later_frequency_hz": self.later_frequency_hz,
            "later_damping_ratio": self.later_damping_ratio,
        }


@dataclass(frozen=True, slots=True)
class NoiseSpectrum:
    """Noise of the torque: white, plus one that falls with frequency, plus bumps.

    Attributes
    ----------
    white_nm : float
        Standard deviation of the white part at `RATE_HZ`.
    corner_hz : float
        Frequency at which the 1/f part equals the white one; 0 without.
    bumps : tuple of (frequency_hz, relative_width, height)
        Power density around a frequency, relative to the white part.
    """

    white_nm: float = NOISE_NM
    corner_hz: float = 0.0
    bumps: tuple[tuple[float, float, float], ...] = ()

    def density(self, frequency_hz: Real) -> Real:
        """Return the power density over that of the white part."""
        found = np.ones_like(frequency_hz)
        if self.corner_hz:
            found = found + self.corner_hz / np.maximum(frequency_hz, 0.01)
        for centre, width, height in self.bumps:
            found = found + height / (1 + ((frequency_hz / centre - 1) / (width / 2)) ** 2)
        return found

    def drawn(self, count: int, generator: Generator) -> Real:
        """Draw a signal."""
        white = generator.standard_normal(2 * count)
        frequency_hz = np.fft.rfftfreq(2 * count, 1 / RATE_HZ)
        coloured = np.fft.rfft(white) * np.sqrt(self.density(frequency_hz))
        found: Real = self.white_nm * np.fft.irfft(coloured, 2 * count)[:count]
        return found


@dataclass(frozen=True, slots=True)
class TorqueChannel:
    """Channel from the torque of the beam to its record.

    Attributes
    ----------
    delay_s, tool_inertia_kg_m2 : float
    resonance_hz, quality : float
        A low-pass of second order; none with a resonance of 0.
    cubic : float
        Relative change of the gain at the largest torque of the record.
    friction_nm, friction_speed_rad_s : float
        Coulomb friction between sensor and beam, ``T tanh(speed / friction_speed)``.
    play_rad : float
        Gap between encoder and root.
    """

    delay_s: float = 0.0
    tool_inertia_kg_m2: float = 0.0
    resonance_hz: float = 0.0
    quality: float = 1.0
    cubic: float = 0.0
    friction_nm: float = 0.0
    friction_speed_rad_s: float = 0.01
    play_rad: float = 0.0

    def response(self, s: Complex) -> Complex:
        """Return the response from torque to recorded torque."""
        found = np.exp(-s * self.delay_s)
        if self.resonance_hz:
            turns = s / (2 * np.pi * self.resonance_hz)
            found = found / (1 + turns / self.quality + turns**2)
        return found


@dataclass(frozen=True, slots=True)
class Defect:
    """A rig that is not the uniform beam, or one that is (kind ``none``).

    Attributes
    ----------
    kind : str
    size : mapping
        Drawn values, for display.
    linear_constant : bool
    damping : DampingLaw
    beam : FiniteElementBeam
    channel : TorqueChannel
    alpha_range : tuple of float, optional
        Slopes of the loss of material and clamp over frequency, if they have no single order.
    clamp : tuple of (nm_per_rad, loss_factor), optional
        Elastic clamp. The modes cannot distinguish its loss from that of the material.
    effects : tuple of str
        Effects that the analyzer may state for this rig, in its words, with any size.
    constant_nm : float
        Constant load of gravity.
    step : tuple of (at_s, relative_change), optional
        Change of the bending stiffness in time.
    drag_m : float
        Diameter of a wire with air drag.
    """

    kind: str
    size: Mapping[str, object]
    linear_constant: bool
    damping: DampingLaw
    beam: FiniteElementBeam
    channel: TorqueChannel = TorqueChannel()
    alpha_range: tuple[float, float] | None = None
    clamp: tuple[float, float] | None = None
    effects: tuple[str, ...] = ()
    constant_nm: float = 0.0
    step: tuple[float, float] | None = None
    drag_m: float = 0.0

    def ranges(self) -> dict[str, tuple[float, float]]:
        """Return the least and largest true values, by the names of the analyzer.

        They are equal if the rig has a single value. A property that varies along the beam or in
        time has the range of its local values. Properties that the rig does not have are left out.

        A mass at the tip and an elastic clamp act on all modes alike, as density and stiffness do:
        these have the range up to the value of the uniform beam with the same modes.
        """
        law, channel = self.damping, self.channel
        x = np.linspace(0.0, LENGTH_M, _LOCAL_POINTS + 1)[:-1] + LENGTH_M / (2 * _LOCAL_POINTS)
        pivot = np.array([100j])
        stiffness = self.beam.stiffness_n_m2(x)
        for extra, factor in self.beam.patches:
            stiffness = stiffness + extra(x) * factor(pivot)[0].real
        over = self.beam.density_kg_per_m(x) / stiffness
        stiffer = 1 + sum(strength for strength, _ in law.relaxations)
        changed = (1.0, stiffer, 1.0 + (self.step[1] if self.step else 0.0))
        gains = (1.0, 1.0 + channel.cubic)
        low, high = stiffness.min() * min(changed), stiffness.max() * max(changed)
        heavier = 4 * self._tip_mass_kg / (DENSITY_KG_PER_M * LENGTH_M)
        softer = 4 * STIFFNESS_N_M2 / (LENGTH_M * self.clamp[0]) if self.clamp else 0.0
        found = {
            "gamma": (law.gamma * STIFFNESS_N_M2 / high, law.gamma * STIFFNESS_N_M2 / low),
            "lambda": (law.lambda_, law.lambda_),
            "density_over_stiffness": (
                over.min() / max(changed),
                over.max() / min(changed) * (1 + heavier + softer),
            ),
            "bending_stiffness_n_m2": (
                low * min(gains) * (1 - softer),
                high * max(gains) * (1 + softer),
            ),
            "tool_inertia_kg_m2": (channel.tool_inertia_kg_m2,) * 2,
        }
        if self.alpha_range is not None:
            found["alpha"] = self.alpha_range
        elif law.alpha is not None and law.zeta is not None:
            found |= {"alpha": (law.alpha, law.alpha), "zeta": (law.zeta, law.zeta)}
        if not channel.resonance_hz:
            found["delay_s"] = (channel.delay_s, channel.delay_s)
        found["tip_mass_kg"] = (self._tip_mass_kg,) * 2
        found["drag_m"] = (DRAG_COEFFICIENT * self.drag_m,) * 2
        if self.beam.root_nm_per_rad is not None:
            springs = self.beam.root_nm_per_rad(2j * np.pi * np.array([FIRST_HZ, LAST_HZ])).real
            found["root_nm_per_rad"] = (springs.min(), springs.max())
        return {name: (float(least), float(most)) for name, (least, most) in found.items()}

    @property
    def _tip_mass_kg(self) -> float:
        masses = self.beam.masses
        return sum((mass.mass_kg for mass in masses if mass.position_m == LENGTH_M), start=0.0)

    @property
    def parameters(self) -> dict[str, float]:
        """Return the properties that have a single true value."""
        return {name: low for name, (low, high) in self.ranges().items() if low == high}


@dataclass(frozen=True, slots=True)
class DefectRecord:
    """A record of a rig with a defect, at `RATE_HZ`, with its true properties."""

    seed: int
    defect: Defect
    amplitude_rad: float
    damping_level: float
    noise: NoiseSpectrum
    reference_rad: Real
    angle_rad: Real
    torque_nm: Real
    modes: tuple[TrueMode, ...]

    def truth(self) -> dict[str, object]:
        """Return the true properties as a JSON document."""
        law = self.defect.damping
        return {
            "seed": self.seed,
            "kind": self.defect.kind,
            "size": dict(self.defect.size),
            "linear_constant": self.defect.linear_constant,
            "amplitude_rad": self.amplitude_rad,
            "damping_level": self.damping_level,
            "noise": {
                "white_nm": self.noise.white_nm,
                "corner_hz": self.noise.corner_hz,
                "bumps": [list(bump) for bump in self.noise.bumps],
            },
            "modes": [mode.document() for mode in self.modes],
            "parameters": self.defect.parameters,
            "ranges": {name: list(pair) for name, pair in self.defect.ranges().items()},
            "effects": list(self.defect.effects),
            "law": {
                "zeta": law.zeta,
                "alpha": law.alpha,
                "gamma": law.gamma,
                "lambda": law.lambda_,
                "relaxations": [list(pair) for pair in law.relaxations],
                "clamp": self.defect.clamp and list(self.defect.clamp),
            },
        }

    def save(self, path: str) -> None:
        """Write the record as a compressed .npz file."""
        np.savez_compressed(
            path,
            angle_rad=self.angle_rad,
            reference_rad=self.reference_rad,
            torque_nm=self.torque_nm.astype(np.float32),
            rate_hz=RATE_HZ,
            truth=json.dumps(self.truth()),
        )


@dataclass(frozen=True, slots=True)
class _ShaftMotion:
    """Motion of a shaft on the shifted line."""

    s: Complex
    sigma: float
    count: int
    angle: Complex

    def at_record(self, spectrum: Complex) -> Real:
        """Return the signal of a spectrum at `RATE_HZ`."""
        points = 2 * (spectrum.size - 1)
        signal = np.fft.irfft(spectrum, points)[: self.count : _FINER]
        t = np.arange(signal.size) / RATE_HZ
        found: Real = signal * np.exp(self.sigma * t)
        return found

    def smooth_at_record(self, spectrum: Complex) -> Real:
        """Return the signal at `RATE_HZ` of a spectrum without content above half of that."""
        points = 2 * (spectrum.size - 1) // _FINER
        signal = np.fft.irfft(spectrum[: points // 2 + 1], points) / _FINER
        found: Real = signal[: self.count // _FINER]
        found *= np.exp(self.sigma * np.arange(found.size) / RATE_HZ)
        return found

    def at_instant(self, spectrum: Complex, time_s: float) -> float:
        """Return the value of a spectrum's signal at one time."""
        points = 2 * (spectrum.size - 1)
        total = 2 * np.sum((spectrum * np.exp(self.s * time_s)).real) / points
        ends = (spectrum[[0, -1]] * np.exp(self.s[[0, -1]] * time_s)).real.sum() / points
        return float(total - ends)

    def spectrum(self, signal: Real) -> Complex:
        """Return the spectrum of a signal on the fine grid."""
        rate_hz = _FINER * RATE_HZ
        decay = np.exp(-self.sigma * np.arange(signal.size) / rate_hz)
        found: Complex = np.fft.rfft(signal * decay, 2 * (self.s.size - 1))
        return found

    def at_grid(self, spectrum: Complex) -> Real:
        """Return the signal of a spectrum on the fine grid."""
        points = 2 * (spectrum.size - 1)
        signal = np.fft.irfft(spectrum, points)[: self.count]
        found: Real = signal * np.exp(self.sigma * np.arange(self.count) / (_FINER * RATE_HZ))
        return found


def _reference(amplitude_rad: float, seconds: float) -> Real:
    """Return the reference on the fine grid."""
    rate_hz = _FINER * RATE_HZ
    t = np.arange(round(seconds * rate_hz)) / rate_hz - REST_S
    slope = (LAST_HZ - FIRST_HZ) / (2 * SWEEP_S)
    chirp = amplitude_rad * np.sin(2 * np.pi * (FIRST_HZ + slope * t) * t)
    return np.where((t >= 0) & (t < SWEEP_S), chirp, 0.0)


def _motion(reference_rad: Real) -> _ShaftMotion:
    rate_hz, count = _FINER * RATE_HZ, reference_rad.size
    points = 2 * _FINER * next_fast_len(count // _FINER)
    sigma = _DECAY * rate_hz / points
    s = sigma + 2j * np.pi * np.fft.rfftfreq(points, 1 / rate_hz)
    decay = np.exp(-sigma * np.arange(count) / rate_hz)
    angle = np.fft.rfft(reference_rad * decay, points)
    angle /= 1 + 1.4 * s / _LOOP_RAD_S + (s / _LOOP_RAD_S) ** 2
    return _ShaftMotion(s, float(sigma), count, angle)


def simulate(
    seed: int,
    defect: Defect,
    amplitude_rad: float,
    damping_level: float,
    noise: NoiseSpectrum,
    seconds: float = RECORD_S,
) -> DefectRecord:
    """Return the record of a rig, with the true constants of its modes.

    Parameters
    ----------
    seed : int
        Seed of the noise.
    defect : Defect
    amplitude_rad : float
        Amplitude of the reference.
    damping_level : float
        Factor by which the damping was drawn.
    noise : NoiseSpectrum
    seconds : float
        Length of the record; a shorter one ends within the sweep.
    """
    generator = np.random.Generator(np.random.SFC64(seed))
    reference = _reference(amplitude_rad, seconds)
    motion, channel = _motion(reference), defect.channel
    s, root = motion.s, motion.angle
    if channel.play_rad:
        root = motion.spectrum(_with_play(motion.at_grid(motion.angle), channel.play_rad))
    modes = defect.beam.modes()
    beam = defect.beam.fast_response(s, modes) + channel.tool_inertia_kg_m2 * s**2
    passed = channel.response(s)
    torque = motion.at_record(root * beam * passed)
    if defect.step is not None:
        torque = _with_step(defect, motion, torque)
    if defect.drag_m:
        torque = torque + _drag_torque(defect, motion)
    if channel.friction_nm:
        speed = motion.at_record(root * s)
        torque = torque + channel.friction_nm * np.tanh(speed / channel.friction_speed_rad_s)
    if channel.cubic:
        torque = torque * (1 + channel.cubic * (torque / np.abs(torque).max()) ** 2)
    angle = motion.at_record(motion.angle)
    noisy = torque + defect.constant_nm + noise.drawn(torque.size, generator)
    return DefectRecord(
        seed,
        defect,
        amplitude_rad,
        damping_level,
        noise,
        reference[::_FINER],
        np.round(angle / _ENCODER_RAD) * _ENCODER_RAD,
        np.round(noisy / _SENSOR_NM) * _SENSOR_NM,
        _true_modes(defect, modes, motion, noise),
    )


def _true_modes(
    defect: Defect, modes: list[LockedHubMode], motion: _ShaftMotion, noise: NoiseSpectrum
) -> tuple[TrueMode, ...]:
    """Return the constants of the modes near the sweep, and whether each is visible."""
    later: dict[int, LockedHubMode] = {}
    if defect.step is not None:
        later = {mode.number: mode for mode in _stiffer(defect).modes()}
    found = []
    for mode in modes:
        if mode.frequency_hz > 2 * LAST_HZ:
            continue
        channel = complex(defect.channel.response(np.array([mode.pole_rad_s]))[0])
        part = motion.smooth_at_record(
            motion.angle * resonance(mode, motion.s) * defect.channel.response(motion.s)
        )
        peak = float(np.abs(part).max())
        swept = _VISIBLE_HZ[0] <= mode.frequency_hz <= _VISIBLE_HZ[1]
        exact = not defect.drag_m
        after = later.get(mode.number)
        found.append(
            TrueMode(
                mode.number,
                mode.frequency_hz if exact else None,
                mode.damping_ratio if exact else None,
                mode.residue * channel,
                peak,
                bool(swept and peak > VISIBLE_PEAK * noise.white_nm),
                None if after is None else after.frequency_hz,
                None if after is None else after.damping_ratio,
            )
        )
    return tuple(found)


def _with_play(angle_rad: Real, width_rad: float) -> Real:
    """Return the angle of a root that follows the shaft only once a gap is closed."""
    follows, here = np.empty(angle_rad.size), 0.0
    for i, angle in enumerate(angle_rad.tolist()):
        here = min(max(here, angle - width_rad / 2), angle + width_rad / 2)
        follows[i] = here
    return follows


def _stiffer(defect: Defect) -> FiniteElementBeam:
    """Return the beam after the step in time."""
    assert defect.step is not None
    factor, beam = 1 + defect.step[1], defect.beam
    return FiniteElementBeam(
        beam.length_m,
        beam.density_kg_per_m,
        lambda x: factor * beam.stiffness_n_m2(x),
        beam.elastic,
        beam.medium_n_s_per_m2,
    )


def _with_step(defect: Defect, motion: _ShaftMotion, before_nm: Real) -> Real:
    """Return the torque with a change of stiffness; deflection and speed of modes are conserved.

    The damping orders are 1, so that these are the complete state. A mode of the uniform beam obeys
    ``q'' + (c/rho) q' + g w² (q + zeta q') = -m (theta'' + (c/rho) theta')``, and the hub feels
    ``-m g w² (q + zeta q')``; g is 1 before and ``1 + change`` after the step.
    """
    assert defect.step is not None
    (at_s, change), beam, law = defect.step, defect.beam, defect.damping
    assert law.zeta is not None
    assert law.alpha == law.lambda_ == 1
    after = _stiffer(defect)
    torque = motion.at_record(motion.angle * after.fast_response(motion.s, after.modes()))
    s, first = motion.s, round(at_s * RATE_HZ)
    at_s = first / RATE_HZ
    t = np.arange(torque.size - first) / RATE_HZ
    frequencies, participations = beam.participations()
    per_mass = law.gamma * STIFFNESS_N_M2 / DENSITY_KG_PER_M
    for omega, participation in zip(frequencies[:_MARCHED_MODES], participations, strict=False):
        loads = -participation * motion.angle * (s**2 + per_mass * s)
        state = []
        for factor in (1.0, 1 + change):
            stiffness = factor * omega**2 * (1 + law.zeta * s)
            deflection = loads / (s**2 + per_mass * s + stiffness)
            state.append([motion.at_instant(deflection * s**k, at_s) for k in (0, 1)])
        deflection, speed = np.array(state[0]) - np.array(state[1])
        square = (1 + change) * omega**2
        damping = (per_mass + square * law.zeta) / 2
        turning = np.sqrt(complex(square - damping**2))
        pole = -damping + 1j * turning
        constant = (speed - pole.conjugate() * deflection) / (2j * turning)
        free = 2 * (constant * (1 + law.zeta * pole) * np.exp(pole * t)).real
        torque[first:] -= participation * square * free
    return np.concatenate([before_nm[:first], torque[first:]])


def _drag_torque(defect: Defect, motion: _ShaftMotion) -> Real:
    """Return the torque added by the drag of air on a wire, ``rho C_D d v |v| / 2`` per length.

    The damping orders are 1. The change of the modes' motion is integrated at `RATE_HZ`, each mode
    exactly for a force that is constant over a period; the force in the middle of a period is
    extrapolated from the two ticks before.
    """
    beam, law = defect.beam, defect.damping
    assert law.zeta is not None
    assert law.alpha == law.lambda_ == 1
    per_speed = 0.5 * _AIR_KG_M3 * DRAG_COEFFICIENT * defect.drag_m
    frequencies, participations = (each[:_MARCHED_MODES] for each in beam.participations())
    nodes, weights = np.polynomial.legendre.leggauss(_DRAG_POINTS)
    position, width = 0.5 * LENGTH_M * (nodes + 1), 0.5 * LENGTH_M * weights
    shapes = beam.shapes_at(position)[:_MARCHED_MODES]
    s, per_mass = motion.s, law.gamma * STIFFNESS_N_M2 / DENSITY_KG_PER_M
    stiffness, damping = frequencies**2, per_mass + law.zeta * frequencies**2
    linear = np.multiply.outer(motion.smooth_at_record(motion.angle * s), position)
    for i, participation in enumerate(participations):
        deflection = -participation * (s**2 + per_mass * s) / (s**2 + damping[i] * s + stiffness[i])
        speed = motion.smooth_at_record(motion.angle * deflection * s)
        linear += np.multiply.outer(speed, shapes[i])
    modes = frequencies.size
    generator = np.zeros((3 * modes, 3 * modes))
    index = np.arange(modes)
    generator[index, modes + index] = 1.0
    generator[modes + index, index] = -stiffness
    generator[modes + index, modes + index] = -damping
    generator[modes + index, 2 * modes + index] = 1.0
    over_period = expm(generator / RATE_HZ)
    free = over_period[: 2 * modes, : 2 * modes]
    pushed = over_period[: 2 * modes, 2 * modes :] @ -(shapes * width)
    states, forces = np.zeros((len(linear), 2 * modes)), np.zeros_like(linear)
    state, before = np.zeros(2 * modes), np.zeros(position.size)
    for i, speed in enumerate(linear):
        states[i] = state
        total = speed + state[modes:] @ shapes
        forces[i] = force = per_speed * np.abs(total) * total
        state = free @ state + pushed @ (1.5 * force - 0.5 * before)
        before = force
    # Moment about the hub by the inertia of the modes, by the medium, and by the drag itself.
    deflections, speeds = states[:, :modes], states[:, modes:]
    accelerations = -stiffness * deflections - damping * speeds - forces @ (shapes * width).T
    added: Real = (accelerations + per_mass * speeds) @ participations + forces @ (position * width)
    return added
