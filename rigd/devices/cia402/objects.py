"""Object dictionary indices that the driver uses, and constants of the objects' values.

Indices and meanings: CiA 301 (1xxx) and CiA 402 (6xxx), as vendors' manuals document them. The
types are in ``drive.eds``, with which the canopen library encodes them.
"""

from typing import Final

SYNC_COB_ID: Final = 0x1005
"""Index of the CAN identifier of SYNC."""
SYNC_PERIOD_US: Final = 0x1006
"""Index of the SYNC period (communication cycle period) in microseconds."""
SYNC_WINDOW_US: Final = 0x1007
"""Index of the synchronous window length in microseconds."""
DEVICE_NAME: Final = 0x1008
"""Index of the manufacturer's device name, a text."""
SOFTWARE_VERSION: Final = 0x100A
"""Index of the manufacturer's software version, a text."""
EMERGENCY_COB_ID: Final = 0x1014
"""Index of the CAN identifier of emergency messages."""
HEARTBEAT_CONSUMER: Final = 0x1016
"""Index of the consumer heartbeat time.

Each sub-index from 1 on: monitored node in bits 23 to 16, its timeout in milliseconds in bits 15 to
0."""
HEARTBEAT_PRODUCER_MS: Final = 0x1017
"""Index of the producer heartbeat time in milliseconds."""
IDENTITY: Final = 0x1018
"""Index of the identity; sub-indices 1 to 4: vendor, product code, revision, serial number."""
SYNC_OVERFLOW: Final = 0x1019
"""Index of the largest value of the counter in SYNC; 0 means that SYNC carries no counter."""
COMMUNICATION_ERROR: Final = 0x1029
"""Index of the drive's behaviour on communication errors."""
RPDO_COMMUNICATION: Final = 0x1400
"""Index of the communication parameters of RPDO1; the n-th RPDO has the index n - 1 higher."""
RPDO_MAPPING: Final = 0x1600
"""Index of the mapping of RPDO1; the n-th RPDO has the index n - 1 higher."""
TPDO_COMMUNICATION: Final = 0x1800
"""Index of the communication parameters of TPDO1; the n-th TPDO has the index n - 1 higher."""
TPDO_MAPPING: Final = 0x1A00
"""Index of the mapping of TPDO1; the n-th TPDO has the index n - 1 higher."""
INHIBIT_TIME_SUBINDEX: Final = 3
"""Sub-index of a PDO's inhibit time, in units of 100 µs."""
EVENT_TIMER_SUBINDEX: Final = 5
"""Sub-index of a PDO's event timer in milliseconds; for an RPDO it is the deadline of the next
RPDO."""
ABORT_OPTION: Final = 0x6007
"""Index of the abort connection option code."""
ERROR_CODE: Final = 0x603F
"""Index of the drive's last error code."""
CONTROLWORD: Final = 0x6040
"""Index of the controlword."""
STATUSWORD: Final = 0x6041
"""Index of the statusword."""
QUICK_STOP_OPTION: Final = 0x605A
"""Index of the quick stop option code."""
FAULT_REACTION_OPTION: Final = 0x605E
"""Index of the fault reaction option code."""
MODE: Final = 0x6060
"""Index of the commanded mode of operation."""
MODE_DISPLAY: Final = 0x6061
"""Index of the active mode of operation."""
POSITION: Final = 0x6064
"""Index of the actual position in encoder counts."""
TARGET_TORQUE: Final = 0x6071
"""Index of the target torque in 1/1000 of the rated torque."""
MAX_TORQUE: Final = 0x6072
"""Index of the torque limit in 1/1000 of the rated torque."""
RATED_TORQUE: Final = 0x6076
"""Index of the motor's rated torque, whose unit depends on the drive."""
TORQUE_OFFSET: Final = 0x60B2
"""Index of the offset that the drive adds to the target torque, in 1/1000 of the rated torque."""
TORQUE_LIMITS: Final[tuple[int, ...]] = (0x60E0, 0x60E1)
"""Indices of the torque limits for positive and negative torque."""
ACTUAL_TORQUE: Final = 0x6077
"""Index of the actual torque in 1/1000 of the rated torque."""
POLARITY: Final = 0x607E
"""Index of the polarity: bit 7 reverses the position, bit 6 the speed, bit 5 the torque."""
MAX_SPEED_RPM: Final = 0x6080
"""Index of the motor's speed limit in revolutions per minute."""
ENCODER_RESOLUTION: Final = 0x608F
"""Index of the encoder resolution; sub 1: encoder increments; sub 2: in how many motor
revolutions."""
GEAR_RATIO: Final = 0x6091
"""Index of the gear ratio; sub 1: motor revolutions; sub 2: in how many output shaft
revolutions."""
FEED_CONSTANT: Final = 0x6092
"""Index of the feed constant; sub 1: position units; sub 2: in how many output shaft
revolutions."""
INTERPOLATION_TIME: Final = 0x60C2
"""Index of the interpolation time period; sub 1: value; sub 2: power of ten of its unit in
seconds."""
SUPPORTED_MODES: Final = 0x6502
"""Index of the bits for the modes of operation that the drive supports."""

CYCLIC_TORQUE_MODE: Final = 10
"""Number of the cyclic synchronous torque mode, for objects 6060 and 6061."""
CYCLIC_TORQUE_MODE_BIT: Final = 0x200
"""Bit in object 6502 that means that the drive supports the cyclic synchronous torque mode."""
PDO_DISABLED_BIT: Final = 0x8000_0000
"""Bit in the COB-ID of a PDO that means that the PDO is disabled."""
NO_REMOTE_REQUEST_BIT: Final = 0x4000_0000
"""Bit in the COB-ID of a TPDO that forbids remote requests; drives may set it by themselves."""
SYNC_CAN_ID: Final = 0x080
"""CAN identifier of SYNC."""
PREDEFINED_PDO_COUNT: Final = 4
"""Number of RPDOs, and of TPDOs, whose CAN identifiers CiA 301 predefines."""
MAX_PDO_COUNT: Final = 512
"""Largest number of RPDOs, and of TPDOs, that a drive can have."""

TRANSMISSION_AT_EVERY_SYNC: Final = 1
"""Transmission type of a PDO that is sent or applied at every SYNC."""
TRANSMISSION_ON_ARRIVAL: Final = 255
"""Transmission type of a PDO that is event-driven: an RPDO is applied when it arrives."""


def mapping_entry(index: int, length_bit: int) -> int:
    """Return the PDO mapping entry, an integer, of an object without sub-indices.

    Parameters
    ----------
    index
        Index of the object.
    length_bit
        Size of the object in bits.
    """
    return index << 16 | length_bit


TPDO_ENTRIES: Final[tuple[int, ...]] = (
    mapping_entry(STATUSWORD, 16),
    mapping_entry(POSITION, 32),
    mapping_entry(ACTUAL_TORQUE, 16),
)
"""Mapping entries of the TPDO: statusword, actual position, actual torque."""
RPDO_ENTRIES: Final[tuple[int, ...]] = (
    mapping_entry(CONTROLWORD, 16),
    mapping_entry(TARGET_TORQUE, 16),
)
"""Mapping entries of the RPDO: controlword, target torque."""
