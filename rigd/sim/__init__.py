"""Simulated rig: physics of the plant, and simulated drive and sensor for the control loop.

`SimulatedPlant` is the plant: motor, clamp, beam and air, stepped exactly between ticks.
`SimulatedRig` adds the drive and the sensor to the plant, and runs inside the control process. The
package `wire` runs the same rig in a separate process, behind a CAN bus and a serial line. This
package does not depend on the controller or on sessions.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
