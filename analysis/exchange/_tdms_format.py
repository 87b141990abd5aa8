"""Reading of channels from LabVIEW TDMS files by the package npTDMS."""

from __future__ import annotations

import logging
import math
import re
import struct
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from analysis.exchange._source import (
    ExchangeError,
    FileTimes,
    SourceChannel,
    bounded_memory,
    check_sample_count,
    first_times,
    missing_library_error,
    no_such_channel_error,
    real_vector,
)
from rigd.text_table.titles import is_title_of_times, is_unit_of_other_quantity, time_unit_s

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path
    from typing import BinaryIO

_MAX_LISTED_CHANNELS: Final = 5_000_000
"""Largest number of channel entries in all segments together, because npTDMS processes all of them
before it reads a value."""

_EARLIEST_START_TIME: Final = np.datetime64("1980-01-01")
"""Earliest valid start time; LabVIEW writes its origin, in 1904, if no start time was given."""
_EARLIEST_START_NS: Final = int(_EARLIEST_START_TIME.astype("datetime64[ns]").astype(np.int64))
"""Earliest valid start time in nanoseconds since 1970."""

_LEAD_IN_BYTES: Final = 28
"""Number of bytes of a segment's lead-in."""
_SEGMENT_TAG: Final = b"TDSm"
"""First bytes of a segment."""
_NEXT_SEGMENT_PATTERN: Final = re.compile(rb"TDSm.{4}[\x68\x69]\x12\x00\x00", re.DOTALL)
"""Pattern of the first bytes of a segment with a known version."""
_HAS_METADATA, _NEW_LIST, _BIG_ENDIAN = 1 << 1, 1 << 2, 1 << 6
"""Bits in the lead-in: the segment has metadata, a new list of channels, big-endian numbers."""


def read(path: Path, channel_names: Sequence[str]) -> Mapping[str, SourceChannel]:
    """Read channels ``Group/Channel`` from a TDMS file (see `analysis.exchange.read_source`).

    Scales in the file are applied. If npTDMS does not know a scale, the values are raw and
    `SourceChannel.unapplied_scale` names it. An index file in the same folder is not used, because
    it may belong to another file.
    """
    try:
        from nptdms import TdmsFile
        from nptdms.log import log_manager
    except ImportError as error:
        raise missing_library_error(path, "npTDMS") from error
    log_manager.set_level(logging.ERROR)  # its warnings are reported below
    try:
        with path.open("rb") as stream:
            _check_listed_channel_count(path, stream)
            with bounded_memory(), TdmsFile.open(stream) as tdms_file:
                channels_by_name = {
                    f"{tdms_group.name}/{channel.name}": channel
                    for tdms_group in tdms_file.groups()
                    for channel in tdms_group.channels()
                }
                is_cut_off = tdms_file.file_status.incomplete_final_segment
                # The file_status of npTDMS shows this of the last segment only.
                if any(
                    segment.final_chunk_lengths_override is not None
                    and not segment.segment_incomplete
                    for segment in tdms_file._reader._segments
                ):
                    raise _damaged_error(
                        path, "the data of a segment are not as long as its channels"
                    )
                source_channels = {
                    channel_name: _read_channel(path, channel_name, channels_by_name, is_cut_off)
                    for channel_name in channel_names
                }
                for channel_name in channel_names:
                    property_levels = (
                        channels_by_name[channel_name],
                        tdms_file[channels_by_name[channel_name].group_name],
                        tdms_file,
                    )
                    unapplied_scale = _unapplied_scale(
                        [property_level.properties for property_level in property_levels]
                    )
                    group_times = _group_times(path, channel_name, channel_names, channels_by_name)
                    source_channels[channel_name] = replace(
                        source_channels[channel_name],
                        unapplied_scale=unapplied_scale,
                        times=group_times,
                    )
                return _drop_relative_starts(source_channels)
    except (ExchangeError, OSError, MemoryError):
        raise
    except Exception as error:  # npTDMS raises many types on a damaged file
        raise _damaged_error(path, str(error)) from error


