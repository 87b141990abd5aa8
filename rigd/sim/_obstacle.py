"""Obstacles in the way of the simulated beam, and knocks on it, tick by tick.

A force on the beam drives additional states (`realise_force`): they describe its effect on the
beam, and their torque acts on the shaft. Where the beam touches nothing, plant and these states go
on by whole periods. Near an obstacle a period is divided into substeps, over each of which the
force is constant; all that the rest of the plant does meanwhile is linear and known exactly, so the
force of each substep is the root of one scalar equation.

Within a substep the penetration goes from a to q. The mean of the obstacle's elastic force over it
is taken so that the work done on the obstacle is the energy it then holds, or has given back: no
energy is created, whatever the stiffness. An obstacle that is stiffer than the beam is within one
substep takes some more, or its force would ring from substep to substep.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from math import ceil, exp, inf, pi, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rigd.beam import Beam, Damping, PointForceGrid, realise_force
from rigd.beam.realisation import CoupledModel, Realisation, held_inputs, propagator, state_output
from rigd.devices.obstacles import Disturbance, ImpactSpecification, Obstacle

Real = NDArray[np.float64]
Complex = NDArray[np.complexfloating]

_RIGID_N_PER_M = 1e9
"""Stiffness of a rigid obstacle: it yields a nanometre for a newton."""
_STIFFEST_N_PER_M = 1e5
"""Stiffest obstacle whose touch the substeps resolve."""
_PER_CONTACT_TIME = 6
"""Substeps in the time in which a struck beam gets out of the way of an obstacle."""
_FEWEST_PER_S = 16e3
_FEWEST_SUBSTEPS = 8
_FREE_END = 4.0
"""By how much a beam gives way more readily at its tip than far from it."""
_NEAR_M = 1e-3
"""Distance, in addition to the beam's motion, within which it may touch during a period."""
_SMALL = 0.01
"""Displacement, as a fraction of the rigid beam's, below which the absolute error counts: there the
beam hardly follows the motor."""
_SWEEPS = 3
"""Over several obstacles that the beam touches in one substep."""


