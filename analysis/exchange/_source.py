"""A measurement file of another program as named channels, read within bounds."""

from __future__ import annotations

import stat
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from rigd.printable import printable
from rigd.session.limits import MAX_SAMPLES

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray


class ExchangeError(Exception):
    """A file that cannot be imported or exported; the message names file, cause and remedy."""


class TargetError(ExchangeError):
    """A name under which nothing can be written."""


# Reading


@dataclass(frozen=True, slots=True)
class FileTimes:
    """Times that a file has of its samples.

    Attributes
    ----------
    name : str
        Name of the channel that has them.
    values : ndarray of float, shape (n,)
        Unchanged from the file.
    unit_s : float or None
        Size of their unit in seconds, None if the file does not state it.
    """

    name: str
    values: NDArray[np.float64]
    unit_s: float | None


@dataclass(frozen=True, slots=True)
class SourceChannel:
    """One channel of the file, unchanged.

    Attributes
    ----------
    values : ndarray of float, shape (n,)
        In the unit that the user states; NaN and infinities as they are.
    unit_label : str
        Unit stated in the file, "" if none.
    rate_hz : float or None
        Samples per second by the file, None if it states none.
    remark : str
        What the user should know of the file, "" if nothing.
    start_ns : int or None
        Time of the first sample by the file, ns from any instant that all channels of the file have
        in common, None if it says nothing.
    times : FileTimes or None
        Times that the file has of these samples besides.
    unapplied_scale : str
        Scale that the file asks for and that the values do not have, "" if none.
    """

    values: NDArray[np.float64]
    unit_label: str = ""
    rate_hz: float | None = None
    remark: str = ""
    start_ns: int | None = None
    times: FileTimes | None = None
    unapplied_scale: str = ""


@dataclass(frozen=True, slots=True)
class _Format:
    """How files of one kind are read: by ``read(path, names)`` of a module of this package."""

    name: str
    module: str
    max_bytes: int
    """Larger files are refused: what reads them needs up to ten times as much memory."""


_MB: Final = 1_000_000

_FORMATS: Final = {
    ".csv": _Format("CSV", "_csv_format", 512 * _MB),
    ".txt": _Format("CSV", "_csv_format", 512 * _MB),
    ".dat": _Format("CSV", "_csv_format", 512 * _MB),
    ".tsv": _Format("CSV", "_csv_format", 512 * _MB),
    ".asc": _Format("CSV", "_csv_format", 512 * _MB),
    ".lvm": _Format("CSV", "_csv_format", 512 * _MB),
    ".mat": _Format("MATLAB", "_matlab_format", 512 * _MB),
    ".tdms": _Format("TDMS", "_tdms_format", 512 * _MB),
    ".uff": _Format("UFF58", "_uff_format", 128 * _MB),
    ".unv": _Format("UFF58", "_uff_format", 128 * _MB),
    ".uf58": _Format("UFF58", "_uff_format", 128 * _MB),
}


def read_source(path: Path, names: Sequence[str]) -> tuple[str, Mapping[str, SourceChannel]]:
    """Read some channels of a file.

    Parameters
    ----------
    path : Path
        Its ending says what it is: .csv, .txt, .dat, .tsv, .asc, .lvm, .mat, .tdms, .uff, .unv or
        .uf58.
    names : sequence of str
        The channels, as the format has them (docs/exchange.md).

    Returns
    -------
    format_name : str
    channels : mapping
        Each name with its channel; all have at least two samples.

    Raises
    ------
    ExchangeError
        If the file cannot be read, or has no such channel of numbers.
    """
    kind = _FORMATS.get(path.suffix.lower())
    if kind is None:
        raise ExchangeError(
            f"{path}: the ending of the name selects the format; give a file that ends in one of "
            f"{', '.join(_FORMATS)}."
        )
    _check_file(path, kind)
    read: Callable[[Path, Sequence[str]], Mapping[str, SourceChannel]]
    read = import_module(f"analysis.exchange.{kind.module}").read
    try:
        channels = read(path, names)
    except OSError as error:
        raise ExchangeError(f"{path}: cannot be read ({error.strerror or error}).") from error
    except MemoryError as error:
        raise ExchangeError(
            f"{path}: would take more than {MAX_MEMORY / _MB:.0f} MB of memory to read, so it is "
            "damaged or holds far more than a session; export the session's channels alone."
        ) from error
    for name, channel in channels.items():
        length = len(channel.values)
        if length < 2:
            raise ExchangeError(f"{path}: '{name}' has {length} samples, too few for a record.")
        check_samples(path, f"The channel '{name}'", length)
    return kind.name, channels


def _check_file(path: Path, kind: _Format) -> None:
    try:
        status = path.stat()
    except OSError as error:
        raise ExchangeError(f"{path}: cannot be read ({error.strerror or error}).") from error
    if not stat.S_ISREG(status.st_mode):
        raise ExchangeError(f"{path}: is not a file; give a file of measurements.")
    if status.st_size > kind.max_bytes:
        raise ExchangeError(
            f"{path}: has {status.st_size / _MB:.0f} MB, more than the {kind.max_bytes / _MB:.0f} "
            f"MB of {kind.name} that are read; export the session's channels alone."
        )


