"""Object dictionary entries that the driver uses, and constants of their contents.

Indices and meanings: CiA 301 (1xxx) and CiA 402 (6xxx), as vendors' manuals document them. The
types are in ``drive.eds``, with which the canopen library encodes them.
"""

from typing import Final

SYNC_COB_ID: Final = 0x1005
SYNC_PERIOD_US: Final = 0x1006
SYNC_WINDOW_US: Final = 0x1007
DEVICE_NAME: Final = 0x1008
SOFTWARE_VERSION: Final = 0x100A
EMERGENCY_COB_ID: Final = 0x1014
HEARTBEAT_CONSUMER: Final = 0x1016
"""Sub 1: watched node in bits 23 to 16, its time-out in ms in bits 15 to 0."""
HEARTBEAT_PRODUCER_MS: Final = 0x1017
IDENTITY: Final = 0x1018
"""Sub 1 to 4: vendor, product code, revision, serial number."""
SYNC_OVERFLOW: Final = 0x1019
"""Largest value of the counter in SYNC; 0: SYNC carries none."""
COMMUNICATION_ERROR: Final = 0x1029
RPDO_COMMUNICATION: Final = 0x1400
RPDO_MAPPING: Final = 0x1600
TPDO_COMMUNICATION: Final = 0x1800
TPDO_MAPPING: Final = 0x1A00
"""Objects of the first PDO; those of the n-th have indices n - 1 higher."""
INHIBIT_TIME: Final = 3
EVENT_TIMER: Final = 5
"""Sub-indices of a PDO's communication parameters, in 100 µs and in ms; of an RPDO the event timer
is the deadline of the next one."""
ABORT_OPTION: Final = 0x6007
ERROR_CODE: Final = 0x603F
CONTROLWORD: Final = 0x6040
STATUSWORD: Final = 0x6041
QUICK_STOP_OPTION: Final = 0x605A
FAULT_REACTION_OPTION: Final = 0x605E
MODE: Final = 0x6060
MODE_DISPLAY: Final = 0x6061
POSITION: Final = 0x6064
TARGET_TORQUE: Final = 0x6071
MAX_TORQUE: Final = 0x6072
RATED_TORQUE: Final = 0x6076
TORQUE_OFFSET: Final = 0x60B2
TORQUE_LIMITS: Final[tuple[int, ...]] = (0x60E0, 0x60E1)
"""Largest torque forwards and backwards."""
ACTUAL_TORQUE: Final = 0x6077
POLARITY: Final = 0x607E
"""Bit 7 turns the position round, bit 6 the speed, bit 5 the torque."""
MAX_SPEED_RPM: Final = 0x6080
"""Highest speed of the motor."""
ENCODER_RESOLUTION: Final = 0x608F
"""Sub 1: increments of the position encoder; sub 2: in so many turns of the motor."""
GEAR_RATIO: Final = 0x6091
"""Sub 1: turns of the motor; sub 2: in so many turns of the output shaft."""
FEED_CONSTANT: Final = 0x6092
"""Sub 1: units of the position; sub 2: in so many turns of the output shaft."""
INTERPOLATION_TIME: Final = 0x60C2
"""Sub 1: value; sub 2: power of ten of its unit in s."""
SUPPORTED_MODES: Final = 0x6502

CYCLIC_TORQUE: Final = 10
"""Cyclic synchronous torque mode, in 6060 and 6061."""
SUPPORTS_CYCLIC_TORQUE: Final = 0x200
"""Its bit in 6502."""
PDO_DISABLED: Final = 0x8000_0000
"""Bit in the COB-ID of a PDO: it is disabled."""
NO_REMOTE_REQUEST: Final = 0x4000_0000
"""Bit in the COB-ID of a TPDO: no remote request allowed. Drives are free to set it."""
SYNC_ID: Final = 0x080
PDO_COUNT: Final = 4
"""Pairs of PDOs with identifiers that CiA 301 sets beforehand."""
PDO_COUNT_AT_MOST: Final = 512

AT_EVERY_SYNC: Final = 1
ON_ARRIVAL: Final = 255
"""Transmission types of a PDO."""


def mapping_entry(index: int, bits: int) -> int:
    """Return the mapping entry of an object without sub-indices.

    Parameters
    ----------
    index
        Index of the object.
    bits
        Its size.
    """
    return index << 16 | bits


TPDO_ENTRIES: Final[tuple[int, ...]] = (
    mapping_entry(STATUSWORD, 16),
    mapping_entry(POSITION, 32),
    mapping_entry(ACTUAL_TORQUE, 16),
)
RPDO_ENTRIES: Final[tuple[int, ...]] = (
    mapping_entry(CONTROLWORD, 16),
    mapping_entry(TARGET_TORQUE, 16),
)
