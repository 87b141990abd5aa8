"""The simulated rig on the wire: nodes that speak CANopen, NETCANOEM and Modbus RTU."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
