"""Records of rigs that violate the assumptions of the analyzer, made by independent code.

A chirp of 0.025 rad, 0.05-50 Hz in 120 s, 1 s of rest before and 15 s after, at 1 kHz behind a
motor loop of 20 Hz; white noise of 5 mN·m. Linear rigs are computed by the closed form of the beam
with its actual ends, written with hyperbolic functions, on a grid four times as fine as that of a
record. Nonlinear and time-varying effects are computed by Runge and Kutta's method on the equations
of motion of the modes, as a difference added to the closed form.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from analysis.identify import Measurement
from rigd.beam import Beam

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

RATE_HZ = 1000.0
TICKS = 136_000
LENGTH_M, DENSITY, STIFFNESS = 0.98, 4.7e-3, 0.090275
NOISE_NM = 5e-3
_AMPLITUDE_RAD = 0.025
_AIR_KG_M3, _AIR_M2_S = 1.2, 1.5e-5
"""Density and kinematic viscosity."""
_ROOTS = np.array([1.8751040687119611, 4.694091132974175, 7.854757438237613, 10.995540734875467])
"""Roots of 1 + cos z cosh z."""


@dataclass(frozen=True, slots=True)
class Rig:
    """Simulated rig: damping, ends of the beam, and channel of the torque."""

    zeta: float
    alpha: float
    gamma: float
    lambda_: float
    root_nm_per_rad: float = np.inf
    tip_mass_kg: float = 0.0
    first_order_hz: float = np.inf
    second_order_hz: float = np.inf
    clock: float = 0.0

    def response(self, s: Complex) -> Complex:
        """Return the torque over the angle, without the channel."""
        external = DENSITY / STIFFNESS * s**2 + self.gamma * s**self.lambda_
        elastic = STIFFNESS * (1 + self.zeta * s**self.alpha)
        k = (-STIFFNESS * external / elastic + 0j) ** 0.25
        z, tip = k * LENGTH_M, self.tip_mass_kg * s**2 / (elastic * k**3)
        sine, cosine, sinh, cosh = np.sin(z), np.cos(z), np.sinh(z), np.cosh(z)
        pinned = cosine * sinh - sine * cosh
        rigid = elastic * k * (pinned + 2 * tip * sinh * sine)
        rigid = rigid / (1 + cosine * cosh - tip * pinned)
        found: Complex = rigid / (1 + rigid / self.root_nm_per_rad)
        return found

    def channel(self, s: Complex) -> Complex:
        """Return the response of the filters of the sensor."""
        first, second = (s / (2 * np.pi * hz) for hz in (self.first_order_hz, self.second_order_hz))
        found: Complex = 1 / ((1 + first) * (1 + 2**0.5 * second + second**2))
        return found

    def poles(self) -> Complex:
        """Return the poles of the first three modes, by the secant method."""
        found = []
        for root in _ROOTS[:3]:
            omega = (root / LENGTH_M) ** 2 * np.sqrt(STIFFNESS / DENSITY)
            grid = omega * np.linspace(0.75, 1.05, 6001)
            start = 1j * grid[np.argmax(np.abs(self.response(1j * grid)))]
            before, here = start, start * (1 + 1e-4j)
            at_before, at_here = (1 / self.response(np.array([p]))[0] for p in (before, here))
            for _ in range(60):
                if at_here == at_before:
                    break
                step = at_here * (here - before) / (at_here - at_before)
                before, at_before, here = here, at_here, here - step
                at_here = 1 / self.response(np.array([here]))[0]
                if abs(step) < 1e-13 * abs(here):
                    break
            found.append(here)
        return np.array(found)

    @property
    def damping_ratios(self) -> Real:
        """Damping ratios of the first three modes."""
        poles = self.poles()
        return -poles.real / np.abs(poles)

    @property
    def parameters(self) -> dict[str, float]:
        """True values by the names of the analyzer."""
        return {
            "zeta": self.zeta,
            "alpha": self.alpha,
            "gamma": self.gamma,
            "lambda": self.lambda_,
        }


RIGS = MappingProxyType(
    {
        "alpha .92": Rig(1.24e-4, 0.92, 5.5e-2, 0.55),
        "alpha 1": Rig(7.1e-5, 1.0, 5.5e-2, 0.7),
        "III": Rig(7.1e-5, 1.0, 1.2e-2, 1.0),
    }
)


@dataclass(frozen=True, slots=True)
class Record:
    """Angle and torque of one record, and the true rig."""

    rig: Rig
    angle_rad: Real
    torque_nm: Real
    known: NDArray[np.bool_] | None = None
    frequencies_change: bool = False
    """Whether the frequency of a mode is the one when the sweep passes it."""

    def measurement(self) -> Measurement:
        """Return the input of the analyzer, with ideal channels and the true beam."""
        known = np.ones(self.angle_rad.size, dtype=bool) if self.known is None else self.known
        return Measurement(
            "record", self.angle_rad, self.torque_nm, RATE_HZ,
            Beam(LENGTH_M, DENSITY, STIFFNESS), known, known,
        )  # fmt: skip


def _time_s() -> Real:
    return np.arange(TICKS) / RATE_HZ


def _chirp() -> Real:
    t = _time_s() - 1
    chirp = _AMPLITUDE_RAD * np.sin(2 * np.pi * (0.05 * t + (50 - 0.05) * t**2 / 240))
    return np.where((t >= 0) & (t < 120), chirp, 0.0)


@dataclass(frozen=True, slots=True)
class _Motion:
    """Angle of the shaft, and its spectrum on the shifted line."""

    s: Complex
    spectrum: Complex
    decay: Real

    def at(self, spectrum: Complex, factor: int = 1) -> Real:
        """Return the signal of a spectrum, at a multiple of the rate."""
        n = TICKS * factor
        grown: Real = np.fft.irfft(spectrum * factor, 4 * n)[:n] * np.exp(5.0 * np.arange(n) / n)
        return grown


@cache
def _motion() -> _Motion:
    decay = np.exp(-5.0 * np.arange(TICKS) / TICKS)
    s = 5.0 * RATE_HZ / TICKS + 2j * np.pi * np.fft.rfftfreq(4 * TICKS, 1 / RATE_HZ)
    loop = 2 * np.pi * 20
    spectrum = np.fft.rfft(_chirp() * decay, 4 * TICKS) / (1 + 1.4 * s / loop + (s / loop) ** 2)
    return _Motion(s, spectrum, decay)


@cache
def _exact(rig: Rig) -> tuple[Real, Real]:
    """Return angle and torque without noise."""
    motion = _motion()
    torque = motion.spectrum * rig.response(motion.s) * rig.channel(motion.s)
    if rig.clock == 0:
        return motion.at(motion.spectrum), motion.at(torque)
    # Sampled at t (1 + clock): cubic interpolation between samples eight times as close.
    fine = motion.at(torque, 8)
    position = _time_s() * (1 + rig.clock) * 8 * RATE_HZ
    first = np.clip(position.astype(int), 1, fine.size - 3)
    x = position - first
    weights = (
        -x * (x - 1) * (x - 2) / 6,
        (x + 1) * (x - 1) * (x - 2) / 2,
        -(x + 1) * x * (x - 2) / 2,
        (x + 1) * x * (x - 1) / 6,
    )
    seen = sum(w * fine[first + k] for k, w in enumerate(weights, start=-1))
    return motion.at(motion.spectrum), np.asarray(seen)


def record(rig: Rig, seed: int, **more: float) -> Record:
    """Make a record of a linear rig."""
    rig = replace(rig, **more)
    angle_rad, torque_nm = _exact(rig)
    noise = np.random.default_rng(seed).normal(scale=NOISE_NM, size=TICKS)
    return Record(rig, angle_rad, torque_nm + noise)


Force = Callable[[int, float, float, float, float], float]
"""Force by tick, deflection relative to the hub, its speed, absolute speed, and k."""


@cache
def _hub() -> tuple[list[float], list[float]]:
    """Return the angle and its speed, two values per tick."""
    motion = _motion()
    angle, speed = (motion.at(motion.spectrum * motion.s**k, 2) for k in (0, 1))
    return angle.tolist(), speed.tolist()


def _mode(rig: Rig, mode: int, force: Force | None) -> tuple[Real, float]:
    """Return the torque of one mode with integer orders, shape (n,), and its largest deflection.

    ``rho/EI y'' + gamma y' + k (r + zeta r') + force = 0``, with the absolute deflection y per
    eigenfunction and the deflection r relative to the turning hub.
    """
    k = float(_ROOTS[mode - 1] / LENGTH_M) ** 4
    ratio, gamma, zeta = DENSITY / STIFFNESS, rig.gamma, rig.zeta
    hub, turning = _hub()
    step = 1 / RATE_HZ
    out, y, v, largest = np.zeros(TICKS), 0.0, 0.0, 0.0

    def pull(j: int, y: float, v: float) -> float:
        r, w = y - hub[j], v - turning[j]
        elastic = k * (r + zeta * w)
        return elastic if force is None else elastic + force(j // 2, r, w, v, k)

    for i in range(TICKS - 1):
        j = 2 * i
        out[i] = f = pull(j, y, v)
        largest = max(largest, abs(y - hub[j]))
        d1 = -(gamma * v + f) / ratio
        v2 = v + step / 2 * d1
        d2 = -(gamma * v2 + pull(j + 1, y + step / 2 * v, v2)) / ratio
        v3 = v + step / 2 * d2
        d3 = -(gamma * v3 + pull(j + 1, y + step / 2 * v2, v3)) / ratio
        v4 = v + step * d3
        d4 = -(gamma * v4 + pull(j + 2, y + step * v3, v4)) / ratio
        y += step / 6 * (v + 2 * v2 + 2 * v3 + v4)
        v += step / 6 * (d1 + 2 * d2 + 2 * d3 + d4)
    out[-1] = out[-2]
    scale = 4 * LENGTH_M**3 / _ROOTS[mode - 1] ** 4 * STIFFNESS
    return -scale * out, largest


@cache
def _linear_mode(rig: Rig, mode: int) -> tuple[Real, float]:
    return _mode(rig, mode, None)


def _with_forces(made: Record, forces: dict[int, Force]) -> Record:
    """Add the effect of forces on the modes."""
    changes = [
        _mode(made.rig, mode, force)[0] - _linear_mode(made.rig, mode)[0]
        for mode, force in forces.items()
    ]
    return replace(made, torque_nm=made.torque_nm + np.sum(changes, axis=0))


def damping_changes(fraction: float, rig: Rig, seed: int) -> Record:
    """Change all damping linearly in time, from 1 - fraction to 1 + fraction of its mean."""
    ramp = (fraction * (2 * np.arange(TICKS) / TICKS - 1)).tolist()

    def force(i: int, _r: float, w: float, v: float, k: float) -> float:
        return ramp[i] * (k * rig.zeta * w + rig.gamma * v)

    return _with_forces(record(rig, seed), {1: force, 2: force, 3: force})


def stiffness_changes(fraction: float, rig: Rig, seed: int) -> Record:
    """Change the bending stiffness linearly in time, from 1 - fraction to 1 + fraction."""
    ramp = (fraction * (2 * np.arange(TICKS) / TICKS - 1)).tolist()

    def force(i: int, r: float, w: float, _v: float, k: float) -> float:
        return ramp[i] * k * (r + rig.zeta * w)

    changing = _with_forces(record(rig, seed), {1: force, 2: force, 3: force})
    return replace(changing, frequencies_change=True)


def stiffens(fractions: dict[int, float], power: int, rig: Rig, seed: int) -> Record:
    """Let the stiffness of modes rise by a fraction up to their largest deflection."""

    def rising(mode: int, fraction: float) -> Force:
        size = fraction / _linear_mode(rig, mode)[1] ** power
        return lambda _i, r, _w, _v, k: k * size * abs(r) ** power * r

    return _with_forces(record(rig, seed), {m: rising(m, x) for m, x in fractions.items()})


@dataclass(frozen=True, slots=True)
class Drag:
    """A wire in still air, and the amplitude of its hub.

    Drag is ``rho_air C_D d v abs(v) / 2`` per length. C_D is 1.2, or White's for a cylinder,
    ``1 + 10 Re^(-2/3)``.
    """

    rig: Rig
    diameter_m: float
    amplitude_rad: float = _AMPLITUDE_RAD
    cylinder: bool = False

    def laws(self) -> tuple[float, float]:
        """Return the constant part of C_D d, and the coefficient of speed^(-2/3)."""
        if not self.cylinder:
            return 1.2 * self.diameter_m, 0.0
        return self.diameter_m, 10 * self.diameter_m ** (1 / 3) * _AIR_M2_S ** (2 / 3)

    def true_m(self, speed_m_s: float) -> float:
        """Return C_D d at a speed."""
        constant, slowing = self.laws()
        return float(constant + slowing * speed_m_s ** (-2 / 3))


def air_drag(diameter_m: float, rig: Rig, seed: int) -> Record:
    """Add the drag of a wire, ``rho_air C_D d v abs(v) / 2`` per length, C_D = 1.2."""
    return drags([Drag(rig, diameter_m)], [seed])[0]


def drags(wires: list[Drag], seeds: list[int], noise_nm: float = NOISE_NM) -> list[Record]:
    """Make records of wires in air, integrated together: six modes, forces at 24 points."""
    count = len(wires)
    torque_nm = _braked([*wires, *(replace(wire, diameter_m=0.0) for wire in wires)])
    made = []
    for wire, seed, change in zip(wires, seeds, torque_nm[:count] - torque_nm[count:], strict=True):
        angle_rad, linear_nm = (
            signal * (wire.amplitude_rad / _AMPLITUDE_RAD) for signal in _exact(wire.rig)
        )
        noise = np.random.default_rng(seed).normal(scale=noise_nm, size=TICKS)
        made.append(Record(wire.rig, angle_rad, linear_nm + change + noise))
    return made


def _braked(wires: list[Drag]) -> Real:
    """Return the torque of beams of integer orders in air, shape (wires, n)."""
    roots = np.concatenate([_ROOTS, (2 * np.arange(5, 7) - 1) * np.pi / 2])
    node, weight = np.polynomial.legendre.leggauss(24)
    xi, weight = 0.5 * (node + 1), 0.5 * weight
    shapes = np.array([_shape(z, xi) for z in roots])
    # In units of an eigenfunction's expansion of the rigid turn x.
    participations = 2 / roots**2 * LENGTH_M
    k = (roots / LENGTH_M) ** 4
    ratio, step = DENSITY / STIFFNESS, 1 / RATE_HZ
    field, back = (
        shapes * participations[:, None],
        weight[:, None] * (shapes / participations[:, None]).T,
    )
    # Static response of the higher modes to a force.
    arm = STIFFNESS * LENGTH_M * weight * (LENGTH_M * xi - participations @ shapes)
    zeta, gamma = (
        np.array([getattr(wire.rig, name) for wire in wires])[:, None] for name in ("zeta", "gamma")
    )
    per_speed, slowing = np.array([wire.laws() for wire in wires]).T[:, :, None] * (
        0.5 * _AIR_KG_M3 / STIFFNESS
    )
    slow = bool(slowing.any())
    size = np.array([wire.amplitude_rad for wire in wires])[:, None] / _AMPLITUDE_RAD
    hub, turning = (np.array(x) for x in _hub())
    out, rest = np.zeros((TICKS, len(wires), len(roots))), np.zeros((TICKS, len(wires)))
    y, v = np.zeros((2, len(wires), len(roots)))

    def pull(j: int, y: Real, v: Real) -> tuple[Real, Real, Real]:
        elastic = k * (y - hub[j] * size + zeta * (v - turning[j] * size))
        speed = v @ field
        magnitude = np.abs(speed)
        factor = per_speed * magnitude
        if slow:
            factor += slowing * np.cbrt(magnitude)
        drag = factor * speed
        return elastic, elastic + gamma * v + drag @ back, drag

    for i in range(TICKS - 1):
        j = 2 * i
        out[i], f, drag = pull(j, y, v)
        rest[i] = drag @ arm
        v2 = v - step / 2 * f / ratio
        d2 = pull(j + 1, y + step / 2 * v, v2)[1]
        v3 = v - step / 2 * d2 / ratio
        d3 = pull(j + 1, y + step / 2 * v2, v3)[1]
        v4 = v - step * d3 / ratio
        d4 = pull(j + 2, y + step * v3, v4)[1]
        y = y + step / 6 * (v + 2 * v2 + 2 * v3 + v4)
        v = v - step / 6 * (f + 2 * d2 + 2 * d3 + d4) / ratio
    torque: Real = rest.T - (out @ (4 * LENGTH_M**3 / roots**4 * STIFFNESS)).T
    return torque


def _shape(z: float, xi: Real) -> Real:
    """Return the clamped-free eigenfunction of mean square 1."""
    ratio = (np.cos(z) + np.cosh(z)) / (np.sin(z) + np.sinh(z))
    x = z * xi
    shape: Real = np.cosh(x) - np.cos(x) - ratio * (np.sinh(x) - np.sin(x))
    return shape


def play(width_rad: float, rig: Rig, seed: int) -> Record:
    """Let the hub follow the encoder's shaft only once a gap is closed."""
    made, here = record(rig, seed), 0.0
    follows = np.empty(TICKS)
    for i, angle in enumerate(made.angle_rad.tolist()):
        here = min(max(here, angle - width_rad / 2), angle + width_rad / 2)
        follows[i] = here
    motion = _motion()
    lag = np.fft.rfft((follows - made.angle_rad) * motion.decay, 4 * TICKS)
    more = motion.at(lag * rig.response(motion.s) * rig.channel(motion.s))
    return replace(made, torque_nm=made.torque_nm + more)


