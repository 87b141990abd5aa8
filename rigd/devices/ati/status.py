"""The status words of both sensors in words, and which of their bits forbid measuring.

Sources: devices.md 1.1 for NETCANOEM and 2.1 for Digital F/T. They differ in bits 9, 10 and 13.
"""

CAN_WATCHDOG_RESET = 0x0001
CAN_BAD_CALIBRATION = 0x0040
CAN_BUS_ERROR = 0x4000

_COMMON_WORDS = {
    0: "its watchdog has reset the board",
    1: "the gauges' excitation is too high",
    2: "the gauges' excitation is too low",
    3: "its artificial analogue ground is out of range",
    4: "its supply voltage is too high",
    5: "its supply voltage is too low",
    7: "its memory (EEPROM) has failed",
    8: "its configuration is invalid",
}
_CAN_WORDS = {
    **_COMMON_WORDS,
    6: "the active calibration is bad",
    11: "the sensor is too hot",
    12: "the sensor is too cold",
    14: "it has seen errors on the CAN bus",
}
CAN_CRITICAL = 0x18FE
"""Bits 1 to 7, 11 and 12."""

_SERIAL_WORDS = {
    **_COMMON_WORDS,
    9: "the bridges take too much current (broken gauge or cable)",
    10: "the bridges take too little current (broken gauge or cable)",
    11: "the reading of its thermistor is too high",
    12: "the reading of its thermistor is too low",
    13: "the reading of its analogue output is out of range",
}
SERIAL_CRITICAL = 0x3EBE
"""Bits 1 to 5, 7 and 9 to 13: what is critical on NETCANOEM, and the bits only this one has."""


def can_status(word: int) -> list[str]:
    """Return what the status word of a NETCANOEM box says, one clause a bit."""
    # Bit 15 only sums up the others.
    return _words(word & 0x7FFF, _CAN_WORDS)


def serial_status(word: int) -> list[str]:
    """Return what the status word of a Digital F/T sensor says, one clause a bit."""
    return _words(word, _SERIAL_WORDS)


def _words(word: int, table: dict[int, str]) -> list[str]:
    return [
        table.get(bit, f"status bit {bit}, which has no known meaning, is set")
        for bit in range(16)
        if word >> bit & 1
    ]