def _check_listed_channel_count(path: Path, stream: BinaryIO) -> None:
    """Raise if the table of contents would take minutes or gigabytes to read, or is damaged."""
    file_size_bytes = path.stat().st_size
    segment_offset = total_channels = listed_count = 0
    while (
        segment_offset + _LEAD_IN_BYTES <= file_size_bytes and listed_count <= _MAX_LISTED_CHANNELS
    ):
        stream.seek(segment_offset)
        lead_in = stream.read(_LEAD_IN_BYTES + 4)
        contents_mask = int.from_bytes(lead_in[4:8], "little")
        byte_order = ">" if contents_mask & _BIG_ENDIAN else "<"
        segment_bytes, metadata_bytes = struct.unpack(f"{byte_order}QQ", lead_in[12:28])
        if lead_in[:4] != _SEGMENT_TAG:
            raise _damaged_error(path, f"no segment begins at byte {segment_offset}")
        if segment_offset + _LEAD_IN_BYTES + segment_bytes > file_size_bytes:
            stream.seek(segment_offset + _LEAD_IN_BYTES)
            if _NEXT_SEGMENT_PATTERN.search(stream.read()):
                raise _damaged_error(
                    path, f"the segment at byte {segment_offset} states a wrong length"
                )
        if metadata_bytes > segment_bytes or (metadata_bytes and not contents_mask & _HAS_METADATA):
            raise _damaged_error(
                path, f"the segment at byte {segment_offset} states a wrong position of its data"
            )
        if contents_mask & _HAS_METADATA and len(lead_in) == _LEAD_IN_BYTES + 4:
            (channel_count,) = struct.unpack(f"{byte_order}L", lead_in[_LEAD_IN_BYTES:])
            total_channels = (
                channel_count if contents_mask & _NEW_LIST else total_channels + channel_count
            )
            listed_count += total_channels
        listed_count += 1
        segment_offset += _LEAD_IN_BYTES + segment_bytes
    stream.seek(0)
    if listed_count > _MAX_LISTED_CHANNELS:
        raise ExchangeError(
            f"{path}: its segments list more than {_MAX_LISTED_CHANNELS} channels in all, so it is "
            "damaged or no record of a few channels; export the session's channels alone."
        )


def _damaged_error(path: Path, problem: str) -> ExchangeError:
    """Return the error for a file that states positions where its data cannot be."""
    return ExchangeError(
        f"{path}: is not a TDMS file, or is damaged ({problem}); copy it again from where it was "
        "recorded."
    )


def _read_channel(
    path: Path, channel_name: str, channels: Mapping[str, Any], is_cut_off: bool
) -> SourceChannel:
    """Return one channel of a TDMS file.

    If `is_cut_off`, the end of the file is missing, and the channel gets a remark on that.
    """
    channel = channels.get(channel_name)
    if channel is None:
        raise no_such_channel_error(path, channel_name, channels)
    check_sample_count(path, f"The channel '{channel_name}'", len(channel))
    channel_properties = channel.properties
    channel_values, unit_label = channel[:], str(channel_properties.get("unit_string", ""))
    if channel_values.dtype.kind == "M":  # LabVIEW's time stamps
        channel_values, unit_label = (
            (channel_values - channel_values[:1]) / np.timedelta64(1, "s"),
            "s",
        )
    axis_unit = str(channel_properties.get("wf_xunit_string", "")).strip()
    if _plain_lower_case(axis_unit) in _FREQUENCY_UNITS:
        raise ExchangeError(
            f"{path}: '{channel_name}' is a function of frequency (its wf_xunit_string is "
            f"'{axis_unit}'), not of time; give measured samples."
        )
    unit_s = time_unit_s(axis_unit) or 1.0
    return SourceChannel(
        real_vector(path, channel_name, channel_values),
        unit_label=unit_label or str(channel_properties.get("NI_UnitDescription", "")),
        rate_hz=_rate_hz(channel_properties.get("wf_increment"), unit_s),
        remark="The file's end is missing: its recording was cut off." if is_cut_off else "",
        start_ns=_start_ns(channel_properties, unit_s),
    )


