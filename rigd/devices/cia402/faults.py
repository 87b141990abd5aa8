"""Error codes of emergency messages and of object 603F, in words."""

from typing import Final

# Most digits first. Classes: CiA 301; single codes: those on which vendors' manuals agree.
_WORDS: Final = (
    (0xFFFF, 0x3210, "over-voltage in the DC link"),
    (0xFFFF, 0x3220, "under-voltage in the DC link"),
    (0xFFFF, 0x4210, "the device is too hot"),
    (0xFFFF, 0x4310, "the power stage or the motor is too hot"),
    (0xFFFF, 0x8110, "CAN messages were lost (overrun)"),
    (0xFFFF, 0x8120, "its CAN controller is error-passive"),
    (0xFFFF, 0x8130, "heartbeat of this computer lost"),
    (0xFFFF, 0x8140, "it had been off the bus"),
    (0xFFFF, 0x8210, "PDO too short"),
    (0xFFFF, 0x8220, "PDO too long"),
    (0xFFFF, 0x8611, "following error"),
    (0xFF00, 0x0000, "no error"),
    (0xFF00, 0x1000, "generic error"),
    (0xFF00, 0x2100, "current at the input"),
    (0xFF00, 0x2200, "current inside the device"),
    (0xFF00, 0x2300, "current at the output"),
    (0xF000, 0x2000, "current"),
    (0xFF00, 0x3100, "mains voltage"),
    (0xFF00, 0x3200, "voltage inside the device"),
    (0xFF00, 0x3300, "voltage at the output"),
    (0xF000, 0x3000, "voltage"),
    (0xFF00, 0x4100, "ambient temperature"),
    (0xFF00, 0x4200, "temperature of the device"),
    (0xF000, 0x4000, "temperature"),
    (0xF000, 0x5000, "hardware of the device"),
    (0xFF00, 0x6100, "internal software"),
    (0xFF00, 0x6200, "user's software"),
    (0xFF00, 0x6300, "parameters"),
    (0xF000, 0x6000, "software"),
    (0xFF00, 0x7300, "encoder or other position sensor"),
    (0xF000, 0x7000, "additional module"),
    (0xFF00, 0x8100, "communication"),
    (0xFF00, 0x8200, "protocol"),
    (0xF000, 0x8000, "monitoring"),
    (0xF000, 0x9000, "external error"),
    (0xFF00, 0xFF00, "particular to the device: see its manual"),
    (0xF000, 0xF000, "additional function"),
)


def describe_error(code: int) -> str:
    """Return an error code of 16 bits in words, with the code."""
    for mask, value, words in _WORDS:
        if code & mask == value:
            return f"{words} (error code 0x{code:04X})"
    return f"error code 0x{code:04X}"
