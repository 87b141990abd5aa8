"""Channels of a LabVIEW TDMS file, by npTDMS."""

from __future__ import annotations

import logging
import math
import struct
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from analysis.exchange._source import (
    ExchangeError,
    FileTimes,
    SourceChannel,
    as_column,
    bounded_memory,
    check_samples,
    missing_library,
    no_such_channel,
)
from rigd.text_table.titles import is_title_of_times, time_unit_s

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path
    from typing import BinaryIO

_MOST_ENTRIES: Final = 5_000_000
"""Most channels, counted again in each segment: npTDMS takes that many steps before it reads."""

_EARLIEST: Final = np.datetime64("1980-01-01")
"""LabVIEW's own zero, in 1904, means that no start was given."""
_EARLIEST_NS: Final = int(_EARLIEST.astype("datetime64[ns]").astype(np.int64))

_LEAD_IN: Final = 28
_HAS_METADATA, _NEW_LIST, _BIG_ENDIAN = 1 << 1, 1 << 2, 1 << 6


def read(path: Path, names: Sequence[str]) -> Mapping[str, SourceChannel]:
    """Read channels ``Group/Channel``, as `analysis.exchange._source.read_source` asks for.

    Scalings of the file are applied; one that npTDMS does not know is reported with the channel,
    whose values are then raw. The file is opened by itself, without an index file in the same
    folder, which may belong to another.
    """
    try:
        from nptdms import TdmsFile
        from nptdms.log import log_manager
    except ImportError as error:
        raise missing_library(path, "npTDMS") from error
    log_manager.set_level(logging.ERROR)  # its warnings are reported below
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
                found = {name: _channel(path, name, channels, torn) for name in names}
                for name in names:
                    levels = (channels[name], file[channels[name].group_name], file)
                    scale = _unapplied_scale([level.properties for level in levels])
                    times = _times(path, name, names, channels)
                    found[name] = replace(found[name], unapplied_scale=scale, times=times)
                return _with_common_starts(found)
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
    offset = channels = entries = 0
    while offset + _LEAD_IN <= size and entries <= _MOST_ENTRIES:
        stream.seek(offset)
        head = stream.read(_LEAD_IN + 4)
        contents = int.from_bytes(head[4:8], "little")
        order = ">" if contents & _BIG_ENDIAN else "<"
        (length,) = struct.unpack(f"{order}Q", head[12:20])
        if contents & _HAS_METADATA and len(head) == _LEAD_IN + 4:
            (listed,) = struct.unpack(f"{order}L", head[_LEAD_IN:])
            channels = listed if contents & _NEW_LIST else channels + listed
            entries += channels
        entries += 1
        offset += _LEAD_IN + length
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
    properties = channel.properties
    values, label = channel[:], str(properties.get("unit_string", ""))
    if values.dtype.kind == "M":  # LabVIEW's time stamps
        values, label = (values - values[:1]) / np.timedelta64(1, "s"), "s"
    axis = str(properties.get("wf_xunit_string", "")).strip()
    if _bare_lower(axis) in _FREQUENCIES:
        raise ExchangeError(
            f"{path}: '{name}' is a function of frequency (its wf_xunit_string is '{axis}'), not "
            "of time; give measured samples."
        )
    unit_s = time_unit_s(axis) or 1.0
    return SourceChannel(
        as_column(path, name, values),
        unit_label=label or str(properties.get("NI_UnitDescription", "")),
        rate_hz=_rate_hz(properties.get("wf_increment"), unit_s),
        remark="The file's end is missing: its recording was cut off." if torn else "",
        start_ns=_start_ns(properties, unit_s),
    )


_FREQUENCIES: Final = ("hz", "hertz", "khz", "1/s")


def _bare_lower(text: str) -> str:
    return text.strip(" []()").lower()


def _rate_hz(increment: object, unit_s: float) -> float | None:
    if not isinstance(increment, int | float) or not 0 < increment < math.inf:
        return None
    return 1 / (increment * unit_s)


def _start_ns(properties: Mapping[str, Any], unit_s: float) -> int | None:
    """Return the time of the first sample: start time, if there is one, and offset."""
    begun, offset = properties.get("wf_start_time"), properties.get("wf_start_offset")
    begun_ns = 0
    if isinstance(begun, np.datetime64) and begun >= _EARLIEST:
        begun_ns = int(begun.astype("datetime64[ns]").astype(np.int64))
    elif offset is None and "wf_increment" not in properties:
        return None
    if not isinstance(offset, int | float) or not math.isfinite(offset):
        offset = 0.0
    return begun_ns + round(offset * unit_s * 1e9)


def _with_common_starts(channels: dict[str, SourceChannel]) -> dict[str, SourceChannel]:
    """Drop the time offsets of channels without a start time if other channels have one."""
    starts = [channel.start_ns or 0 for channel in channels.values()]
    if max(starts) < _EARLIEST_NS:
        return channels
    return {
        name: channel
        if channel.start_ns is None or channel.start_ns >= _EARLIEST_NS
        else replace(channel, start_ns=None)
        for name, channel in channels.items()
    }


def _unapplied_scale(levels: Sequence[Mapping[str, Any]]) -> str:
    """Name the scales that a channel, its group or the file asks for and npTDMS does not apply."""
    from nptdms.scaling import get_scaling

    for properties in levels:
        types = [
            str(value)
            for key, value in properties.items()
            if key.startswith("NI_Scale[") and key.endswith("]_Scale_Type")
        ]
        if not types or properties.get("NI_Number_Of_Scales", len(types)) == 0:
            continue
        if properties.get("NI_Scaling_Status", "unscaled") == "scaled":
            continue
        return "" if get_scaling(properties, {}, {}) is not None else ", ".join(types)
    return ""


def _times(
    path: Path, name: str, names: Sequence[str], channels: Mapping[str, Any]
) -> FileTimes | None:
    """Return the times in a channel of the same group that was not requested, if there is one."""
    channel = channels[name]
    for other, candidate in channels.items():
        if (
            other in names
            or candidate.group_name != channel.group_name
            or not is_title_of_times(candidate.name)
            or len(candidate) != len(channel)
        ):
            continue
        try:
            found = _channel(path, other, channels, False)
        except ExchangeError:  # texts, say
            continue
        return FileTimes(other, found.values, time_unit_s(found.unit_label))
    return None
