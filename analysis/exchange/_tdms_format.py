"""Channels of a LabVIEW TDMS file, by npTDMS."""

from __future__ import annotations

import logging
import struct
from typing import TYPE_CHECKING, Any, Final

from analysis.exchange._source import (
    ExchangeError,
    SourceChannel,
    as_column,
    bounded_memory,
    check_samples,
    missing_library,
    no_such_channel,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path
    from typing import BinaryIO

_MOST_ENTRIES: Final = 5_000_000
"""Most channels, counted again in each segment: npTDMS takes that many steps before it reads."""

_LEAD_IN: Final = 28
_HAS_METADATA, _NEW_LIST, _BIG_ENDIAN = 1 << 1, 1 << 2, 1 << 6


def read(path: Path, names: Sequence[str]) -> Mapping[str, SourceChannel]:
    """Read channels ``Group/Channel``, as `analysis.exchange._source.read_source` asks for.

    Scalings of the file are applied. The file is opened by itself, without the index that may lie
    beside it and may belong to another.
    """
    try:
        from nptdms import TdmsFile
        from nptdms.log import log_manager
    except ImportError as error:
        raise missing_library(path, "npTDMS") from error
    log_manager.set_level(logging.ERROR)  # what it warns of is told below
    try:
        with path.open("rb") as stream:
            _check_entries(path, stream)
            with bounded_memory(), TdmsFile.open(stream) as file:
                channels = {
                    f"{group.name}/{channel.name}": channel
                    for group in file.groups()
                    for channel in group.channels()
                }
                torn = file.file_status.incomplete_final_segment
                return {name: _channel(path, name, channels, torn) for name in names}
    except (ExchangeError, OSError, MemoryError):
        raise
    except Exception as error:  # npTDMS lets through whatever a damaged file provokes
        raise ExchangeError(
            f"{path}: is not a TDMS file, or is damaged ({error}); copy it again from where it was "
            "recorded."
        ) from error


def _check_entries(path: Path, stream: BinaryIO) -> None:
    """Refuse a file whose table of contents alone would take minutes or gigabytes to read."""
    size = path.stat().st_size
    place = channels = entries = 0
    while place + _LEAD_IN <= size and entries <= _MOST_ENTRIES:
        stream.seek(place)
        head = stream.read(_LEAD_IN + 4)
        contents = int.from_bytes(head[4:8], "little")
        order = ">" if contents & _BIG_ENDIAN else "<"
        (length,) = struct.unpack(f"{order}Q", head[12:20])
        if contents & _HAS_METADATA and len(head) == _LEAD_IN + 4:
            (listed,) = struct.unpack(f"{order}L", head[_LEAD_IN:])
            channels = listed if contents & _NEW_LIST else channels + listed
            entries += channels
        entries += 1
        place += _LEAD_IN + length
    stream.seek(0)
    if entries > _MOST_ENTRIES:
        raise ExchangeError(
            f"{path}: its segments list more than {_MOST_ENTRIES} channels in all, so it is "
            "damaged or no record of a few channels; export the session's channels alone."
        )


def _channel(path: Path, name: str, channels: Mapping[str, Any], torn: bool) -> SourceChannel:
    channel = channels.get(name)
    if channel is None:
        raise no_such_channel(path, name, channels)
    check_samples(path, f"The channel '{name}'", len(channel))
    return SourceChannel(
        as_column(path, name, channel[:]),
        unit_label=str(channel.properties.get("unit_string", "")),
        rate_hz=_rate_hz(channel.properties.get("wf_increment")),
        remark="The file's end is missing: its recording was cut off." if torn else "",
    )


def _rate_hz(increment_s: object) -> float | None:
    if not isinstance(increment_s, int | float) or not increment_s > 0:
        return None
    return 1 / increment_s
