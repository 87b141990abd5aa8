"""Torque by air drag along the beam, and how it changes with beam and drag.

Mode i, relative to its root, feels of a force f per metre ``F_i = ∫ phi_i f dx / L``; with p, c and
k of `analysis.identify._predictor`, ``Z_i = p + c k_i⁴`` and ``b_i = ∫ x phi_i dx / L``::

    q_i = (F_i / EI - p b_i angle) / Z_i
    v(x) = x angle' + sum_i phi_i(x) q_i'
    f = -rho_air/2 (C |v| v + S |v|^(1/3) v)
    torque added = sum_i L b_i F_i p / Z_i - ∫ x f dx

The moment of the force is exact; the sum over the modes is the whole contribution of inertia. C is
C_D d of a constant coefficient. S is the part of it that falls with the speed as in White's law for
a cylinder, ``C_D = 1 + 10 Re^(-2/3)`` [1]_.

The speeds by the motor's motion are exact (by transforms over the whole record, as in
`TorquePredictor`). The effect of drag on them is computed in time steps, since drag halves a peak
and repeated substitution does not converge there. The two poles of each mode, with their residues,
are stepped; the force between the steps is the cubic through the last four of them. From the forces
so found the torque again follows by transforms, exactly.

This torque is not linear in the motion, so no response function gives it. In a fit it is computed
at one beam and drag and removed from the measured torque; its change with beam or drag is linear
(`DragExpansion`) in

* the poles of the modes, on which the motion near a resonance depends,
* the external damping ``gamma s^lambda`` at these poles, since it also drives the modes,
* the logarithm of the mass per length, which the force has to move,
* the delay between the channels,
* the drag itself.

The first four follow from a fit's unknowns, the last is free: its columns are projected out as
those of a free decay are. A fit with drag repeats both steps until they agree.

Without drag a peak grows as the damping falls, beyond all bounds; with it, it hardly grows. Where
the linear torque curves with a pole, the torque by drag curves against it. So of the linear torque
too only the first order in the poles counts: its remainder is taken away again.

References
----------
.. [1] F. M. White, Viscous Fluid Flow, McGraw-Hill.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._data import fast_length
from analysis.identify._plant import OF_BEAM
from analysis.identify._predictor import eigenvalues, torque_channel
from analysis.identify.free_decay import mode_poles
from rigd.beam import AIR_DENSITY_KG_PER_M3, DragGrid, poles_for_eigenvalues

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from analysis.identify._plant import Plant

    Real = NDArray[np.float64]
    Complex = NDArray[np.complex128]
    from collections.abc import Callable

    from analysis.identify.free_decay import Pole

MODES: Final = 5
POINTS: Final = 16
_OVERSAMPLING: Final = 3
"""The band ends at 0.4 of the rate: up to three times its end nothing folds back into it."""

_PADDED: Final = 1.1
_DECAY: Final = 6.6
"""As in `TorquePredictor`."""

_PAST: Final = 3
"""Forces before the present one that the polynomial passes."""

HALF_DENSITY: Final = 0.5 * AIR_DENSITY_KG_PER_M3
_LOWEST: Final = [0, 1]
"""Modes that external damping drives: it falls off against the inertia."""

_BEYOND_ALL: Final = 10.0
"""Speed over the highest without drag that no braked beam reaches."""

_CHUNK: Final = 4096
_QUADRATURE: Final = 12
_SLOWING: Final = 1 / 3
"""Power of the speed that is left where C_D falls as its power of -2/3."""


# Torque at one beam and drag


class DragError(ArithmeticError):
    """Drag is too large, or the beam too light, to be simulated from sample to sample."""


@dataclass(frozen=True, slots=True)
class DragLaw:
    """Law of the drag per metre and speed squared.

    Attributes
    ----------
    constant_m : float
        C_D d that does not depend on the speed.
    slowing : float
        S, in m (m/s)^(2/3): additional C_D d at 1 m/s.
    """

    constant_m: float
    slowing: float = 0.0

    def at(self, speed_m_s: float) -> float:
        """Return C_D d in m at a speed."""
        return float(self.constant_m + self.slowing * speed_m_s ** (_SLOWING - 1))


@dataclass(frozen=True, slots=True, eq=False)
class DragTorque:
    """Torque by drag at one point, and its derivatives, at the samples of the angle.

    Attributes
    ----------
    law : DragLaw
    torque_nm : ndarray, shape (m,)
    by_pole : dict of int to ndarray, shape (2, m)
        For each mode: derivatives by the real and the imaginary part of its upper pole.
    by_external : ndarray, shape (2, 2, m)
        For each of the two lowest modes, whose poles are held: by c_0 and c_1 of an external
        damping ``c_0 + c_1 s`` that drives it.
    by_law : ndarray, shape (2, m)
        By the two numbers of the law.
    by_delay : ndarray, shape (m,)
    speed_m_s : float
        Mean of the speed along beam and record, weighted with the power that the air takes.
    top_speed_m_s : float
        The highest.
    """

    law: DragLaw
    torque_nm: Real
    by_pole: dict[int, Real]
    by_external: Real
    by_law: Real
    by_delay: Real
    speed_m_s: float
    top_speed_m_s: float

    @property
    def by_ln_density(self) -> Real:
        """Return the derivative by the logarithm of the mass per length, poles and drag held."""
        numbers = np.array([self.law.constant_m, self.law.slowing])
        own: Real = self.torque_nm - numbers @ self.by_law
        return own


class DragResponse:
    """Torque by drag on one beam that follows one angle.

    Parameters
    ----------
    angle_rad : ndarray, shape (m,)
        From rest, band-limited: nothing left at half the rate.
    rate_hz : float
    plant : Plant
        The linear beam.

    Attributes
    ----------
    s : ndarray of complex, shape (bins,)
        Points of its transforms: a line parallel to the imaginary axis, in rad/s.
    """

    def __init__(self, angle_rad: Real, rate_hz: float, plant: Plant) -> None:
        n = angle_rad.size
        self.plant, self._samples, self._rate_hz = plant, n, rate_hz
        self._length = fast_length(int(np.ceil(_PADDED * n)))
        self._sigma = sigma = _DECAY * rate_hz / self._length
        bins = np.arange(self._length // 2 + 1)
        self.s = s = sigma + 2j * np.pi * rate_hz / self._length * bins
        fine = np.arange(_OVERSAMPLING * n) / (_OVERSAMPLING * rate_hz)
        self._growth = np.exp(sigma * fine)
        beam, damping = plant.beam, plant.damping
        self._grid = DragGrid.of(beam, MODES, POINTS)
        k = (eigenvalues(MODES) / beam.length_m) ** 4
        log_s = np.log(s)
        p = beam.density_over_stiffness * s * s + damping.gamma * np.exp(damping.lambda_ * log_s)
        z = p + k[:, None] * (1 + damping.zeta * np.exp(damping.alpha * log_s))
        self._follow = p / z  # (MODES, bins): what inertia makes of a force
        self._yield = s / z / beam.bending_stiffness_n_m2
        self._inertial = p
        self._late = torque_channel(plant, s)
        turned = np.fft.rfft(angle_rad / self._growth[::_OVERSAMPLING], self._length)
        self._driven = -self._grid.leverage_m[:, None] * (self._follow * s * turned)
        self._turning = s * turned
        self._pairs = _pole_pairs(k * beam.length_m**4, plant)

    def first_order(self) -> Real:
        """Return the torque by a small drag over C_D d, shape (m,)."""
        return self._torque(self._modal(_force(self._linear_speed(), DragLaw(1.0))))

    def torque(self, law: DragLaw, modes: Sequence[int] = ()) -> DragTorque:
        """Return the torque by drag, with its derivatives.

        Parameters
        ----------
        law : DragLaw
        modes : sequence of int
            Modes by whose poles the torque is differentiated.

        Raises
        ------
        DragError
            The speeds grow without end.
        """
        speed = self._linear_speed()
        highest = float(np.abs(speed).max())
        with np.errstate(over="ignore", invalid="ignore"):
            self._brake(speed, law)
            top = float(np.abs(speed).max())
        if not top <= _BEYOND_ALL * highest:
            raise DragError(f"drag of {law.constant_m:g} m cannot be followed.")
        forces = self._modal(_force(speed, law))
        modes = [mode for mode in modes if self._pairs[mode - 1][0].imag > 0]
        spectra = self._spectra(forces)
        moved = self._driven + self._yield * spectra[:-1]
        sources: list[tuple[int, Real]] = []
        direct = []
        carried = self._leverage[:, None] * self._follow * spectra[:-1]
        for mode in modes:
            pole = self._pairs[mode - 1][0]
            term, mirror = 1 / (self.s - pole), 1 / (self.s - pole.conjugate())
            for change in (term + mirror, 1j * (term - mirror)):
                sources.append((mode - 1, self._fine(moved[mode - 1] * change)))
                direct.append(self.in_time(carried[mode - 1] * change))
        for mode in _LOWEST:
            for change in (1 / self._inertial, self.s / self._inertial):
                sources.append((mode, self._fine(self._driven[mode] * change)))
                direct.append(self.in_time(carried[mode] * change))
        changed = self._perturbed(speed, law, sources)
        by = [self._torque(change) for change in changed]
        by[: len(direct)] = [row + more for row, more in zip(by, direct, strict=False)]
        of_external, of_law = by[2 * len(modes) : len(direct)], by[len(direct) :]
        torque = self._response(spectra)
        return DragTorque(
            law=law,
            torque_nm=self.in_time(torque),
            by_pole={mode: np.array(by[2 * i : 2 * i + 2]) for i, mode in enumerate(modes)},
            by_external=np.reshape(of_external, (len(_LOWEST), 2, self._samples)),
            by_law=np.array(of_law),
            by_delay=self.in_time(-self.s * torque),
            speed_m_s=self._mean_speed(speed),
            top_speed_m_s=top,
        )

    @property
    def poles(self) -> Complex:
        """Return the upper pole of each mode, shape (MODES,)."""
        upper: Complex = self._pairs[:, 0]
        return upper

    @property
    def _leverage(self) -> Real:
        """Return the leverage of the modes, L b_i, shape (MODES,)."""
        return self.plant.beam.length_m * self._grid.leverage_m

    def _mean_speed(self, speed: Real) -> float:
        cubes = np.abs(speed) ** 3
        total = float(cubes.sum(axis=0) @ self._grid.weight_m)
        power = float(np.einsum("tg,tg->g", cubes, np.abs(speed)) @ self._grid.weight_m)
        return power / total if total > 0 else 0.0

    def _linear_speed(self) -> Real:
        """Return the speeds at the points without drag, shape (3 m, POINTS)."""
        speed = np.outer(self._fine(self._turning), self._grid.x_m)
        for shape, driven in zip(self._grid.shapes, self._driven, strict=True):
            speed += np.outer(self._fine(driven), shape)
        return speed

    def _brake(self, speed: Real, law: DragLaw) -> None:
        """Replace the speeds without drag by those with drag, in the same array."""
        output, by_state, by_force = self._stepping()
        step = np.concatenate([self._grid.shapes.T @ output, by_state])
        of_force = by_force @ self._grid.to_modes
        state, force, magnitude = np.zeros(len(by_state)), *np.zeros((2, POINTS))
        out = np.zeros(len(step))
        braked, later = out[:POINTS], out[POINTS:]
        constant, slowing = -HALF_DENSITY * law.constant_m, -HALF_DENSITY * law.slowing
        step_dot, of_force_dot = step.dot, of_force.dot
        add, multiply, absolute, cbrt = np.add, np.multiply, np.absolute, np.cbrt
        for at in speed:
            step_dot(state, out)
            add(at, braked, at)
            absolute(at, magnitude)
            if slowing:
                cbrt(magnitude, force)
                multiply(force, slowing, force)
                multiply(magnitude, constant, magnitude)
                add(force, magnitude, magnitude)
            else:
                multiply(magnitude, constant, magnitude)
            multiply(magnitude, at, force)
            of_force_dot(force, state)
            add(state, later, state)

    def _perturbed(self, speed: Real, law: DragLaw, sources: list[tuple[int, Real]]) -> list[Real]:
        """Return the first-order change of the modal forces by a mode's speed and by the law.

        To first order the points are not needed: the effect of the speed of one mode on the force
        on another is one number at each step. `speed`, shape (3 m, POINTS), is with drag; `sources`
        holds for each mode (from 0) that moves faster the additional speed, shape (3 m,).
        """
        output, by_state, by_force = self._stepping()
        step = np.concatenate([output, by_state])
        of_force = np.hstack([by_force, np.zeros((len(by_force), 1))])  # none of the moment
        runs, weights = len(sources) + 2, self._to_root
        coupling = (weights[:, None] * self._grid.shapes).reshape(-1, POINTS).T
        changed = np.empty((len(speed), len(weights), runs))
        state, out = np.zeros((len(by_state), runs)), np.zeros((len(step), runs))
        braked, later = out[:MODES], out[MODES:]
        force, dot, add = np.empty(changed.shape[1:]), np.dot, np.add
        for first in range(0, len(speed), _CHUNK):
            chunk = slice(first, first + _CHUNK)
            now, magnitude = changed[chunk], np.abs(speed[chunk])
            slower = np.cbrt(magnitude)
            slope = -2 * HALF_DENSITY * law.constant_m * magnitude
            if law.slowing:
                slope -= (1 + _SLOWING) * HALF_DENSITY * law.slowing * slower
            by_speed = (slope @ coupling).reshape(-1, len(weights), MODES)
            for run, (mode, faster) in enumerate(sources):
                np.multiply(by_speed[:, :, mode], faster[chunk, None], out=now[:, :, run])
            for run, power in (-2, magnitude), (-1, slower):
                now[:, :, run] = (-HALF_DENSITY * power * speed[chunk]) @ weights.T
            for at, matrix in zip(now, by_speed, strict=True):
                dot(step, state, out)
                dot(matrix, braked, force)
                add(at, force, at)
                dot(of_force, at, state)
                add(state, later, state)
        return list(np.ascontiguousarray(changed.transpose(2, 1, 0)))

    def _stepping(self) -> tuple[Real, Real, Real]:
        """Return the matrices of a time step: modal speeds and next state by state, and by force.

        The state holds two numbers a mode, then the modes' forces of the last three steps.
        """
        n, step_s = MODES, 1 / (_OVERSAMPLING * self._rate_hz)
        states = 2 * n + _PAST * n
        by_state, by_force = np.zeros((states, states)), np.zeros((states, n))
        output = np.zeros((n, states))
        z_prime = self._slopes()
        for i, (pair, slope) in enumerate(zip(self._pairs, z_prime, strict=True)):
            rows = slice(2 * i, 2 * i + 2)
            decay = np.exp(pair * step_s)
            inputs = _polynomial_inputs(pair, step_s)  # (2, 1 + _PAST), the newest first
            gain = pair / slope / self.plant.beam.bending_stiffness_n_m2
            if pair[0].imag > 0:
                a, b = decay[0].real, decay[0].imag
                by_state[rows, rows] = [[a, -b], [b, a]]
                parts = np.array([inputs[0].real, inputs[0].imag])
                output[i, rows] = 2 * gain[0].real, -2 * gain[0].imag
            elif np.isnan(pair[0]):
                continue
            else:
                by_state[rows, rows] = np.diag(decay.real)
                parts = inputs.real
                output[i, rows] = gain.real
            by_force[rows, i] = parts[:, 0]
            by_state[rows, 2 * n + i :: n] = parts[:, 1:]
        # The forces move on by one step.
        by_force[2 * n : 3 * n] = np.eye(n)
        by_state[3 * n :, 2 * n : -n] = np.eye((_PAST - 1) * n)
        # For the speed the new force is not known yet: it is foreseen from the last three.
        foreseen = by_state[: 2 * n].copy()
        for back, factor in enumerate((3.0, -3.0, 1.0)):
            columns = slice((2 + back) * n, (3 + back) * n)
            foreseen[:, columns] += factor * by_force[: 2 * n]
        return output[:, : 2 * n] @ foreseen, by_state, by_force

    def _slopes(self) -> Complex:
        """Return the slope of Z at the poles, shape (MODES, 2)."""
        s, damping = self._pairs, self.plant.damping
        ratio = self.plant.beam.density_over_stiffness
        log_s = np.log(s)
        external = damping.gamma * np.exp(damping.lambda_ * log_s)
        internal = damping.zeta * np.exp(damping.alpha * log_s)
        k = -(ratio * s * s + external) / (1 + internal)  # Z is nought there
        slopes: Complex = (
            2 * ratio * s + (damping.lambda_ * external + damping.alpha * k * internal) / s
        )
        return slopes

    @property
    def _to_root(self) -> Real:
        """Return the matrix from points to modes and, last, the moment: (MODES + 1, POINTS)."""
        return np.vstack([self._grid.to_modes, self._grid.to_moment])

    def _modal(self, force: Real) -> Real:
        """Return the force on each mode and, last, its moment, from (3 m, POINTS)."""
        modal: Real = self._to_root @ force.T
        return modal

    def _spectra(self, forces: Real) -> Complex:
        """Transform the result of `_modal`, shape (MODES + 1, bins)."""
        every = np.fft.rfft(forces / self._growth, _OVERSAMPLING * self._length)
        spectra: Complex = every[:, : self.s.size] / _OVERSAMPLING
        return spectra

    def _response(self, spectra: Complex) -> Complex:
        """Return the transform of the torque by modal forces and moment, without the delay."""
        torque: Complex = self._leverage @ (self._follow * spectra[:-1]) - spectra[-1]
        return torque

    def _torque(self, forces: Real) -> Real:
        return self.in_time(self._response(self._spectra(forces)))

    def in_time(self, torque: Complex) -> Real:
        """Return the values (..., m) of a torque after its channel, at the samples of the angle.

        Parameters
        ----------
        torque : ndarray of complex, shape (..., bins)
            On the grid `s`.
        """
        values = np.fft.irfft(torque * self._late, self._length)[..., : self._samples]
        values *= self._growth[::_OVERSAMPLING]
        return values

    def modal_torque(self, mode: int) -> Complex:
        """Return the part of one mode, from 1, in the linear torque, without delay, shape (bins,).

        This part contains all dependence of the torque on the poles of the mode.
        """
        term = self.plant.beam.bending_stiffness_n_m2 * self._leverage[mode - 1]
        torque: Complex = term * self._inertial * self._driven[mode - 1] / self.s
        return torque

    def _fine(self, spectrum: Complex) -> Real:
        """Return the values (..., 3 m) over the record at the multiple of the rate."""
        fine = np.fft.irfft(_OVERSAMPLING * spectrum, _OVERSAMPLING * self._length)
        values: Real = fine[..., : self._growth.size] * self._growth
        return values


def _force(speed: Real, law: DragLaw) -> Real:
    """Return the force per metre in N/m."""
    magnitude = np.abs(speed)
    per_speed = law.constant_m * magnitude
    if law.slowing:
        per_speed += law.slowing * np.cbrt(magnitude)
    force: Real = -HALF_DENSITY * per_speed * speed
    return force


def _pole_pairs(k_of_length: Real, plant: Plant) -> Complex:
    """Return the poles of the modes, shape (MODES, 2), whose ``(k L)^4`` is given."""
    pairs = poles_for_eigenvalues(k_of_length**0.25, plant.beam, plant.damping)
    return pairs.astype(np.complex128)


def _polynomial_inputs(pole: Complex, step_s: float) -> Complex:
    """Integrate ``z' = p z + F`` over the forces at the steps: (poles, 1 + _PAST).

    Between the instants the force is the polynomial through all of them.
    """
    node, weight = np.polynomial.legendre.leggauss(_QUADRATURE)
    at = 0.5 * (node + 1)
    nodes = 1.0 - np.arange(1 + _PAST)
    lagrange = np.array(
        [
            np.prod([(at - other) / (own - other) for other in nodes if other != own], axis=0)
            for own in nodes
        ]
    )
    growth = np.exp(pole[:, None] * (step_s * (1 - at)))
    inputs: Complex = growth * (0.5 * step_s * weight) @ lagrange.T
    return inputs


# Change with beam and drag

_OF_EXTERNAL: Final = ("gamma", "lambda")


@dataclass(frozen=True, slots=True, eq=False)
class DragExpansion:
    """Derivatives of the torque by drag at one beam and drag, as spectra in the band.

    Attributes
    ----------
    plant : Plant
    law : DragLaw
        Beam and law for which the torque was removed from the record.
    response : DragResponse
        Response of that beam to drag.
    band : callable
        Function that returns the spectrum in the band of samples at the times of the angle.
    by_pole : dict of int to ndarray of complex, shape (2, K)
        For each mode: by the real and the imaginary part of its upper pole.
    by_external : ndarray of complex, shape (2, 2, K)
        By the external damping of each of the two lowest modes, as `DragTorque` has it.
    by_ln_density, by_delay : ndarray of complex, shape (K,)
    by_law : ndarray of complex, shape (2, K)
        By the two numbers of the law.
    speed_m_s, top_speed_m_s : float
        Speed that counts most, and the highest: see `DragTorque`.
    """

    plant: Plant
    law: DragLaw
    response: DragResponse
    band: Callable[[Real], Complex]
    by_pole: dict[int, Complex]
    by_external: Complex
    by_ln_density: Complex
    by_delay: Complex
    by_law: Complex
    speed_m_s: float
    top_speed_m_s: float

    def change_to(
        self, plant: Plant, poles: Sequence[Pole], names: Sequence[str], chain: Real
    ) -> tuple[Complex, Complex]:
        """Return the change of the spectrum (K,) for another beam, and its derivatives (k, K).

        Parameters
        ----------
        plant : Plant
            The other beam.
        poles : sequence of Pole
            Its poles, differentiated by the unknowns.
        names : sequence of str
            Names of the parameters, those of `Unknowns`.
        chain : ndarray, shape (len(names), k)
            Their derivatives by the unknowns, of density over stiffness and of stiffness as
            logarithms.
        """
        rows, moved, slopes = [], [], []
        own = {pole.mode: pole.at_rad_s for pole in mode_poles(self.plant, len(self.by_pole), ())}
        for pole in poles:
            if pole.mode in self.by_pole and pole.oscillates and pole.mode in own:
                apart = pole.at_rad_s - own[pole.mode]
                curved, steeper = self._remainder(pole.mode, own[pole.mode], pole.at_rad_s)
                by_pole = self.by_pole[pole.mode]
                # Slopes at the pole itself, the values of the remainder in a separate row.
                rows += [*by_pole, *steeper, curved]
                moved += [apart.real, apart.imag, 0.0, 0.0, -1.0]
                turn = [pole.derivative.real, pole.derivative.imag]
                slopes += [*turn, *(-part for part in turn), np.zeros(chain.shape[1])]
        rows.append(self.by_ln_density)
        here, there = self.plant.beam.density_kg_per_m, plant.beam.density_kg_per_m
        moved.append(np.log(there / here))
        # The logarithms of the two add up to that of the mass per length.
        slopes.append(_part(chain, names, OF_BEAM).sum(axis=0))
        for by_external, values in zip(self.by_external, self._external(plant), strict=True):
            rows += list(by_external)
            moved += values[:, 0].tolist()
            slopes += list(values[:, 1:] @ _part(chain, names, _OF_EXTERNAL))
        rows.append(self.by_delay)
        moved.append(plant.delay_s - self.plant.delay_s)
        slopes += list(_part(chain, names, ("delay_s",)))
        # As real numbers: they are multiplied by real ones only.
        every = np.array(rows).view(np.float64)
        change: Complex = (np.array(moved) @ every).view(np.complex128)
        jacobian: Complex = (np.array(slopes).T @ every).view(np.complex128)
        return change, jacobian

    def _external(self, plant: Plant) -> list[Real]:
        """Return the external damping of another beam less that of this one, for the lowest modes.

        The difference is taken at the pole of each mode: with another order ``gamma s^lambda`` is
        not linear in gamma and lambda, and a fit with insignificant external damping may reach any
        order.

        Returns
        -------
        list of ndarray, shape (2, 3)
            For each mode c_0 and c_1 of ``c_0 + c_1 s``, with their derivatives by gamma and
            lambda.
        """
        before, after = self.plant.damping, plant.damping
        found = []
        for s in self.response.poles[_LOWEST].tolist():
            if not s.imag > 0:  # no such oscillation
                found.append(np.zeros((2, 3)))
                continue
            log_s, per_gamma = np.log(s), s**after.lambda_
            change = after.gamma * per_gamma - before.gamma * s**before.lambda_
            values = np.array([change, per_gamma, after.gamma * log_s * per_gamma])
            of_s = values.imag / s.imag
            found.append(np.array([values.real - of_s * s.real, of_s]))
        return found

    def _remainder(self, mode: int, here: complex, there: complex) -> tuple[Complex, Complex]:
        """Return a mode's linear torque beyond first order in its pole, and its slopes.

        The torque has the shape (K,), and the slopes by the real and the imaginary part (2, K).
        """
        s, torque = self.response.s, self.response.modal_torque(mode)
        apart = there - here
        before, mirror = 1 / (s - here), 1 / (s - here.conjugate())
        after, after_mirror = 1 / (s - there), 1 / (s - there.conjugate())
        grown = after * after_mirror / (before * mirror)
        first = apart * before + apart.conjugate() * mirror
        real = grown * (after + after_mirror) - (before + mirror)
        imaginary = 1j * (grown * (after - after_mirror) - (before - mirror))
        spectra = torque * np.array([grown - 1 - first, real, imaginary])
        curved, *steeper = self.band(self.response.in_time(spectra))
        return curved, np.array(steeper)


def _part(chain: Real, names: Sequence[str], wanted: Sequence[str]) -> Real:
    """Return the rows of some parameters, shape (len(wanted), k); zero for a missing one."""
    none = np.zeros(chain.shape[1])
    return np.array([chain[names.index(name)] if name in names else none for name in wanted])
