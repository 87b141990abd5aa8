"""Reading of named channels from measurement files of other programs, within memory bounds."""

from __future__ import annotations

import stat
from collections.abc import Callable, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from rigd.plugins import Plugin, PluginError, Registry, load_plugin, plugin_errors
from rigd.printable import printable
from rigd.session.limits import MAX_SAMPLES
from rigd.text_table.titles import are_times

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from numpy.typing import NDArray


class ExchangeError(Exception):
    """Error if a file cannot be imported or exported; the message states the remedy."""


class TargetError(ExchangeError):
    """Error if the name of an output file is not suitable, such as an unknown suffix."""


# Reading


@dataclass(frozen=True, slots=True)
class FileTimes:
    """Times of the samples that a file contains.

    Attributes
    ----------
    name : str
        Name of the channel of times.
    values : ndarray of float, shape (n,)
        Times as in the file.
    unit_s : float or None
        Unit of the times in seconds; None if the file does not state it.
    """

    name: str
    values: NDArray[np.float64]
    unit_s: float | None


@dataclass(frozen=True, slots=True)
class SourceChannel:
    """Values of one channel of a file, with their unit, rate and times as the file states them.

    Attributes
    ----------
    values : ndarray of float, shape (n,)
        Values as in the file, NaN and infinities included.
    unit_label : str
        Unit stated in the file; empty if not stated.
    rate_hz : float or None
        Sampling rate stated in the file; None if not stated.
    remark : str
        Warning for the user about the file; empty if there is none.
    start_ns : int or None
        Time of the first sample stated in the file, in ns from an origin common to all channels of
        the file; None if not stated.
    times : FileTimes or None
        Times of these samples in another channel of the file; None if there are none.
    unapplied_scale : str
        Scale stated in the file but not applied to the values; empty if there is none.
    title : str
        Title of the channel in the file; empty if it is the name under which it was requested.
    """

    values: NDArray[np.float64]
    unit_label: str = ""
    rate_hz: float | None = None
    remark: str = ""
    start_ns: int | None = None
    times: FileTimes | None = None
    unapplied_scale: str = ""
    title: str = ""


ReadChannels = Callable[[Path, Sequence[str]], Mapping[str, SourceChannel]]
"""Function that reads channels of a file, by their names."""


@dataclass(frozen=True, slots=True)
class ImportFormat:
    """Declaration of a file format that can be imported.

    An installed package adds one by an entry point of the group ``analysis.formats``, whose name is
    the suffix of the files without the dot.

    Attributes
    ----------
    name : str
        Name of the format, for messages.
    read : callable
        Function of a path and names of channels that returns a `SourceChannel` for each name. It
        raises `ExchangeError` for a channel that the file lacks.
    max_bytes : int
        Largest size of a file that is read; its reader needs up to ten times as much memory.
    """

    name: str
    read: ReadChannels
    max_bytes: int


def _shipped_format(name: str, module_name: str, max_bytes: int) -> ImportFormat:
    """Return a format of this package; its module is imported when the first file is read."""

    def read(path: Path, channel_names: Sequence[str]) -> Mapping[str, SourceChannel]:
        read_channels: ReadChannels = import_module(f"analysis.exchange.{module_name}").read
        return read_channels(path, channel_names)

    return ImportFormat(name, read, max_bytes)


_MEGABYTE: Final = 1_000_000
"""Number of bytes in a megabyte."""


def _load_format(plugin: Plugin) -> ImportFormat:
    """Import the file format of a package, and check its declaration."""
    file_format = load_plugin(plugin, ImportFormat)
    if not (isinstance(file_format.name, str) and file_format.name.strip()):
        raise plugin.error("its format has no name.")
    if not callable(file_format.read):
        raise plugin.error("its function that reads channels is no function.")
    if not (isinstance(file_format.max_bytes, int) and file_format.max_bytes > 0):
        raise plugin.error(
            f"its largest file, max_bytes = {file_format.max_bytes}, is not a number of bytes "
            "above 0."
        )
    return file_format


