"""RDT, the box's protocol on UDP: requests, records, status words."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from struct import Struct
from typing import Final, Literal

RDT_PORT: Final = 49152
"""UDP port of the box."""
COUNTER_HZ: Final = 7000.0
"""Rate in Hz of the counter that a Net F/T box writes into its records."""
STOP_REQUEST, STREAM_REQUEST = (
    bytes.fromhex("12340000 00000000"),
    bytes.fromhex("12340002 00000000"),
)
"""Requests to end the stream, and to start it without an end.

They consist of header, command and number of records, of which 0 means endless."""
RECORD_LAYOUT: Final = Struct(">IIIiiiiii")
"""Layout of a record: sequence number, box's counter, status word, counts of fx to tz."""

ANY_ERROR_BIT, THRESHOLD_BIT = 1 << 31, 1 << 16
"""Bits of a status word that are no fault.

The first is set if any other bit is set, the second while a threshold is latched."""


@dataclass(frozen=True, slots=True)
class BoxKind:
    """Kind of box, with the meaning of its status word."""

    device: str
    """Name of the kind."""
    saturation_bits: int
    """Mask of the status bits that mean that a value is out of range."""
    bit_meanings: Mapping[int, str]
    """Meaning of each status bit, by bit number."""

    def status_texts(self, status_word: int) -> list[str]:
        """Return the meanings of the bits that are set in a status word, highest bit first."""
        set_bits = (bit for bit in range(30, -1, -1) if status_word >> bit & 1)
        return [self.bit_meanings.get(bit, f"bit {bit}") for bit in set_bits]


NETFT: Final = BoxKind("Net F/T", 1 << 17, {
    30: "processor or memory", 29: "digital board", 28: "analog board", 27: "serial link",
    26: "program memory", 25: "halted by its configuration", 24: "invalid settings",
    23: "configuration and calibration do not match", 22: "network", 21: "CAN", 20: "RDT",
    19: "EtherNet/IP", 18: "DeviceNet", 17: "transducer saturated or A/D error",
    16: "a monitor condition is latched", 14: "watchdog", 13: "stack", 12: "EEPROM", 11: "flash",
    10: "analog watchdog", 9: "gauge excitation too high", 8: "gauge excitation too low",
    7: "artificial ground", 6: "analog supply too high", 5: "analog supply too low",
    4: "no data on the serial link", 3: "reference or power", 2: "temperature", 1: "HTTP",
})  # fmt: skip
AXIA: Final = BoxKind("Axia", 1 << 27 | 1 << 30, {
    0: "temperature", 1: "supply voltage", 2: "broken gauge", 3: "busy", 27: "gauge out of range",
    29: "calibration checksum", 30: "force or torque out of range",
})  # fmt: skip

FORCE_UNITS_N: Final = {
    "lbf": 4.4482216152605, "n": 1.0, "klbf": 4448.2216152605, "kn": 1000.0, "kgf": 9.80665,
    "gf": 9.80665e-3,
}  # fmt: skip
"""Units of force that a box can use, in N, by name without punctuation."""
TORQUE_UNITS_NM: Final = {
    "lbfin": 0.1129848290276, "lbin": 0.1129848290276, "lbfft": 1.3558179483314,
    "lbft": 1.3558179483314, "nm": 1.0, "nmm": 1e-3, "kgfcm": 0.0980665, "knm": 1000.0,
}  # fmt: skip
"""Units of torque that a box can use, in N·m, by name without punctuation."""

CutOffHz = Literal[0, 838, 326, 152, 73, 35, 18, 8, 5, 1500, 2000, 2500, 3000]
"""Cut-off frequency in Hz of the box's low-pass filter; 0: no filter.

The position in this list is the number by which the box selects the filter."""


def unit_key(unit_name: str) -> str:
    """Convert a unit's name on the page to its key in `FORCE_UNITS_N` or `TORQUE_UNITS_NM`."""
    return re.sub(r"[^a-z]", "", unit_name.lower())


def counter_difference(later_count: int, earlier_count: int) -> int:
    """Return `later_count` minus `earlier_count` for 32-bit counters that wrap around."""
    return (later_count - earlier_count + 0x80000000 & 0xFFFFFFFF) - 0x80000000


def achieved_rate_hz(requested_rate_hz: float) -> float:
    """Return the rate in Hz that a box uses if a rate is requested: 7000 Hz over an integer.

    It is the lowest such rate that is not below `requested_rate_hz`.
    """
    return COUNTER_HZ / max(1, int(COUNTER_HZ / requested_rate_hz + 1e-9))
