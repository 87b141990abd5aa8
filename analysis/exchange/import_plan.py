"""What the user says of a file that is to be imported."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping

    from analysis.exchange.mapping import ChannelChoice
    from analysis.exchange.specimen import Specimen

REQUIRED: Final = ("angle_rad", "coupling_torque_nm")
"""Fields of a sample without which nothing can be analysed."""


@dataclass(frozen=True, slots=True)
class ImportPlan:
    """Channels, units and circumstances; nothing of it is guessed.

    Attributes
    ----------
    channels : mapping of str to ChannelChoice
        Field of a sample (`analysis.exchange.mapping.QUANTITIES`) → channel and unit; those of
        `REQUIRED` must be among them.
    specimen : Specimen
    time : ChannelChoice, optional
        Channel with the time of each sample.
    rate_hz : float, optional
        Samples per second of a record without gaps; this or `time`.
    segments_s : mapping of str to (float, float)
        Name (rest, sweep, ring_down) → begin and end in s after the first sample.
    angle_delay_s, torque_delay_s : float
        Age of either value at its time stamp.
    reverse_torque : bool
        Whether the coupling torque counts against the angle's sense, as a reaction does.
    note, label, operator : str
        From the operator; the label is what they call the specimen.
    """

    channels: Mapping[str, ChannelChoice]
    specimen: Specimen
    time: ChannelChoice | None = None
    rate_hz: float | None = None
    segments_s: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    angle_delay_s: float = 0.0
    torque_delay_s: float = 0.0
    reverse_torque: bool = False
    note: str = ""
    label: str = ""
    operator: str = ""

    def __post_init__(self) -> None:
        if any(name not in self.channels for name in REQUIRED):
            raise ValueError(f"a plan needs channels for {' and '.join(REQUIRED)}")
        if (self.time is None) == (self.rate_hz is None):
            raise ValueError("a plan needs either a channel of times or a rate")

    @property
    def choices(self) -> tuple[ChannelChoice, ...]:
        """Every channel that is to be read."""
        return (*self.channels.values(), *(() if self.time is None else (self.time,)))