_IMPORT_FORMATS: Final = Registry(
    "analysis.formats",
    {
        "csv": _shipped_format("CSV", "_csv_format", 512 * _MEGABYTE),
        "txt": _shipped_format("CSV", "_csv_format", 512 * _MEGABYTE),
        "dat": _shipped_format("CSV", "_csv_format", 512 * _MEGABYTE),
        "tsv": _shipped_format("CSV", "_csv_format", 512 * _MEGABYTE),
        "asc": _shipped_format("CSV", "_csv_format", 512 * _MEGABYTE),
        "lvm": _shipped_format("CSV", "_csv_format", 512 * _MEGABYTE),
        "mat": _shipped_format("MATLAB", "_matlab_format", 512 * _MEGABYTE),
        "tdms": _shipped_format("TDMS", "_tdms_format", 512 * _MEGABYTE),
        "uff": _shipped_format("UFF58", "_uff_format", 128 * _MEGABYTE),
        "unv": _shipped_format("UFF58", "_uff_format", 128 * _MEGABYTE),
        "uf58": _shipped_format("UFF58", "_uff_format", 128 * _MEGABYTE),
    },
    _load_format,
)
"""File format by the suffix of the file's name, without the dot."""


def read_source(
    path: Path, channel_names: Sequence[str]
) -> tuple[str, Mapping[str, SourceChannel]]:
    """Read some channels of a measurement file of another program.

    Parameters
    ----------
    path : Path
        File whose suffix selects the format: .csv, .txt, .dat, .tsv, .asc, .lvm, .mat, .tdms, .uff,
        .unv or .uf58, or one that an installed package adds.
    channel_names : sequence of str
        Names of the channels, as in docs/exchange.md.

    Returns
    -------
    format_name : str
        Name of the file format.
    channels : mapping
        Channels by their names; all have at least two samples.

    Raises
    ------
    ExchangeError
        If the file cannot be read, or lacks a requested channel of numbers.
    """
    suffix = path.suffix.lower().removeprefix(".")
    try:
        owner, file_format = _IMPORT_FORMATS.owner(suffix), _IMPORT_FORMATS.get(suffix)
    except PluginError as error:
        raise ExchangeError(f"{path}: {error}") from error
    if file_format is None:
        raise ExchangeError(
            f"{path}: the ending of the name selects the format; give a file that ends in one of "
            f"{', '.join(f'.{name}' for name in _IMPORT_FORMATS.names())}."
        )
    _check_file(path, file_format)
    try:
        channels = _read_checked_channels(file_format, owner, path, channel_names)
    except OSError as error:
        raise ExchangeError(f"{path}: cannot be read ({error.strerror or error}).") from error
    except MemoryError as error:
        raise ExchangeError(
            f"{path}: would take more than {MAX_MEMORY_BYTES / _MEGABYTE:.0f} MB of memory to "
            "read, so it is damaged or holds far more than a session; export the session's "
            "channels alone."
        ) from error
    for channel_name, channel in channels.items():
        sample_count = len(channel.values)
        if sample_count < 2:
            raise ExchangeError(
                f"{path}: '{channel_name}' has {sample_count} samples, too few for a record."
            )
        check_sample_count(path, f"The channel '{channel_name}'", sample_count)
    return file_format.name, channels


def _read_checked_channels(
    file_format: ImportFormat, owner: Plugin | None, path: Path, channel_names: Sequence[str]
) -> Mapping[str, SourceChannel]:
    """Return the channels of a file; check them if an installed package has read them."""
    if owner is None:
        return file_format.read(path, channel_names)
    try:
        with plugin_errors(owner, (ExchangeError, MemoryError)):
            channels = file_format.read(path, channel_names)
            return {name: _checked_channel(path, name, channels[name]) for name in channel_names}
    except PluginError as error:
        raise ExchangeError(f"{path}: {error}") from error


