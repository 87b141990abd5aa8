"""Implement the device interface with a drive and a sensor of your own: a rigid hub with friction.

Usage: python own_device.py

`rigd.devices.contracts` describes each method; CONTRIBUTING.md describes how to add a device that a
profile can name.
"""

import math
import random
from collections.abc import Callable

from rigd.devices.contracts import Devices, LineHealth, Wrench

INERTIA_KG_M2, FRICTION_NM_S, NOISE = 3.5e-3, 7e-3, 1e-4


class RigidHub:
    """Drive with encoder, and wrench sensor."""

    angle_rad = speed_rad_s = torque_nm = 0.0
    angle_stale = wrench_stale = wrench_saturated = enabled = False
    angle_time_ns = wrench_time_ns = 0
    off_doubt = ""

    def connect(self) -> None:
        pass  # there is no connection

    def enable(self, stop: Callable[[], bool] = lambda: False) -> None:  # noqa: ARG002
        self.torque_nm, self.enabled = 0.0, True

    def latch(self, due_ns: int) -> None:
        time_s, self.angle_time_ns = (due_ns - self.angle_time_ns) / 1e9, due_ns
        # Exact for a constant torque: the speed tends to torque over friction.
        final_rad_s, rate_1_s = self.torque_nm / FRICTION_NM_S, FRICTION_NM_S / INERTIA_KG_M2
        excess_rad_s, decay = self.speed_rad_s - final_rad_s, math.exp(-rate_1_s * time_s)
        self.angle_rad += final_rad_s * time_s + excess_rad_s * (1 - decay) / rate_1_s
        self.speed_rad_s = final_rad_s + excess_rad_s * decay

    def read_angle(self) -> float:
        return self.angle_rad

    def command(self, torque_nm: float) -> float:
        self.torque_nm = torque_nm if self.enabled else 0.0
        return self.torque_nm

    def disable(self) -> None:
        self.torque_nm, self.enabled = 0.0, False

    def calibration(self) -> dict[str, object]:
        return {"sensor": "computed torque of a rigid hub"}

    def request(self, due_ns: int) -> None:
        self.wrench_time_ns = due_ns

    def read_wrench(self) -> Wrench:
        torque_nm = self.torque_nm - FRICTION_NM_S * self.speed_rad_s
        # Without noise, rigd takes the sensor for a frozen one, and ends the session.
        fx, fy, fz, tx, ty, noise_nm = (random.gauss(0.0, NOISE) for _ in range(6))
        return (fx, fy, fz, tx, ty, torque_nm + noise_nm)

    def health(self) -> LineHealth:
        return LineHealth(errors=0, status=0)

    close = disable


def open_rigid_hub() -> Devices:
    """Create drive and sensor, as the device registry would."""
    hub = RigidHub()
    return Devices(drive=hub, sensor=hub, simulated=True)


if __name__ == "__main__":
    devices, last_rad = open_rigid_hub(), 0.0
    devices.sensor.connect()
    devices.drive.connect()
    devices.drive.enable()
    for tick in range(1000):  # as in the control loop: latch, request, read, command
        devices.drive.latch(tick * 1_000_000)
        devices.sensor.request(tick * 1_000_000)
        angle_rad, wrench = devices.drive.read_angle(), devices.sensor.read_wrench()
        speed_rad_s, last_rad = (angle_rad - last_rad) * 1e3, angle_rad
        devices.drive.command(1.4 * (0.1 - angle_rad) - 0.13 * speed_rad_s)
        if tick % 250 == 0 or tick == 999:
            print(f"{tick} ms: {angle_rad:.4f} rad, {wrench[5]:+.3f} N·m")
    devices.drive.close()
