"""``rigd bench``: latency of the loop on this computer, and the highest rate that it can hold.

The package offers the series of measurements (`Bench`), their results (`BenchResults`), one
measurement and its percentiles (module `measure`), and the report (`report_lines`, `as_json`).
Sessions run on a simulated rig, with cyclictest as the reference. No hardware is used, and no
setting of the computer is changed.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
