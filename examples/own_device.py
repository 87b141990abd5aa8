"""A drive and a sensor of one's own, behind the devices' contract: a rigid hub with friction.

Usage: python own_device.py

`rigd.devices.contracts` says what the cycle asks of a device. This one moves a rigid body; to let a
profile name it, see "A device" in CONTRIBUTING.md.
"""

import math
from collections.abc import Callable

from rigd.devices import Devices, LineHealth, Wrench

PERIOD_NS = 1_000_000


class RigidHub:
    """Drive with encoder, and wrench sensor, of a rigid body: inertia (kg·m²), friction (N·m·s)."""

    angle_stale = wrench_stale = wrench_saturated = False
    off_doubt = ""

    def __init__(self, inertia_kg_m2: float = 3.5e-3, friction_nm_s: float = 7e-3) -> None:
        self._inertia, self._friction = inertia_kg_m2, friction_nm_s
        self._angle_rad = self._speed_rad_s = self._torque_nm = 0.0
        self._enabled = False
        self.angle_time_ns = self.wrench_time_ns = 0

    def connect(self) -> None:
        """Do nothing: there is no line."""

    def enable(self, stop: Callable[[], bool] = lambda: False) -> None:  # noqa: ARG002
        """Let commands through, at zero torque; `stop` matters where this takes its time."""
        self._torque_nm, self._enabled = 0.0, True

    def latch(self, due_ns: int) -> None:
        """Move on to the tick at `due_ns`, the torque held: exact for a linear body."""
        time_s, self.angle_time_ns = (due_ns - self.angle_time_ns) / 1e9, due_ns
        final_rad_s = self._torque_nm / self._friction
        rate_1_s = self._friction / self._inertia
        decay = math.exp(-rate_1_s * time_s)
        excess_rad_s = self._speed_rad_s - final_rad_s
        self._angle_rad += final_rad_s * time_s + excess_rad_s * (1 - decay) / rate_1_s
        self._speed_rad_s = final_rad_s + excess_rad_s * decay

    def read_angle(self) -> float:
        """Return the latched angle in rad."""
        return self._angle_rad

    def command(self, torque_nm: float) -> float:
        """Hold a torque in N·m until the next command; a drive that is disabled exerts none."""
        self._torque_nm = torque_nm if self._enabled else 0.0
        return torque_nm

    def disable(self) -> None:
        """Take the torque away, in every state."""
        self._torque_nm, self._enabled = 0.0, False

    def calibration(self) -> dict[str, object]:
        """Return what the session file states of the sensor."""
        return {"sensor": "computed torque of a rigid hub"}

    def request(self, due_ns: int) -> None:
        """Ask for the wrench of the tick at `due_ns`."""
        self.wrench_time_ns = due_ns

    def read_wrench(self) -> Wrench:
        """Return fx … tz: nothing but the torque that accelerates the body, about z."""
        torque_nm = self._torque_nm - self._friction * self._speed_rad_s
        return (0.0, 0.0, 0.0, 0.0, 0.0, torque_nm)

    def health(self) -> LineHealth:
        """Tell that the sensor is well; of a line nothing is known."""
        return LineHealth(errors=0, status=0)

    def close(self) -> None:
        """Disable; there is no line to release."""
        self.disable()


def open_rigid_hub() -> Devices:
    """Make drive and sensor, as an entry of the registry of devices does."""
    hub = RigidHub()
    return Devices(drive=hub, sensor=hub, simulated=True)


def main() -> None:
    """Turn the hub by 0.1 rad as the cycle would: latch, request, read, command in every tick."""
    devices = open_rigid_hub()
    devices.sensor.connect()
    devices.drive.connect()
    devices.drive.enable()
    last_rad = 0.0
    for tick in range(1000):
        devices.drive.latch(tick * PERIOD_NS)
        devices.sensor.request(tick * PERIOD_NS)
        angle_rad = devices.drive.read_angle()
        wrench = devices.sensor.read_wrench()
        speed_rad_s, last_rad = (angle_rad - last_rad) * 1e9 / PERIOD_NS, angle_rad
        devices.drive.command(1.4 * (0.1 - angle_rad) - 0.13 * speed_rad_s)
        if tick % 250 == 0 or tick == 999:
            print(f"{tick} ms: {angle_rad:.4f} rad, {wrench[5]:+.3f} N·m")
    devices.drive.close()


if __name__ == "__main__":
    main()
