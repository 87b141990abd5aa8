"""Limits and interlocks: what ends a session, what warns, and what the operator is told.

Offers the table of interlocks (`INTERLOCKS`), the levels of a profile (`Limits`), and the check of
every tick (`LimitWatch`), which the loop calls. The software stops a session that leaves its
limits; it is not a safety function. That is the wired STO of the drive (docs/safety.md).
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