class AttachedObstacles:
    """Obstacles and knocks, attached to the plant.

    Parameters
    ----------
    beam, damping, realisation
        The beam's.
    bodies
        Obstacles and knocks.
    period_s
        Length of a step of the plant.

    Attributes
    ----------
    forces_n : (substeps, bodies)
        Force on the beam over each substep of the last period, positive towards a positive angle.
    substeps : int
        Substeps of a period.
    bodies : tuple of Disturbance
        The obstacles and knocks.
    """

    def __init__(
        self,
        beam: Beam,
        damping: Damping,
        realisation: Realisation,
        bodies: tuple[Disturbance, ...],
        period_s: float,
    ) -> None:
        self.bodies = bodies
        self._period_s = period_s
        self.substeps = _substeps(beam, bodies, period_s)
        self._step_s = period_s / self.substeps
        at_m = np.array([body.x_m for body in bodies])
        pushed = [realise_force(beam, damping, x, at_m, 1 / self._step_s) for x in at_m.tolist()]
        # Rows: displacement at each body, torque, shear. Columns: the states of each force, or the
        # forces.
        self._own = np.column_stack([each.rows for each in pushed])
        self._direct = np.column_stack([each.direct for each in pushed])
        self._a, self._b = pushed[0].a, pushed[0].b  # the same for all
        self._oscillating = 2 * pushed[0].modes
        turned = [
            state_output(
                realisation,
                partial(_displacement, beam, damping, x),
                inertial=False,
                small=_SMALL * x,
            )
            for x in at_m.tolist()
        ]
        self._turned = np.array([[t.per_angle, t.per_velocity, *t.c] for t in turned])
        self._at_m = at_m
        self._obstacles = [
            (index, body, min(body.stiffness_n_per_m, _RIGID_N_PER_M))
            for index, body in enumerate(bodies)
            if isinstance(body, Obstacle)
        ]
        self._knocks = [
            (i, body) for i, body in enumerate(bodies) if isinstance(body, ImpactSpecification)
        ]
        self._none: Real = np.zeros((self.substeps, len(bodies)))
        self.forces_n = self._none
        # Displacement at each body at the end of the last period, and at its start.
        self._displacement_m: Real = np.zeros(len(bodies))
        self._start_m = self._displacement_m
        self._penetration_m = self._ends_m = dict.fromkeys(range(len(bodies)), -inf)

    @property
    def displacement_rows(self) -> Real:
        """Displacement of the beam at each body by the state of `attached`, (bodies, n)."""
        return np.column_stack([self._turned, self._own[:-2]])

    def attached(self, model: CoupledModel) -> tuple[CoupledModel, Real]:
        """Extend motor and beam by the effect of the forces on the beam.

        Returns
        -------
        model
            With more states for each force, whose torque acts on the shaft.
        of_force
            Effect of each force on the state's derivative, (n, bodies).
        """
        bodies, own_states = self._at_m.size, self._b.size
        n, more = model.b.size, bodies * own_states
        torque, shear = self._own[-2], self._own[-1]
        a = np.zeros((n + more, n + more))
        a[:n, :n] = model.a
        a[:n, n:] = -np.outer(model.b, torque)
        of_force = np.zeros((n + more, bodies))
        of_force[:n] = -np.outer(model.b, self._direct[-2])
        for index in range(bodies):
            states = slice(n + index * own_states, n + (index + 1) * own_states)
            a[states, states] = self._a
            of_force[states, index] = self._b
        extended = replace(
            model,
            a=a,
            b=np.append(model.b, np.zeros(more)),
            angle=np.append(model.angle, np.zeros(more)),
            velocity=np.append(model.velocity, np.zeros(more)),
            acceleration=np.append(model.acceleration, -model.acceleration_per_torque * torque),
            beam_torque=np.append(model.beam_torque, (1 - model.beam_torque_per_torque) * torque),
            sensor_torque=np.append(
                model.sensor_torque, (1 - model.sensor_torque_per_torque) * torque
            ),
            shear=np.append(model.shear, shear - model.shear_per_torque * torque),
        )
        return extended, of_force

    def march(
        self,
        model: CoupledModel,
        of_force: Real,
        holding_torque: Real,
        switch_s: float,
        angle_instant_s: float,
        torque_instant_s: float,
        friction: Real,
    ) -> "March":
        """Prepare the substeps of a period of a motor that turns, or is locked.

        Parameters
        ----------
        model, of_force
            As `attached` returns them.
        holding_torque, switch_s, angle_instant_s, torque_instant_s
            As for a step of the plant.
        friction
            Effect on the state of friction of the period before, shape (n,).
        """
        steps, step_s, bodies = self.substeps, self._step_s, self._at_m.size
        n = model.b.size
        phi, whole = propagator(model, step_s)
        displacement_rows = self.displacement_rows

        # Without a force: contribution of the states, row by row, and of the torques, column by
        # column.
        rows = np.empty((steps, bodies, n))
        row = displacement_rows
        for j in range(steps):
            rows[j] = row = row @ phi
        torques = np.empty((steps, bodies, 2))
        state = np.zeros((n, 2))
        for j in range(steps):
            before_s = min(max(switch_s - j * step_s, 0.0), step_s)
            after = propagator(model, step_s - before_s)[1] if 0 < before_s < step_s else whole
            after = after * (before_s < step_s)
            state = phi @ state + np.column_stack([whole - after, after])
            torques[j] = displacement_rows @ state
        free = np.column_stack([rows.reshape(-1, n), torques.reshape(-1, 2)])
        free = np.column_stack([free, free[:, :n] @ friction])

        # State that remains of a force of 1 N over one substep, j substeps later.
        left = np.empty((steps, n, bodies))
        left[0] = held_inputs(model, of_force, step_s)
        for j in range(1, steps):
            left[j] = phi @ left[j - 1]
        kernel = displacement_rows @ left
        kernel[0] += self._direct[:-2]

        def effect_on(row: Real, direct: Real, instant_s: float) -> Real:
            """Return the effect of each substep's force on an output at an instant."""
            at = instant_s / step_s
            number = min(int(at), steps - 1)
            fraction = at - number
            effect = np.zeros((steps, bodies))
            for node, weight in ((number, 1 - fraction), (number + 1, fraction)):
                effect[:node] += weight * (row @ left[:node])[::-1]
            effect[number] += direct
            return effect.ravel()

        at_sensor = (1 - model.sensor_torque_per_torque) * self._direct[-2]
        shear = self._direct[-1] - model.shear_per_torque * self._direct[-2]
        none, period_s = np.zeros(bodies), self._period_s
        effect = np.vstack(
            [
                left[::-1].transpose(1, 0, 2).reshape(n, -1),
                effect_on(model.angle, none, period_s),
                effect_on(model.velocity, none, period_s),
                effect_on(model.sensor_torque, at_sensor, period_s),
                effect_on(holding_torque, self._direct[-2], period_s),
                effect_on(model.shear, shear, period_s),
                effect_on(model.angle, none, angle_instant_s),
                effect_on(model.sensor_torque, at_sensor, torque_instant_s),
                effect_on(model.shear, shear, torque_instant_s),
            ]
        )
        return March(
            free=np.asfortranarray(free).dot,
            friction=-torques.sum(axis=2),
            kernel=kernel,
            history=_history(kernel),
            effect=np.asfortranarray(effect).dot,
            velocity_row=n + 1,
        )

    def nothing(self, displacement_m: Real, time_s: float) -> bool:
        """Return whether the beam cannot have touched anything over a period without a force.

        Parameters
        ----------
        displacement_m
            Displacement at each body at its end, shape (bodies,).
        time_s
            Time at its start.
        """
        end_s = time_s + self._period_s
        before_m = self._start_m = self._displacement_m
        self._displacement_m = displacement_m.copy()
        for _, knock in self._knocks:
            if time_s < knock.at_s + knock.duration_s and knock.at_s < end_s:
                return False
        for index, body, _ in self._obstacles:
            if body.from_s < end_s and time_s < body.until_s:
                if self._penetration_m[index] > 0:
                    return False
                old, new = before_m.item(index), displacement_m.item(index)
                moves = 2 * abs(new - old) + body.x_m * abs(body.rate_rad_s) * self._period_s
                if body.side * (new - _surface(body, end_s)) > -(moves + _NEAR_M):
                    return False
        self._penetration_m = dict.fromkeys(range(self._at_m.size), -inf)
        self.forces_n = self._none
        return True

    def forces(self, march: "March", free_m: Real, time_s: float) -> Real:
        """Find the forces of a period.

        Parameters
        ----------
        march
            Substeps of the plant as it is.
        free_m
            Displacement at the end of each substep that the beam would have without a force, shape
            (substeps, bodies).
        time_s
            Time at the period's start.

        Returns
        -------
        (substeps, bodies)
            In N, positive towards a positive angle.
        """
        steps, step_s = self.substeps, self._step_s
        kernel = march.kernel
        forces = np.zeros_like(self._none)
        free_m = free_m.copy()
        for index, knock in self._knocks:
            edges_s = time_s - knock.at_s + step_s * np.arange(steps + 1)
            # Mean of half a sine over each substep.
            phase = pi / knock.duration_s * np.clip(edges_s, 0.0, knock.duration_s)
            forces[:, index] = (
                -knock.force_n * knock.duration_s / pi / step_s * np.diff(np.cos(phase))
            )
            for j in np.flatnonzero(forces[:, index]).tolist():
                free_m[j:] += kernel[: steps - j, :, index] * forces[j, index]

        ends_s = time_s + step_s * np.arange(1, steps + 1)
        walls = []
        for index, body, stiffness in self._obstacles:
            there = (ends_s > body.from_s) & (ends_s <= body.until_s)
            if not there.any():
                continue
            surface_m = _surface(body, ends_s)
            start_m = self._penetration_m[index]
            if start_m == -inf and body.from_s <= time_s:
                start_m = body.side * (self._start_m.item(index) - _surface(body, time_s))
            walls.append(
                _Wall(
                    index=index,
                    side=body.side,
                    stiffness_n_per_m=stiffness,
                    damping_n_per_m=body.damping_n_s_per_m / step_s,
                    compliance_m_per_n=kernel.item(0, index, index),
                    free_m=np.where(there, body.side * (free_m[:, index] - surface_m), -inf),
                    start_m=start_m,
                    force_n=np.zeros(steps),
                )
            )
        if walls:
            self._meet(march, walls)
        self._ends_m = dict.fromkeys(range(self._at_m.size), -inf)
        for wall in walls:
            self._ends_m[wall.index] = wall.start_m
            forces[:, wall.index] = -wall.side * wall.force_n
        return forces

    def _meet(self, march: "March", walls: "list[_Wall]") -> None:
        """Compute the walls' forces, substep by substep, through a period.

        Forces of the substeps to come are zero, so that whole rows may be summed.
        """
        steps = self.substeps
        # By how much each push takes the beam out of a wall at the end of each substep.
        relief = [
            [(one.side * other.side * march.history[one.index, other.index], other.force_n)
             for other in walls]
            for one in walls
        ]  # fmt: skip
        rows = [[(list(matrix), force_n) for matrix, force_n in pairs] for pairs in relief]
        tasks = list(zip(walls, rows, strict=True))
        sweeps = _SWEEPS if len(walls) > 1 else 1
        j = 0
        while j < steps:
            if all(wall.start_m <= 0 for wall in walls):
                # Nothing is touched: on to the substep at whose end something would be.
                first = steps
                ahead_m = [
                    wall.free_m - sum(matrix @ force_n for matrix, force_n in pairs)
                    for wall, pairs in zip(walls, relief, strict=True)
                ]
                for without_m in ahead_m:
                    touched = without_m[j:first] > 0
                    if touched.any():
                        first = j + int(touched.argmax())
                if first > j:
                    for wall, without_m in zip(walls, ahead_m, strict=True):
                        wall.start_m = without_m.item(first - 1)
                j = first
                if j == steps:
                    return
            for _ in range(sweeps):
                for wall, pairs_of_rows in tasks:
                    wall.force_n[j] = 0.0
                    without = wall.free_m.item(j)
                    for matrix_rows, force_n in pairs_of_rows:
                        without -= matrix_rows[j].dot(force_n)
                    push, wall.end_m = wall.meet(without)
                    wall.force_n[j] = push
            for wall in walls:
                wall.start_m = wall.end_m
            j += 1

    def take_over(self, state: Real, other: "AttachedObstacles | None") -> Real:
        """Continue from another contact of the beam, whose bodies are the first of these.

        Parameters
        ----------
        state
            State of the plant with the other contact.
        other
            None: there was no contact before.

        Returns
        -------
        ndarray
            State of the plant with this contact.
        """
        size = self._b.size
        old_size = 0 if other is None else other._b.size
        old_bodies = 0 if other is None else other._at_m.size
        n = state.size - old_size * old_bodies
        whole = np.zeros(n + size * self._at_m.size)
        whole[:n] = state[:n]
        if other is not None:
            modal = min(self._oscillating, other._oscillating)
            real = min(size - self._oscillating, old_size - other._oscillating)
            for index in range(old_bodies):
                new = whole[n + index * size :]
                old = state[n + index * old_size :]
                new[:modal] = old[:modal]
                new[self._oscillating : self._oscillating + real] = old[
                    other._oscillating : other._oscillating + real
                ]
            self._penetration_m.update(other._penetration_m)
        self._displacement_m = self.displacement_rows @ whole
        return whole

    def end(self, body: Disturbance, time_s: float) -> None:
        """Remove an obstacle."""
        self._obstacles = [
            (index, replace(each, until_s=min(each.until_s, time_s)) if each == body else each, k)
            for index, each, k in self._obstacles
        ]

    def take(self, march: "March", forces_n: Real, free_m: Real) -> None:
        """Continue from the last result of `forces`."""
        self.forces_n = forces_n
        self._penetration_m = self._ends_m
        self._displacement_m = free_m[-1] + np.einsum("jab,jb->a", march.kernel[::-1], forces_n)


