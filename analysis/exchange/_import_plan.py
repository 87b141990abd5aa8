"""User's statements on a measurement that is imported."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping

    from analysis.exchange._channels import ChannelChoice
    from analysis.exchange._specimen import SpecimenFile

REQUIRED_FIELDS: Final = ("angle_rad", "coupling_torque_nm")
"""Fields of a sample that every analysis needs."""


@dataclass(frozen=True, slots=True)
class ImportPlan:
    """User's statements on channels, units and circumstances of a record to be imported.

    Attributes
    ----------
    channels : mapping of str to ChannelChoice
        Channel and unit for each field of a sample (key of `analysis.exchange.QUANTITIES`). The
        fields in `REQUIRED_FIELDS` must be present.
    specimen : SpecimenFile
        Beam and clamp.
    time : ChannelChoice, optional
        Channel with the time of each sample.
    rate_hz : float, optional
        Sampling rate of a record without gaps; required if `time` is not given.
    segments_s : mapping of str to (float, float)
        Start and end, in seconds after the first sample, by the segment's name: rest, sweep or
        ring_down.
    angle_delay_s, torque_delay_s : float
        Time by which the angle and the torque lag their time stamps.
    reverse_torque : bool
        Whether the sign of the coupling torque is reversed, because the sensor measures the
        reaction.
    note, specimen_label, operator : str
        Note, label of the specimen, and name of the operator.
    ignore_file_metadata : bool
        Whether the plan overrides the file's rate, times, start, units and scale.
    """

    channels: Mapping[str, ChannelChoice]
    specimen: SpecimenFile
    time: ChannelChoice | None = None
    rate_hz: float | None = None
    segments_s: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    angle_delay_s: float = 0.0
    torque_delay_s: float = 0.0
    reverse_torque: bool = False
    note: str = ""
    specimen_label: str = ""
    operator: str = ""
    ignore_file_metadata: bool = False

    def __post_init__(self) -> None:
        if any(name not in self.channels for name in REQUIRED_FIELDS):
            raise ValueError(f"a plan needs channels for {' and '.join(REQUIRED_FIELDS)}")
        if (self.time is None) == (self.rate_hz is None):
            raise ValueError("a plan needs either a channel of times or a rate")

    @property
    def channel_choices(self) -> tuple[ChannelChoice, ...]:
        """Choices of all channels that are to be read."""
        return (*self.channels.values(), *(() if self.time is None else (self.time,)))
