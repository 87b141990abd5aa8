from .can_sensor import AtiCanSensor as AtiCanSensor
from .serial_protocol import RECORD_BITS as RECORD_BITS
from .serial_sensor import AtiSerialSensor as AtiSerialSensor