def drifts(kind: str, rig: Rig, seed: int) -> Record:
    """Let the zero of the sensor drift by 50 mN·m."""
    made, t = record(rig, seed), np.arange(TICKS) / TICKS
    walk = np.cumsum(np.random.default_rng(seed + 1000).normal(size=TICKS)) / TICKS**0.5
    return replace(
        made, torque_nm=made.torque_nm + 0.05 * ((2 * t - 1) ** 2 if kind == "parabola" else walk)
    )


def scaled(torque: float, rig: Rig, seed: int) -> Record:
    """Multiply the torque."""
    made = record(rig, seed)
    return replace(made, torque_nm=torque * made.torque_nm)


def hums(frequency_hz: float, size_nm: float, rig: Rig, seed: int) -> Record:
    """Add a narrow-band disturbance whose frequency varies by 0.02 Hz."""
    made, rng = record(rig, seed), np.random.default_rng(seed + 2000)
    slow = np.interp(np.arange(TICKS), np.arange(0, TICKS + 4000, 4000), rng.normal(size=35))
    phase = 2 * np.pi * np.cumsum(frequency_hz + 0.02 * slow) / RATE_HZ
    return replace(made, torque_nm=made.torque_nm + size_nm * np.sin(phase))


def clipped(fraction: float, rig: Rig, seed: int) -> Record:
    """Clip the torque at a fraction of its peak, without flags."""
    made = record(rig, seed)
    most = fraction * np.abs(made.torque_nm).max()
    return replace(made, torque_nm=np.clip(made.torque_nm, -most, most))


