"""RDT, the box's protocol over UDP: requests, records, status words."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from struct import Struct
from typing import Final, Literal

PORT: Final = 49152
"""UDP port of the box."""
INTERNAL_HZ: Final = 7000.0
"""Rate of the Net F/T box's own counter in Hz."""
STOP, STREAM = bytes.fromhex("12340000 00000000"), bytes.fromhex("12340002 00000000")
"""Requests to end the stream and to start it in real time: header, command, number of records (0:
endless)."""
RECORD: Final = Struct(">IIIiiiiii")
"""Record: RDT sequence, box's counter, status word, then the counts of fx, fy, fz, tx, ty, tz."""

ANY_ERROR, THRESHOLD = 1 << 31, 1 << 16
"""Bits of a status word that are no fault: set with every other one; a latched threshold."""


@dataclass(frozen=True, slots=True)
class BoxKind:
    """Kind of box, with the meaning of its status word."""

    device: str
    """Name of the kind."""
    saturated: int
    """Bits for a value out of range."""
    bits: Mapping[int, str]
    """Meaning of each bit."""

    def status_texts(self, word: int) -> list[str]:
        """Return the meaning of each bit of a status word that is set."""
        set_bits = (bit for bit in range(30, -1, -1) if word >> bit & 1)
        return [self.bits.get(bit, f"bit {bit}") for bit in set_bits]


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

NEWTONS: Final = {
    "lbf": 4.4482216152605, "n": 1.0, "klbf": 4448.2216152605, "kn": 1000.0, "kgf": 9.80665,
    "gf": 9.80665e-3,
}  # fmt: skip
"""Units of force that a box can have, in N."""
NEWTON_METRES: Final = {
    "lbfin": 0.1129848290276, "lbin": 0.1129848290276, "lbfft": 1.3558179483314,
    "lbft": 1.3558179483314, "nm": 1.0, "nmm": 1e-3, "kgfcm": 0.0980665, "knm": 1000.0,
}  # fmt: skip
"""Units of torque that a box can have, in N·m, without the characters between their parts."""

CutOffHz = Literal[0, 838, 326, 152, 73, 35, 18, 8, 5, 1500, 2000, 2500, 3000]
"""Cut-off in Hz of the box's low-pass filter, in the order of their numbers; 0: no filter."""


def unit_key(name: str) -> str:
    """Return the key of a unit in `NEWTONS` or `NEWTON_METRES`, from its name on the page."""
    return re.sub(r"[^a-z]", "", name.lower())


def difference(later: int, earlier: int) -> int:
    """Return the signed difference of two counters of 32 bits, which wrap around."""
    return (later - earlier + 0x80000000 & 0xFFFFFFFF) - 0x80000000


def rate_reached_hz(requested_hz: float) -> float:
    """Return the rate in Hz that a box takes for a requested one: its own over a whole number."""
    return INTERNAL_HZ / max(1, int(INTERNAL_HZ / requested_hz + 1e-9))
