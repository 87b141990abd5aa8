"""What the devices read while nothing is to move: the tare, and whether the rig is at rest."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigd.devices.contracts import Wrench
from rigd.engine.cycle import Cycle
from rigd.engine.metronome import Metronome

AXES = ("fx_n", "fy_n", "fz_n", "tx_nm", "ty_nm", "tz_nm")


@dataclass(frozen=True, slots=True)
class Rest:
    """Readings without torque.

    Attributes
    ----------
    duration_s
        For how long.
    wrenches
        Raw: not tared; N and N·m, shape (n, 6).
    angles_rad
        From the rig's zero; shape (n,).
    torques_nm
        Coupling torque of the raw wrenches; shape (n,).
    """

    duration_s: float
    wrenches: NDArray[np.float64]
    angles_rad: NDArray[np.float64]
    torques_nm: NDArray[np.float64]

    @property
    def speed_rad_s(self) -> float:
        """Mean speed of the motor, from the angles' range."""
        return float(np.ptp(self.angles_rad)) / self.duration_s

    @property
    def torque_spread_nm(self) -> float:
        """Standard deviation of the coupling torque: noise, and a beam that swings."""
        return float(self.torques_nm.std())

    @property
    def mean(self) -> Wrench:
        """Mean of each axis, N and N·m."""
        fx, fy, fz, tx, ty, tz = (float(value) for value in self.wrenches.mean(axis=0))
        return fx, fy, fz, tx, ty, tz

    @property
    def spread(self) -> Wrench:
        """Standard deviation of each axis, N and N·m."""
        fx, fy, fz, tx, ty, tz = (float(value) for value in self.wrenches.std(axis=0, ddof=1))
        return fx, fy, fz, tx, ty, tz

    def as_metadata(self) -> dict[str, str]:
        """Return the tare as a session file states it."""
        return {"tare_s": repr(self.duration_s)} | {
            f"tare_{what}_{axis}": repr(value)
            for what, values in (("mean", self.mean), ("std", self.spread))
            for axis, value in zip(AXES, values, strict=True)
        }


def observe_rest(
    cycle: Cycle,
    metronome: Metronome,
    *,
    rate_hz: float,
    duration_s: float,
    projection: Wrench,
    check: Callable[[], None],
) -> Rest:
    """Read angle and wrench for some time without touching the torque.

    Parameters
    ----------
    cycle, metronome
        Which devices, and when.
    rate_hz, duration_s
        How often and for how long.
    projection
        Coupling torque = projection · wrench.
    check
        Called after each reading; raises to end it.
    """
    wrenches: list[Wrench] = []
    angles: list[float] = []
    for _ in range(round(duration_s * rate_hz)):
        metronome.wait()
        cycle.observe(metronome.due_ns)
        check()
        wrenches.append(cycle.raw_wrench)
        angles.append(cycle.angle_rad)
    readings = np.array(wrenches)
    return Rest(duration_s, readings, np.array(angles), readings @ np.array(projection))