def check_lengths(path: Path, channels: Mapping[str, SourceChannel]) -> None:
    """Refuse channels of different lengths."""
    lengths = {name: len(channel.values) for name, channel in channels.items()}
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise ExchangeError(
            f"{path}: the channels have different numbers of samples ({listed}); choose channels "
            "that were sampled together, or cut them to the same samples."
        )


# Bounds on memory and length

MAX_MEMORY: Final = 800_000_000
"""Most memory that reading a file may take, bytes."""


@contextmanager
def bounded_memory(extra_bytes: int = MAX_MEMORY) -> Iterator[None]:
    """Limit the growth of the process: larger requests raise a MemoryError.

    Formats such as MATLAB's are compressed and nested, and their readers believe what a file says
    of its sizes; a kilobyte can ask for all the memory there is. The kernel's own limit holds for
    every library alike. Where there is none (Windows, macOS) nothing is limited. Libraries are to
    be imported before, as the address space that they reserve would count too.
    """
    try:
        import resource
    except ImportError:
        yield
        return
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    except OSError:
        yield
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    ceiling = pages * resource.getpagesize() + extra_bytes
    bounds = [limit for limit in (soft, hard, ceiling) if limit != resource.RLIM_INFINITY]
    resource.setrlimit(resource.RLIMIT_AS, (min(bounds), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def check_samples(path: Path, what: str, samples: int) -> None:
    """Refuse a channel that is, or claims to be, longer than `MAX_SAMPLES`."""
    if samples > MAX_SAMPLES:
        raise ExchangeError(
            f"{path}: {what} has {samples} samples, more than the {MAX_SAMPLES} that are read; cut "
            "the session out of the file first."
        )


# Common functions of the readers

_NAMES_SHOWN: Final = 12
"""Channel names that a message lists."""
_NAME_SHOWN: Final = 60
"""Characters of each."""


def no_such_channel(path: Path, name: str, available: Iterable[str]) -> ExchangeError:
    """Make the error for a channel that is not there, with the names of those that are."""
    names = list(available)
    listed = ", ".join(repr(printable(each, _NAME_SHOWN)) for each in names[:_NAMES_SHOWN])
    more = f" and {len(names) - _NAMES_SHOWN} more" if len(names) > _NAMES_SHOWN else ""
    return ExchangeError(
        f"{path}: has no channel '{name}'; it has {listed}{more}."
        if names
        else f"{path}: has no channel '{name}', and no other either."
    )


def channel_index(
    path: Path, name: str, titles: Sequence[str], several: str, *, numbered: bool = False
) -> int:
    """Return the index of a channel, found by its title, or by its number as in ``#3``.

    Parameters
    ----------
    path
        File, for messages.
    name
        What the user calls the channel.
    titles
        Titles of all channels in the file.
    several
        What several channels of one title are, such as "columns are named".
    numbered
        Whether a message lists the titles with their numbers.

    Raises
    ------
    ExchangeError
        If there is no such channel, or more than one.
    """
    count = titles.count(name)
    if count == 1:
        return titles.index(name)
    if count > 1:
        raise ExchangeError(
            f"{path}: {count} {several} '{name}'; give the number, such as "
            f"#{titles.index(name) + 1} for the first of them."
        )
    number = name.removeprefix("#")
    if name != number and number.isdecimal() and 0 < int(number) <= len(titles):
        return int(number) - 1
    listed = [f"#{number} {each}" for number, each in enumerate(titles, 1)] if numbered else titles
    raise no_such_channel(path, name, listed)


def as_column(path: Path, name: str, values: NDArray[np.generic]) -> NDArray[np.float64]:
    """Return real numbers (n,) as floats; anything else is refused."""
    if values.dtype.kind == "c":
        raise not_in_time(path, name)
    if values.dtype.kind not in "iuf":
        raise ExchangeError(
            f"{path}: the channel '{name}' does not hold real numbers but {values.dtype.name}; "
            "choose a channel of measured values."
        )
    return np.ascontiguousarray(values, dtype=np.float64)


def not_in_time(path: Path, name: str) -> ExchangeError:
    """Make the error for a complex channel."""
    return ExchangeError(
        f"{path}: '{name}' is complex, so it is a frequency response or a spectrum. A session is "
        "made of measured samples: give angle and torque over time; a record cannot be "
        "reconstructed from a frequency response alone."
    )


def missing_library(path: Path, library: str) -> ExchangeError:
    """Make the error for a library that is not installed."""
    return ExchangeError(
        f"{path}: needs the package {library}, which is not installed; install all packages for "
        "import and export with `pip install 'rigd[exchange]'`."
    )
