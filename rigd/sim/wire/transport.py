"""Which part of a profile's delays the exchange itself makes, and which is left to simulate."""

from dataclasses import replace

from rigd.devices.contracts import DeviceError
from rigd.devices.parameters import RigParameters


def without_transport(rig: RigParameters) -> RigParameters:
    """Return the rig with the delays that are left to simulate behind the wire.

    With replies taken a tick later the exchange itself brings one period of what the profile
    states; the decimating filter's delay is seen to by :class:`rigd.sim.devices.SimulatedRig`.

    Raises
    ------
    DeviceError
        If the profile states less than the exchange takes.
    """
    if rig.acquisition is None or rig.acquisition.mode == "same_tick":
        return rig
    period_s = 1 / rig.rate_hz
    for name, delay_s in (("encoder", rig.encoder.delay_s), ("sensor", rig.sensor.delay_s)):
        if delay_s < period_s * (1 - 1e-9):
            raise DeviceError(
                f"The profile {rig.name} has {name}.delay_s = {delay_s:g} s, but with "
                f"acquisition.mode previous_tick values are at least one period old "
                f"({period_s:g} s); correct one of the two."
            )
    return replace(
        rig,
        encoder=replace(rig.encoder, delay_s=max(0.0, rig.encoder.delay_s - period_s)),
        sensor=replace(rig.sensor, delay_s=max(0.0, rig.sensor.delay_s - period_s)),
    )