def missing(fraction: float, rig: Rig, seed: int) -> Record:
    """Remove the torque of a fraction of the ticks."""
    made = record(rig, seed)
    known = np.random.default_rng(seed + 3000).random(TICKS) > fraction
    known[[0, -1]] = True
    return replace(made, known=known)


def repeated(fraction: float, rig: Rig, seed: int) -> Record:
    """Repeat the torque of the previous tick in a fraction of the ticks, without flags."""
    made = record(rig, seed)
    stale = np.random.default_rng(seed + 3000).random(TICKS) < fraction
    fresh = np.maximum.accumulate(np.where(stale, 0, np.arange(TICKS)))
    return replace(made, torque_nm=made.torque_nm[fresh])


def disturbed(kind: str, rig: Rig, seed: int) -> Record:
    """Add a burst of 20 ms, an impact that makes mode 1 ring, or spikes."""
    made, rng = record(rig, seed), np.random.default_rng(seed + 4000)
    torque = made.torque_nm.copy()
    if kind == "burst":
        torque[60_000:60_020] += 5.0
    elif kind == "kick":
        torque[60_000:] += 0.2 * np.imag(np.exp(rig.poles()[0] * _time_s()[: TICKS - 60_000]))
    else:
        torque[rng.random(TICKS) < 1e-3] += 1.0
    return replace(made, torque_nm=torque)


