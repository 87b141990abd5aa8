"""Devices that the control loop uses: contracts, their parameters, and the registry of drivers.

`open_devices` creates the drivers that a profile names. `actuation_target` states what will move:
the hardware or a simulation.

Public modules: `contracts` (`Devices`, `WrenchSensor`, `DeviceError`), `parameters`
(`RigParameters`), `running_simulator` (the address of ``rigd simulate``), `obstacles` and `eds`
(EDS files). The drivers are in `canbus`, `cia402` and `ati`, the simulated devices in `rigd.sim`.
This package does not depend on sessions, limits or the controller.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
