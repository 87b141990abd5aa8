"""A CiA 402 servo drive over CANopen, in cyclic synchronous torque mode."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
