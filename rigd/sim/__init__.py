"""Simulated rig: physics of the plant, and simulated drive and sensor for the control loop.

`SimulatedPlant` is the plant: motor, clamp, beam and air, stepped exactly between ticks.
`SimulatedRig` is the plant with drive and sensor, in the process of the loop. The package `wire`
runs the same rig in a process of its own, on a CAN bus and a serial line. This package does not
depend on controller and sessions.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
