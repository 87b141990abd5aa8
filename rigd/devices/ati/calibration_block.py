"""Where a Digital F/T sensor keeps a calibration among its registers."""

from collections.abc import Sequence
from dataclasses import dataclass
from struct import pack, unpack

from rigd.devices.ati.calibration import Calibration, text_of

BLOCK_REGISTERS = 133
"""Of a block, as far as the driver needs it."""

_FIRST_BLOCK = 0x00E3
_BLOCK_SPACING = 192


@dataclass(frozen=True, slots=True)
class CalibrationBlock:
    """A calibration, and the amplifier settings that belong to it."""

    calibration: Calibration
    gains: tuple[int, ...]
    """Of gauges 0 to 5, as register values."""
    offsets: tuple[int, ...]


def first_register(number: int) -> int:
    """Return where block ``number`` (1 to 16) begins."""
    return _FIRST_BLOCK + (number - 1) * _BLOCK_SPACING


def parse_block(registers: Sequence[int]) -> CalibrationBlock:
    """Read a block.

    Raises
    ------
    ValueError
        If no wrench can be computed with it; the message is a sentence for the operator.
    """
    raw = pack(f">{BLOCK_REGISTERS}H", *registers)

    def part(first: int, count: int) -> bytes:
        return raw[2 * first : 2 * (first + count)]

    entries = unpack(">36f", part(32, 72))
    counts_per_force, counts_per_torque = unpack(">ii", part(117, 4))
    calibration = Calibration(
        serial_number=text_of(part(0, 4)),
        part_number=text_of(part(4, 16)),
        family=text_of(part(20, 2)),
        date=text_of(part(22, 10)),
        matrix=tuple(tuple(entries[6 * axis : 6 * axis + 6]) for axis in range(6)),
        force_unit=registers[104] >> 8,
        torque_unit=registers[104] & 0xFF,
        ratings=unpack(">6f", part(105, 12)),
        counts_per_force=counts_per_force,
        counts_per_torque=counts_per_torque,
    )
    return CalibrationBlock(
        calibration=calibration,
        gains=unpack(">6H", part(121, 6)),
        offsets=unpack(">6H", part(127, 6)),
    )
