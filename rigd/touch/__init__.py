"""Touch: whether, where and how hard the beam has met something, from its torque and base shear.

Offers the innovations of the free beam (`free_beam`, `InnovationFilter`), which the control loop
computes tick by tick, and the sequential test on them (`TouchDetector`). It knows of no rig and no
file.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
