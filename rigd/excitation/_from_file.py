"""Reference signals from CSV files."""

import csv
from array import array
from collections.abc import Iterator
from itertools import chain
from math import isfinite
from pathlib import Path
from typing import Final, TextIO

import numpy as np

from rigd.excitation._signals import (
    MAX_TICKS,
    Excitation,
    ExcitationError,
    assemble,
    check_ticks,
    lay_out_segments,
    within_a_turn,
)
from rigd.runtime import open_plain_file

MOST_BYTES: Final = 256_000_000
_LONGEST_LINE: Final = 65_536


def from_csv(
    path: str | Path, *, rate_hz: float, rest_s: float = 1.0, ring_down_s: float = 15.0
) -> Excitation:
    """Read a reference from a CSV file.

    Parameters
    ----------
    path
        Either columns ``time_s`` and ``angle_rad`` (named in the first line, more columns are
        ignored; angles are interpolated linearly to the ticks, times counted from the first), or
        a single column of angles in rad, one per tick, with or without the heading ``angle_rad``.
    rate_hz
        Ticks a second.
    rest_s, ring_down_s
        Time before and after the trajectory.

    Raises
    ------
    ExcitationError
        If the file cannot be read, or a line of it is not what it should be.
    """
    path = Path(path)
    times, angles = _read_csv(path)
    if times is None:
        ticks = len(angles)
        sweep = np.asarray(angles)
    else:
        check_ticks("The file", (times[-1] - times[0]) * rate_hz, rate_hz)
        time_s = np.asarray(times) - times[0]
        # The last row is reached exactly; rounding must not lose its tick.
        ticks = int(np.floor(time_s[-1] * rate_hz + 1e-6)) + 1
        sweep = np.interp(np.arange(ticks) / rate_hz, time_s, angles)
    within_a_turn(f"{path}: the largest angle_rad", float(np.max(np.abs(sweep))))
    duration_s = ticks / rate_hz
    segments = lay_out_segments(rate_hz, rest_s, duration_s, ring_down_s)
    parameters: dict[str, float | int | str] = {
        "file": path.name,
        "amplitude_rad": float(np.max(np.abs(sweep))),
        "duration_s": duration_s,
        "rest_s": rest_s,
        "ring_down_s": ring_down_s,
    }
    return assemble("file", parameters, rate_hz, segments, sweep)


def _read_csv(path: Path) -> "tuple[array[float] | None, array[float]]":
    try:
        with open_plain_file(path, MOST_BYTES, newline="") as file:
            return _columns(path, file)
    except OSError as error:
        raise ExcitationError(f"{path}: cannot be read ({error.strerror}).") from error
    except UnicodeDecodeError as error:
        raise ExcitationError(f"{path}: is not a CSV file in UTF-8 ({error.reason}).") from error
    except csv.Error as error:
        raise ExcitationError(f"{path}: is not a CSV file in UTF-8 ({error}).") from error


def _lines(path: Path, file: TextIO) -> Iterator[str]:
    while line := file.readline(_LONGEST_LINE + 1):
        if len(line) > _LONGEST_LINE:
            raise ExcitationError(
                f"{path}: has a line of more than {_LONGEST_LINE} characters; write one angle a "
                "line."
            )
        yield line


def _columns(path: Path, file: TextIO) -> "tuple[array[float] | None, array[float]]":
    """Return times and angles, read line by line into arrays: a list takes ten times as much."""
    reader = enumerate(csv.reader(_lines(path, file)), 1)
    rows: Iterator[tuple[int, list[str]]] = ((line, row) for line, row in reader if any(row))
    first = next(rows, None)
    header = [] if first is None else [cell.strip() for cell in first[1]]
    if "angle_rad" in header:
        angle_column = header.index("angle_rad")
        time_column = header.index("time_s") if "time_s" in header else None
        if time_column is None and len(header) > 1:
            raise ExcitationError(
                f"{path}: line 1 has {len(header)} columns, angle_rad among them, but no time_s; "
                "name the column of times in seconds so, or leave angle_rad alone."
            )
    elif len(header) == 1 and ";" in header[0]:
        raise ExcitationError(f"{path}: separates its columns by semicolons; use commas.")
    elif len(header) == 1:
        angle_column, time_column = 0, None
    else:
        raise ExcitationError(
            f"{path}: line 1 must name the columns time_s (s) and angle_rad (rad), or the file "
            "must be one column of angles in rad."
        )
    angles, times = array("d"), array("d")
    if first is not None and "angle_rad" not in header:
        rows = chain([first], rows)
    for number, row in rows:
        angles.append(_cell(path, number, row, angle_column, "angle_rad"))
        if time_column is not None:
            times.append(_cell(path, number, row, time_column, "time_s"))
            if len(times) > 1 and times[-1] <= times[-2]:
                raise ExcitationError(
                    f"{path}: line {number}: time_s does not come after the one before it; times "
                    "must increase."
                )
        if len(angles) > MAX_TICKS:
            raise ExcitationError(f"{path}: has more than {MAX_TICKS} angles; shorten it.")
    if len(angles) < 2:
        raise ExcitationError(f"{path}: has {len(angles)} angles; a reference needs at least two.")
    return (times if time_column is not None else None), angles


def _cell(path: Path, line: int, row: list[str], column: int, name: str) -> float:
    if column >= len(row):
        raise ExcitationError(f"{path}: line {line} has no value in the column {name}.")
    try:
        value = float(row[column])
    except ValueError:
        value = float("nan")
    if not isfinite(value):
        raise ExcitationError(
            # Not quoted: the daemon reads files that whoever commands it may not be allowed to.
            f"{path}: line {line}: {name} is not a finite number."
        )
    return value
