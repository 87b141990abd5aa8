"""The simulated rig: plant physics, and devices that show it to the loop."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
