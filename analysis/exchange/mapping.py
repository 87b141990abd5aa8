"""Which channel of a file becomes which field of a session, in which unit: the user's word."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from analysis.exchange.errors import ExchangeError
from analysis.exchange.units import UNITS, factor, stated_unit

if TYPE_CHECKING:
    from collections.abc import Mapping

QUANTITIES: Final[Mapping[str, str]] = MappingProxyType(
    {
        "angle_reference_rad": "angle",
        "angle_rad": "angle",
        "torque_command_nm": "torque",
        "coupling_torque_nm": "torque",
        "fx_n": "force",
        "fy_n": "force",
        "fz_n": "force",
        "tx_nm": "torque",
        "ty_nm": "torque",
        "tz_nm": "torque",
    }
)
"""Field of a sample → what is measured there."""


@dataclass(frozen=True, slots=True)
class ChannelChoice:
    """A channel of the file and the unit of its numbers.

    Attributes
    ----------
    channel : str
        Its name in the file.
    unit : str
        As `analysis.exchange.units.UNITS` spells it, after a number if one was stated.
    factor : float
        Size of that unit in rad, N·m, N or s.
    """

    channel: str
    unit: str
    factor: float

    def __str__(self) -> str:
        return f"{self.channel}:{self.unit}"


def parse_choice(text: str, quantity: str) -> ChannelChoice:
    """Take ``CHANNEL:UNIT`` apart; the last colon counts.

    Parameters
    ----------
    text : str
        Such as ``Motor/Angle:deg``.
    quantity : {"angle", "torque", "force", "time"}

    Raises
    ------
    ExchangeError
        If the unit is missing or unknown, or there is no name before it.
    """
    channel, colon, unit = text.rpartition(":")
    if not colon or not channel.strip():
        raise ExchangeError(
            f"'{text}' does not say channel and unit; write CHANNEL:UNIT with one of the units "
            f"{', '.join(UNITS[quantity])}. A unit is never guessed."
        )
    size = factor(quantity, unit)
    return ChannelChoice(channel.strip(), stated_unit(unit), size)
