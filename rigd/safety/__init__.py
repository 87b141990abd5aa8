"""Limits and interlocks: end of a session, warnings, and messages to the operator.

Offers the checks of every tick, which the loop calls (`LimitMonitor`, `EncoderMonitor`,
`SensorMonitor`). Public modules: `limits` (the table of interlocks, the levels of a profile),
`probing_move` and `probe_estimate` (the small move that verifies scales and signs before a
session). The software stops a session that leaves its limits; it is not a safety function. That is
the wired STO of the drive (docs/safety.md).
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
