"""Devices that the loop talks to: contracts, their parameters, and the registry of drivers.

Offers the contracts (`Devices`, `WrenchSensor`, `DeviceError`), a rig's parameters
(`RigParameters`), the opening of what a profile names (`open_devices`), a running simulation of it
(`find_simulator`) and EDS files (`read_eds`). The drivers are in `canbus`, `cia402` and `ati`, the
simulated devices in `rigd.sim`. Nothing here knows of sessions, limits or the controller.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
