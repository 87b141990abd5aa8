"""A motor's shaft with friction and one flexible mode: the physics of the independent rig."""

from dataclasses import dataclass, field

_STEP_S = 2.5e-4
_LONGEST_S = 2.0
"""A process that was suspended for longer goes on from where it stood."""


@dataclass
class Shaft:
    """Hub and beam: the beam's inertia is partly rigid on the hub, partly behind a spring."""

    inertia_kg_m2: float = 2.0e-3
    viscous_nm_s_per_rad: float = 0.02
    coulomb_nm: float = 0.03
    rigid_kg_m2: float = 4.3e-5
    """Inertia of the beam, without the mode: 3 % of rho L³ / 3 for 4.7 g/m and 0.98 m."""
    mode_kg_m2: float = 1.43e-3
    mode_rad_s: float = 16.0
    """First eigenfrequency with the hub held."""
    mode_damping: float = 0.01
    angle_rad: float = 0.0
    speed_rad_s: float = 0.0
    coupling_nm: float = 0.0
    """Torque of the hub on the beam."""
    _beam_rad: float = field(default=0.0, init=False)
    _beam_rad_s: float = field(default=0.0, init=False)
    _time_s: float | None = field(default=None, init=False)

    def advance(self, now_s: float, torque_nm: float) -> None:
        """Move on to a time, with the torque that stood until then."""
        if self._time_s is None or now_s - self._time_s > _LONGEST_S:
            self._time_s = now_s
        while self._time_s + _STEP_S <= now_s:
            self._time_s += _STEP_S
            self._step(torque_nm)

    def _step(self, torque_nm: float) -> None:
        stiffness = self.mode_kg_m2 * self.mode_rad_s**2
        damper = 2 * self.mode_damping * self.mode_kg_m2 * self.mode_rad_s
        spring_nm = stiffness * (self.angle_rad - self._beam_rad)
        spring_nm += damper * (self.speed_rad_s - self._beam_rad_s)
        inertia = self.inertia_kg_m2 + self.rigid_kg_m2
        before = self.speed_rad_s
        drag_nm = self.viscous_nm_s_per_rad * before
        free = before + _STEP_S * (torque_nm - spring_nm - drag_nm) / inertia
        grip = _STEP_S * self.coulomb_nm / inertia
        # Dry friction stops the motion and does not reverse it.
        self.speed_rad_s = 0.0 if abs(free) <= grip else free - grip * (1 if free > 0 else -1)
        self.angle_rad += _STEP_S * self.speed_rad_s
        self._beam_rad_s += _STEP_S * spring_nm / self.mode_kg_m2
        self._beam_rad += _STEP_S * self._beam_rad_s
        self.coupling_nm = spring_nm + self.rigid_kg_m2 * (self.speed_rad_s - before) / _STEP_S
