"""Reference signals from text files."""

from math import isclose
from pathlib import Path
from typing import Annotated, BinaryIO, Final

import numpy as np
import numpy.typing as npt
from annotated_types import doc

from rigd.excitation._options import RestS, RingDownS, documented
from rigd.excitation._signals import (
    Excitation,
    ExcitationError,
    assemble_excitation,
    check_ticks,
    lay_out_segments,
    require_within_turn,
)
from rigd.runtime import open_plain_file
from rigd.session.limits import MAX_SAMPLES
from rigd.text_table import MissingColumnError, TableError, TextTable, read_table
from rigd.text_table.titles import time_unit_s

MAX_FILE_BYTES: Final = 256_000_000
"""Largest size in bytes of a text file with a reference."""
TIME_COLUMN: Final = "time_s"
"""Heading of the column of times."""
ANGLE_COLUMN: Final = "angle_rad"
"""Heading of the column of angles."""
_RADIAN_NAMES: Final = ("rad", "radian", "radians")
"""Names of the unit that a column of angles may state."""
_RATE_TOLERANCE: Final = 2e-5
"""Largest relative difference between the rate that a file states and the rate of the session."""


@documented
def from_csv(
    path: Annotated[
        str | Path,
        doc(
            "Text file. Either it has the columns ``time_s`` and ``angle_rad`` (more columns "
            "are ignored, angles are interpolated linearly to the ticks, and times are counted "
            "from the first row). Or it has a single column of angles in rad, one per tick, "
            "with or without the heading ``angle_rad``."
        ),
    ],
    *,
    rate_hz: Annotated[float, doc("Ticks a second.")],
    rest_s: RestS = 1.0,
    ring_down_s: RingDownS = 15.0,
) -> Excitation:
    """Return an excitation whose reference angles are read from a text file.

    `rigd.text_table.read_table` detects separator, decimal sign, heading and encoding; an
    invalid line is an error.

    Raises
    ------
    ExcitationError
        If the file cannot be read, or a line of it is invalid.
    """
    path = Path(path)
    times_s, angles_rad = _read_columns(path, rate_hz)
    if times_s is None:
        tick_count = len(angles_rad)
        sweep_rad = angles_rad
    else:
        check_ticks("The file", (float(times_s[-1]) - float(times_s[0])) * rate_hz, rate_hz)
        time_s = times_s - times_s[0]
        # The last row is reached exactly; rounding must not lose its tick.
        tick_count = int(np.floor(time_s[-1] * rate_hz + 1e-6)) + 1
        sweep_rad = np.interp(np.arange(tick_count) / rate_hz, time_s, angles_rad)
    require_within_turn(f"{path}: the largest angle_rad", float(np.max(np.abs(sweep_rad))))
    duration_s = tick_count / rate_hz
    segments = lay_out_segments(rate_hz, rest_s, duration_s, ring_down_s)
    parameters: dict[str, float | int | str] = {
        "file": path.name,
        "amplitude_rad": float(np.max(np.abs(sweep_rad))),
        "duration_s": duration_s,
        "rest_s": rest_s,
        "ring_down_s": ring_down_s,
    }
    return assemble_excitation("file", parameters, rate_hz, segments, sweep_rad)


def _read_columns(
    path: Path, rate_hz: float
) -> tuple[npt.NDArray[np.float64] | None, npt.NDArray[np.float64]]:
    """Read times in s and angles in rad; the times are None if the file has one angle a tick."""
    try:
        with open_plain_file(path, MAX_FILE_BYTES) as text_file:
            text_table = _read_table(text_file.buffer)
    except OSError as error:
        raise ExcitationError(f"{path}: cannot be read ({error.strerror}).") from error
    except TableError as error:
        # Without its text: the daemon may read files that the requesting user may not.
        raise ExcitationError(f"{path}: {error.unquoted_message()}") from error
    angle_column = next(
        column_values
        for column_name, column_values in text_table.columns.items()
        if column_name != TIME_COLUMN
    )
    time_column = text_table.columns.get(TIME_COLUMN)
    if len(angle_column.values) < 2:
        raise ExcitationError(
            f"{path}: has {len(angle_column.values)} angles; a reference needs at least two."
        )
    if len(angle_column.values) > MAX_SAMPLES:
        raise ExcitationError(f"{path}: has more than {MAX_SAMPLES} angles; shorten it.")
    if angle_column.unit and angle_column.unit.lower() not in _RADIAN_NAMES:
        raise ExcitationError(
            f"{path}: states another unit than rad for {ANGLE_COLUMN}; write rad."
        )
    if time_column is not None and time_column.unit and time_unit_s(time_column.unit) != 1.0:
        raise ExcitationError(
            f"{path}: states another unit than s for {TIME_COLUMN}; write seconds."
        )
    file_rate_hz = angle_column.rate_hz
    if (
        time_column is None
        and file_rate_hz is not None
        and not isclose(file_rate_hz, rate_hz, rel_tol=_RATE_TOLERANCE)
    ):
        raise ExcitationError(
            f"{path}: states {file_rate_hz:.6g} Hz above its angles, and the reference is played "
            f"at {rate_hz:.6g} Hz, one angle a tick; add a column {TIME_COLUMN}, or resample it."
        )
    for column_name, column_values in ((ANGLE_COLUMN, angle_column), (TIME_COLUMN, time_column)):
        if column_values is not None and not np.isfinite(column_values.values).all():
            row_index = int(np.argmin(np.isfinite(column_values.values)))
            raise ExcitationError(
                f"{path}: line {text_table.line_numbers[row_index]}: {column_name} is not a finite "
                "number."
            )
    if (
        time_column is not None
        and (is_not_increasing := time_column.values[1:] <= time_column.values[:-1]).any()
    ):
        row_index = int(np.argmax(is_not_increasing)) + 1
        raise ExcitationError(
            f"{path}: line {text_table.line_numbers[row_index]}: {TIME_COLUMN} does not come after "
            "the one before it; times must increase."
        )
    return (None if time_column is None else time_column.values), angle_column.values


def _read_table(table_stream: BinaryIO) -> TextTable:
    """Read a table with the columns of times and angles, or with a single column of angles."""
    try:
        return read_table(table_stream, (TIME_COLUMN, ANGLE_COLUMN), max_rows=MAX_SAMPLES)
    except MissingColumnError:
        pass
    try:
        text_table = read_table(table_stream, (ANGLE_COLUMN,), max_rows=MAX_SAMPLES)
    except MissingColumnError:
        pass
    else:
        if text_table.column_count > 1:
            raise TableError(
                f"has {text_table.column_count} columns, {ANGLE_COLUMN} among them, but no "
                f"{TIME_COLUMN}; name the column of times in seconds so, or leave {ANGLE_COLUMN} "
                "alone."
            )
        return text_table
    text_table = read_table(table_stream, ("#1",), max_rows=MAX_SAMPLES)
    angle_column = text_table.columns["#1"]
    if text_table.column_count > 1 or (angle_column.title and not angle_column.unit):
        raise TableError(
            f"must name the columns {TIME_COLUMN} (s) and {ANGLE_COLUMN} (rad) in one line above "
            "the numbers, or be one column of angles in rad."
        )
    return text_table
