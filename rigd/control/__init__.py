"""The motor's controller and its closed loop.

Offers the design by pole placement (`design_pid`), the discrete controller of the loop
(`PidController`, one step per tick), the linear closed loop of rig and controller (`close_loop`,
`check_stability`) and its margins (`loop_margins`). It accesses no device and checks no limit:
limits are in `rigd.safety`.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
