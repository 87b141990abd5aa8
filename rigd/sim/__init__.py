"""The simulated rig: plant physics, and devices that show it to the loop.

Offers the plant (`SimulatedPlant`: motor, clamp, beam and air, stepped exactly between ticks) and
drive and sensor on it (`SimulatedRig`), in the loop's own process. The same rig as a process of its
own, behind CAN and a serial line, is in `wire`. It knows neither controller nor sessions.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
