"""ATI force-torque sensors: the NETCANOEM box on CAN, and Digital F/T on a serial line.

The package offers two drivers, `AtiCanSensor` and `AtiSerialSensor`. Both sensors send raw gauge
counts; the drivers compute the wrench with the calibration read from the sensor. The drivers apply
no tare: the engine subtracts the tare from the wrenches, in floating point.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