def second_beam(fraction: float, rig: Rig, seed: int) -> Record:
    """Add a lighter beam of 0.8 of the length on the same hub."""
    made, motion = record(rig, seed), _motion()
    # A shorter beam responds as this one at frequencies lower by the square of the length.
    shorter = rig.response(motion.s * 0.64) * fraction
    return replace(made, torque_nm=made.torque_nm + motion.at(motion.spectrum * shorter))


def rings(mode: int, size_nm: float, rig: Rig, seed: int) -> Record:
    """Let a mode ring when the record begins."""
    made = record(rig, seed)
    decay = np.real(np.exp(rig.poles()[mode - 1] * _time_s()))
    return replace(made, torque_nm=made.torque_nm + size_nm * decay)


Make = Callable[[Rig, int], Record]
ALL = tuple(RIGS)
_III = ("III",)
_TWO = ("alpha .92", "III")


def _linear(**more: float) -> Make:
    return partial(record, **more)


_MODE_3_HZ = float((_ROOTS[2] / LENGTH_M) ** 2 * np.sqrt(STIFFNESS / DENSITY) / (2 * np.pi))

DEFECTS: dict[str, tuple[tuple[str, ...], Make]] = {
    "none": (ALL, record),
    **{
        f"elastic clamp {k:g} N·m/rad": (ALL, _linear(root_nm_per_rad=k))
        for k in (1000.0, 300.0, 100.0, 20.0)
    },
    **{f"tip mass {m:g} g": (_TWO, _linear(tip_mass_kg=1e-3 * m)) for m in (0.05, 0.5)},
    "low-pass 100 Hz, 1st order": (ALL, _linear(first_order_hz=100.0)),
    "low-pass 300 Hz, 1st order": (ALL, _linear(first_order_hz=300.0)),
    "low-pass 300 Hz, 2nd order": (_TWO, _linear(second_order_hz=300.0)),
    "low-pass 150 Hz, 2nd order": (_TWO, _linear(second_order_hz=150.0)),
    **{f"clocks {e} ppm": (ALL, _linear(clock=1e-6 * e)) for e in (1, 10, 100)},
    "damping ±10 % over the session": (_III, partial(damping_changes, 0.1)),
    "damping ±2 % over the session": (_III, partial(damping_changes, 0.02)),
    "stiffness ±0.25 % over the session": (_III, partial(stiffness_changes, 2.5e-3)),
    "stiffness ±0.05 % over the session": (_III, partial(stiffness_changes, 5e-4)),
    "air drag, wire of 0.2 mm": (_III, partial(air_drag, 2e-4)),
    "air drag, wire of 1 mm": (_III, partial(air_drag, 1e-3)),
    "cubic stiffness +1 % (mode 1)": (_III, partial(stiffens, {1: 0.01}, 2)),
    "cubic stiffness -3 % (mode 1)": (_III, partial(stiffens, {1: -0.03}, 2)),
    "cubic stiffness +0.3 % (three modes)": (
        _III,
        partial(stiffens, {1: 0.003, 2: 0.003, 3: 0.003}, 2),
    ),
    "stiffness with abs(q), 1 % (mode 1)": (_III, partial(stiffens, {1: 0.01}, 1)),
    "stiffness with abs(q), 1 % (all)": (
        _III,
        partial(stiffens, {1: 0.01, 2: 0.01, 3: 0.01}, 1),
    ),
    **{f"backlash {w:g} mrad": (ALL, partial(play, 1e-3 * w)) for w in (0.1, 0.5, 2.0)},
    "drift 50 mN·m, parabola": (_TWO, partial(drifts, "parabola")),
    "drift 50 mN·m, random walk": (_TWO, partial(drifts, "walk")),
    "gain +2 %": (_TWO, partial(scaled, 1.02)),
    "disturbance 50 Hz, 2 mN·m": (_TWO, partial(hums, 50.0, 2e-3)),
    "disturbance 50 Hz, 10 mN·m": (_TWO, partial(hums, 50.0, 1e-2)),
    "disturbance on mode 3, 5 mN·m": (_TWO, partial(hums, _MODE_3_HZ, 5e-3)),
    "clipped at 80 %": (_TWO, partial(clipped, 0.8)),
    "clipped at 50 %": (_TWO, partial(clipped, 0.5)),
    "missing ticks 1 %": (_TWO, partial(missing, 0.01)),
    "missing ticks 4.5 %": (_TWO, partial(missing, 0.045)),
    "torque repeated in 3 %": (_TWO, partial(repeated, 0.03)),
    "burst 20 ms, 5 N·m": (_TWO, partial(disturbed, "burst")),
    "kick 0.2 N·m": (_TWO, partial(disturbed, "kick")),
    "spikes 1 N·m in 0.1 %": (_TWO, partial(disturbed, "spikes")),
    "second beam 10 %": (ALL, partial(second_beam, 0.1)),
    "second beam 1 %": (ALL, partial(second_beam, 0.01)),
    "torque with the wrong sign": (ALL, partial(scaled, -1.0)),
    "torque 57.3 times too large": (ALL, partial(scaled, 180 / np.pi)),
    "mode 1 rings, 0.1 N·m": (ALL, partial(rings, 1, 0.1)),
    "mode 2 rings, 0.48 N·m": (ALL, partial(rings, 2, 0.48)),
}
"""Defects by name: their rigs, and the function that makes a record."""