_FREQUENCY_UNITS: Final = ("hz", "hertz", "khz", "1/s")
"""Units of an axis of frequencies, in lower case."""


def _plain_lower_case(text: str) -> str:
    """Return a text in lower case, without surrounding spaces and brackets."""
    return text.strip(" []()").lower()


def _rate_hz(sample_increment: object, unit_s: float) -> float | None:
    """Return the sampling rate in Hz for a time step in units of `unit_s`; None if not valid."""
    if not isinstance(sample_increment, int | float) or not 0 < sample_increment < math.inf:
        return None
    return 1 / (sample_increment * unit_s)


def _start_ns(channel_properties: Mapping[str, Any], unit_s: float) -> int | None:
    """Return the time of the first sample in ns, from start time and offset; None if not stated."""
    start_time, offset_s = (
        channel_properties.get("wf_start_time"),
        channel_properties.get("wf_start_offset"),
    )
    start_time_ns = 0
    if isinstance(start_time, np.datetime64) and start_time >= _EARLIEST_START_TIME:
        start_time_ns = int(start_time.astype("datetime64[ns]").astype(np.int64))
    elif offset_s is None and "wf_increment" not in channel_properties:
        return None
    if not isinstance(offset_s, int | float) or not math.isfinite(offset_s):
        offset_s = 0.0
    return start_time_ns + round(offset_s * unit_s * 1e9)


def _drop_relative_starts(channels: dict[str, SourceChannel]) -> dict[str, SourceChannel]:
    """Remove start times that are only offsets, if other channels have absolute start times."""
    starts_ns = [channel.start_ns or 0 for channel in channels.values()]
    if max(starts_ns) < _EARLIEST_START_NS:
        return channels
    return {
        channel_name: channel
        if channel.start_ns is None or channel.start_ns >= _EARLIEST_START_NS
        else replace(channel, start_ns=None)
        for channel_name, channel in channels.items()
    }


def _unapplied_scale(property_levels: Sequence[Mapping[str, Any]]) -> str:
    """Return the types of stated scales that npTDMS does not apply, or an empty text."""
    from nptdms.scaling import get_scaling

    for properties in property_levels:
        scale_types = [
            str(property_value)
            for key, property_value in properties.items()
            if key.startswith("NI_Scale[") and key.endswith("]_Scale_Type")
        ]
        if not scale_types or properties.get("NI_Number_Of_Scales", len(scale_types)) == 0:
            continue
        if properties.get("NI_Scaling_Status", "unscaled") == "scaled":
            continue
        return "" if get_scaling(properties, {}, {}) is not None else ", ".join(scale_types)
    return ""


def _group_times(
    path: Path, channel_name: str, channel_names: Sequence[str], channels: Mapping[str, Any]
) -> FileTimes | None:
    """Return the times in a channel of the same group that was not requested, or None."""
    channel = channels[channel_name]
    possible_times: list[FileTimes] = []
    for other_name, other_channel in channels.items():
        if (
            other_name in channel_names
            or other_channel.group_name != channel.group_name
            or not is_title_of_times(other_channel.name)
            or len(other_channel) != len(channel)
        ):
            continue
        try:
            time_channel = _read_channel(path, other_name, channels, False)
        except ExchangeError:  # the channel has texts, for example
            continue
        if not is_unit_of_other_quantity(time_channel.unit_label):
            possible_times.append(
                FileTimes(other_name, time_channel.values, time_unit_s(time_channel.unit_label))
            )
    return first_times(possible_times)