def _checked_channel(path: Path, channel_name: str, channel: SourceChannel) -> SourceChannel:
    """Return a channel read by an installed package, with real values; raise unless it is valid."""
    values = real_vector(path, channel_name, np.asarray(channel.values))
    if values.ndim != 1:
        raise ExchangeError(
            f"{path}: the channel '{channel_name}' has {values.ndim} dimensions, not one."
        )
    rate_hz = channel.rate_hz
    if rate_hz is not None and not (rate_hz > 0 and np.isfinite(rate_hz)):
        raise ExchangeError(f"{path}: the channel '{channel_name}' has a rate of {rate_hz} Hz.")
    return replace(channel, values=values)


def check_format_plugin(plugin: Plugin) -> str:
    """Import the file format that an installed package adds, and return its name.

    Raises
    ------
    PluginError
        If the format cannot be used.
    """
    return f"{_IMPORT_FORMATS.load(plugin).name}, import of .{plugin.name}"


def _check_file(path: Path, file_format: ImportFormat) -> None:
    """Raise if a path is no regular file, or if the file is too large for its format."""
    try:
        file_status = path.stat()
    except OSError as error:
        raise ExchangeError(f"{path}: cannot be read ({error.strerror or error}).") from error
    if not stat.S_ISREG(file_status.st_mode):
        raise ExchangeError(f"{path}: is not a file; give a file of measurements.")
    if file_status.st_size > file_format.max_bytes:
        raise ExchangeError(
            f"{path}: has {file_status.st_size / _MEGABYTE:.0f} MB, more than the "
            f"{file_format.max_bytes / _MEGABYTE:.0f} "
            f"MB of {file_format.name} that are read; export the session's channels alone."
        )


def check_lengths(path: Path, channels: Mapping[str, SourceChannel]) -> None:
    """Raise if channels have different numbers of samples."""
    sample_counts = {
        channel_name: len(channel.values) for channel_name, channel in channels.items()
    }
    if len(set(sample_counts.values())) > 1:
        counts_text = ", ".join(
            f"{channel_name} {sample_count}" for channel_name, sample_count in sample_counts.items()
        )
        raise ExchangeError(
            f"{path}: the channels have different numbers of samples ({counts_text}); choose "
            "channels that were sampled together, or cut them to the same samples."
        )


# Bounds on memory and length

MAX_MEMORY_BYTES: Final = 800_000_000
"""Largest amount of memory in bytes that reading a file may take."""


@contextmanager
def bounded_memory(extra_bytes: int = MAX_MEMORY_BYTES) -> Iterator[None]:
    """Limit the memory that the process may allocate in addition to the present amount.

    Larger requests raise a MemoryError. Formats such as MATLAB's are compressed and nested, and
    their readers trust the sizes stated in the file, so that a kilobyte can request all memory of
    the machine. The limit is the kernel's, so it applies to every library; Windows and macOS have
    none. Libraries must be imported before, because the address space that they reserve counts.
    """
    try:
        import resource
    except ImportError:
        yield
        return
    try:
        page_count = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    except OSError:
        yield
        return
    soft_limit, hard_limit = resource.getrlimit(resource.RLIMIT_AS)
    new_limit_bytes = page_count * resource.getpagesize() + extra_bytes
    memory_limits = [
        memory_limit
        for memory_limit in (soft_limit, hard_limit, new_limit_bytes)
        if memory_limit != resource.RLIM_INFINITY
    ]
    resource.setrlimit(resource.RLIMIT_AS, (min(memory_limits), hard_limit))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft_limit, hard_limit))


def check_sample_count(path: Path, channel_text: str, sample_count: int) -> None:
    """Raise if a channel has, or claims to have, more than `MAX_SAMPLES` samples."""
    if sample_count > MAX_SAMPLES:
        raise ExchangeError(
            f"{path}: {channel_text} has {sample_count} samples, more than the {MAX_SAMPLES} that "
            "are read; cut the session out of the file first."
        )


