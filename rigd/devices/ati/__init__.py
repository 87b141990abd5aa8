"""ATI force-torque sensors: the NETCANOEM box on CAN, and Digital F/T on a serial line.

Offers the two drivers (`AtiCanSensor`, `AtiSerialSensor`). Both sensors send raw gauge counts; the
wrench is computed here with the calibration read from the sensor. Neither tares: the engine does
that, in floating point, on wrenches.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