@dataclass(slots=True, eq=False)
class _Wall:
    """An obstacle over one period."""

    index: int
    side: int
    stiffness_n_per_m: float
    damping_n_per_m: float  # over the length of a substep
    compliance_m_per_n: float  # by how much the beam gives way within a substep
    free_m: Real  # penetration at the end of each substep without any push of this period
    start_m: float  # penetration at the start of the present substep
    force_n: Real  # the pushes, as far as found; positive, whatever the side
    end_m: float = -inf  # penetration at the end of the present substep

    def meet(self, p: float) -> tuple[float, float]:
        """Return push and penetration at the end of a substep that without a push would be p.

        The push is the mean over the substep, which the work decides: see the module.
        """
        if p == -inf:  # it is not there
            return 0.0, p
        a, compliance, damping = self.start_m, self.compliance_m_per_n, self.damping_n_per_m
        stiffness = self.stiffness_n_per_m
        if a == -inf:  # it has just appeared
            a = 0.0
        if a >= 0:
            ratio = (stiffness * compliance) ** 2
            # From 1/2, which conserves energy, to 1, which takes what would ring.
            weight = 0.5 + 0.5 * ratio / (1 + ratio)
            force = stiffness * ((1 - weight) * a + weight * p) + damping * (p - a)
            force /= 1 + compliance * (stiffness * weight + damping)
            q = p - compliance * force
            if q >= 0:
                return (force, q) if force > 0 else (0.0, p)
            # It leaves: (p - q) (a - q) / compliance = k a²/2 - damping a (a - q)
            p_less = p + compliance * damping * a
            root = sqrt((p_less - a) ** 2 + 2 * compliance * stiffness * a * a)
            q = 0.5 * (p_less + a - root)
            force = 0.5 * stiffness * a * a / (a - q) - damping * a
        elif p > 0:
            # It arrives: (p - q) (q - a) / compliance = k q²/2 + damping q (q - a)
            square = 1 + compliance * (0.5 * stiffness + damping)
            linear = p + a + compliance * damping * a
            root = sqrt(linear * linear - 4 * square * p * a)
            # Either form of the positive root cancels where the other does not.
            q = (linear + root) / (2 * square) if linear > 0 else 2 * p * a / (linear - root)
            force = 0.5 * stiffness * q * q / (q - a) + damping * q
        else:
            return 0.0, p
        return (force, q) if force > 0 else (0.0, p)