# Common functions of the readers

_MAX_NAMES_LISTED: Final = 12
"""Largest number of channel names that a message lists."""
_MAX_NAME_CHARACTERS: Final = 60
"""Largest number of characters of each channel name in a message."""


def no_such_channel_error(
    path: Path, requested_name: str, available: Iterable[str]
) -> ExchangeError:
    """Return the error for a channel that is missing, with the names of the available channels."""
    available_names = list(available)
    listed_text = ", ".join(
        repr(printable(channel_name, _MAX_NAME_CHARACTERS))
        for channel_name in available_names[:_MAX_NAMES_LISTED]
    )
    more_text = (
        f" and {len(available_names) - _MAX_NAMES_LISTED} more"
        if len(available_names) > _MAX_NAMES_LISTED
        else ""
    )
    return ExchangeError(
        f"{path}: has no channel '{requested_name}'; it has {listed_text}{more_text}."
        if available_names
        else f"{path}: has no channel '{requested_name}', and no other either."
    )


def channel_index(
    path: Path,
    channel_name: str,
    titles: Sequence[str],
    duplicates_text: str,
    *,
    list_numbers: bool = False,
) -> int:
    """Return the index of a channel that is given by its title or by its number, as ``#3``.

    `titles` are the titles of all channels in the file. The message about several channels of one
    title contains `duplicates_text`, such as "columns are named". `list_numbers` states whether
    messages list the titles with their numbers. Raise ExchangeError unless there is exactly one
    such channel.
    """
    title_count = titles.count(channel_name)
    if title_count == 1:
        return titles.index(channel_name)
    if title_count > 1:
        raise ExchangeError(
            f"{path}: {title_count} {duplicates_text} '{channel_name}'; give the number, such as "
            f"#{titles.index(channel_name) + 1} for the first of them."
        )
    channel_number_text = channel_name.removeprefix("#")
    if (
        channel_name != channel_number_text
        and channel_number_text.isdecimal()
        and 0 < int(channel_number_text) <= len(titles)
    ):
        return int(channel_number_text) - 1
    listed_titles = (
        [f"#{channel_number} {title}" for channel_number, title in enumerate(titles, 1)]
        if list_numbers
        else titles
    )
    raise no_such_channel_error(path, channel_name, listed_titles)


def first_times(possible_times: Sequence[FileTimes]) -> FileTimes | None:
    """Return the first of several channels of times that increases, or else the first, if any."""
    increasing_times = (times for times in possible_times if are_times(times.values))
    return next(increasing_times, next(iter(possible_times), None))


def real_vector(path: Path, channel_name: str, values: NDArray[np.generic]) -> NDArray[np.float64]:
    """Return real numbers as a vector of floats; raise if the values are not real numbers."""
    if values.dtype.kind == "c":
        raise not_in_time_error(path, channel_name)
    if values.dtype.kind not in "iuf":
        raise ExchangeError(
            f"{path}: the channel '{channel_name}' does not hold real numbers but "
            f"{values.dtype.name}; choose a channel of measured values."
        )
    return np.ascontiguousarray(values, dtype=np.float64)


def not_in_time_error(path: Path, channel_name: str) -> ExchangeError:
    """Return the error for a complex channel, which is no function of time."""
    return ExchangeError(
        f"{path}: '{channel_name}' is complex, so it is a frequency response or a spectrum. A "
        "session is made of measured samples: give angle and torque over time; a record cannot be "
        "reconstructed from a frequency response alone."
    )


def missing_library_error(path: Path, library_name: str) -> ExchangeError:
    """Return the error for a library that is not installed."""
    return ExchangeError(
        f"{path}: needs the package {library_name}, which is not installed; install all packages "
        "for import and export with `pip install 'rigd[exchange]'`."
    )
