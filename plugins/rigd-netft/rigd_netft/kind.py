"""Declaration of the Net F/T box for rigd."""

from collections.abc import Iterator, Mapping
from typing import Any, Final

from rigd.devices.contracts import DeviceError, WrenchSensor
from rigd.devices.declaration import DeviceKind, OpenedDrive
from rigd.devices.parameters import RigParameters
from rigd_netft.protocol import achieved_rate_hz
from rigd_netft.settings import NetFtSettings


def open_sensor(rig: RigParameters, opened: OpenedDrive) -> WrenchSensor:
    """Create the driver of the box, or of a simulated box if this process simulates the drive.

    Raises
    ------
    DeviceError
        If the drive is simulated by another process, which has no such box.
    """
    from rigd_netft.sensor import NetFtSensor

    settings = rig.settings_of(NetFtSettings)
    if opened.simulated_sensor is not None:
        from rigd_netft.box import simulated_box

        return NetFtSensor(rig, settings, simulated_box(rig, settings, opened.simulated_sensor))
    if opened.simulated:
        raise DeviceError(
            f"{rig.name}: rigd simulate has no Net F/T box; end it to use the hardware, or choose "
            'devices.drive = "sim", with which the box is simulated.'
        )
    if settings.faults:
        raise DeviceError("netft.faults are those of a simulated box; remove the key.")
    return NetFtSensor(rig, settings)


def contradictions(values: Mapping[str, Any]) -> Iterator[str]:
    """Yield messages on values of a profile that contradict each other or that no box has."""
    rate_hz, loop_hz = values["netft.rate_hz"], values["rig.rate_hz"]
    box_rate_hz = achieved_rate_hz(rate_hz)
    if abs(box_rate_hz - rate_hz) > 0.5:
        yield (
            f"netft.rate_hz = {rate_hz:g} Hz is not 7000 Hz over a whole number; the box would "
            f"send {box_rate_hz:.6g}: write that."
        )
    if rate_hz < 2 * loop_hz and values["devices.drive"] != "sim":
        yield (
            f"netft.rate_hz = {rate_hz:g} Hz is below twice rig.rate_hz = {loop_hz:g} Hz; there "
            "would be ticks without a record: choose 7000."
        )
    if values["netft.filter_hz"] not in (0, values["sensor.filter_hz"]):
        yield (
            f"netft.filter_hz = {values['netft.filter_hz']} Hz delays the torque; state it as "
            "sensor.filter_hz, so that the analysis takes it into account, or choose 0."
        )
    if (values["netft.counts_per_n"] > 0) != (values["netft.counts_per_nm"] > 0):
        yield "netft.counts_per_n and netft.counts_per_nm go together; state both, or neither."
    if values.get("acquisition.mode", "same_tick") != "same_tick":
        yield 'acquisition.mode must be "same_tick" with a sensor that streams.'


def metadata(rig: RigParameters) -> dict[str, str]:
    """Return the box's settings as metadata for a session file."""
    settings = rig.settings_of(NetFtSettings)
    return {
        "netft_rate_hz": repr(settings.rate_hz),
        "netft_filter_hz": repr(settings.filter_hz),
        "netft_bias": settings.bias,
    }


def address(rig: RigParameters) -> str:
    """Return address and UDP port of the box, as a phrase."""
    settings = rig.settings_of(NetFtSettings)
    return f"{settings.host}, UDP port {settings.port}"


NETFT: Final = DeviceKind(
    name="netft",
    summary="ATI Net F/T box by RDT over UDP",
    open_sensor=open_sensor,
    settings=NetFtSettings,
    address=address,
    stream_hz=lambda rig: rig.settings_of(NetFtSettings).rate_hz,
    contradictions=contradictions,
    metadata=metadata,
)
"""Declaration of the device that profiles call ``netft``."""