@dataclass(frozen=True, slots=True, eq=False)
class March:
    """Substeps of a period, for a motor that turns or one that is locked."""

    free: Callable[[Real], Real]
    """From [state, torque before and after the switch, friction of the period before] to the
    displacement at the end of each substep, body by body."""
    friction: Real
    """(substeps, bodies): what friction of 1 N·m adds to it."""
    kernel: Real
    """(substeps, bodies, bodies): displacement at the end of the same substep and of each later one
    by a force of 1 N over one."""
    history: Real
    """(bodies, bodies, substeps, substeps): the same by the forces of all substeps up to each."""
    effect: Callable[[Real], Real]
    """From the forces to what they add to [next state, outputs]."""
    velocity_row: int
    """Row of the velocity there."""


def _history(kernel: Real) -> Real:
    """Lower triangular matrices of a kernel (substeps, m, m), shape (m, m, substeps, substeps)."""
    steps = len(kernel)
    lag = np.subtract.outer(np.arange(steps), np.arange(steps))
    history: Real = np.where(lag >= 0, kernel.transpose(1, 2, 0)[:, :, np.maximum(lag, 0)], 0.0)
    return history


def _surface(body: Obstacle, time_s: Any) -> Any:  # noqa: ANN401 - one time or several
    """Displacement at which the beam touches an obstacle."""
    return body.x_m * (body.angle_rad + body.rate_rad_s * (time_s - body.from_s))


def _substeps(beam: Beam, bodies: tuple[Disturbance, ...], period_s: float) -> int:
    """Substeps of a period, fine enough for the stiffest obstacle."""
    # A force that grows like k t moves a beam without ends by k t^(3/2) / unit.
    unit = 2 * sqrt(2) * beam.density_kg_per_m**0.75 * beam.bending_stiffness_n_m2**0.25
    wanted = [_FEWEST_PER_S]
    for body in bodies:
        if isinstance(body, Obstacle):
            rate_per_s = (min(body.stiffness_n_per_m, _STIFFEST_N_PER_M) / unit) ** (2 / 3)
            reach_m = (beam.density_over_stiffness * rate_per_s**2) ** -0.25
            nearness = exp((body.x_m - beam.length_m) / reach_m)
            gives_way = 1 + (_FREE_END - 1) * nearness
            wanted.append(_PER_CONTACT_TIME * rate_per_s * gives_way ** (2 / 3))
    return max(_FEWEST_SUBSTEPS, ceil(max(wanted) * period_s))


def _displacement(beam: Beam, damping: Damping, x_m: float, s: Complex) -> Complex:
    return PointForceGrid(s, beam, damping).per_angle(x_m)
