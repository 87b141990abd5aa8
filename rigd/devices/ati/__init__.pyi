from ._can_sensor import AtiCanSensor as AtiCanSensor
from ._serial_protocol import RECORD_BITS as RECORD_BITS
from ._serial_sensor import AtiSerialSensor as AtiSerialSensor
