"""Devices that the loop talks to: contracts, their parameters, and the registry of drivers.

Offers the opening of the devices that a profile names (`open_devices`), and what will move: the
hardware or a simulation (`actuation_target`).

Public modules: `contracts` (`Devices`, `WrenchSensor`, `DeviceError`), `parameters`
(`RigParameters`), `running_simulator` (the address of ``rigd simulate``), `obstacles` and `eds`
(EDS files). The drivers are in `canbus`, `cia402` and `ati`, the simulated devices in `rigd.sim`.
Nothing here knows of sessions, limits or the controller.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
