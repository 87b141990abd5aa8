"""Reading of channels from text files, and writing of tables as CSV."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.exchange._source import (
    ExchangeError,
    FileTimes,
    SourceChannel,
    check_sample_count,
)
from rigd.session.limits import MAX_SAMPLES
from rigd.text_table import TableError, read_table

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path
    from typing import BinaryIO

    from analysis.exchange._table import ExportColumn, ExportTable


# Reading


def read(path: Path, channel_names: Sequence[str]) -> Mapping[str, SourceChannel]:
    """Read columns from a text file (see `analysis.exchange.read_source`).

    A column is named by its title, or by its number: ``#3`` is the third. An empty cell is NaN.
    """
    try:
        with path.open("rb") as stream:
            table = read_table(stream, channel_names, max_rows=MAX_SAMPLES)
    except TableError as error:
        raise ExchangeError(f"{path}: {error}") from error
    file_times = None
    if table.times is not None:
        file_times = FileTimes(table.times.title, table.times.values, table.times.unit_s)
    channels = {
        channel_name: SourceChannel(
            column.values,
            unit_label=column.unit,
            rate_hz=column.rate_hz,
            start_ns=column.start_ns,
            times=file_times,
            remark=table.remark,
            title=column.title,
        )
        for channel_name, column in table.columns.items()
    }
    check_sample_count(path, "The file", len(next(iter(channels.values())).values))
    return channels


# Writing

_BLOCK_ROWS: Final = 20_000
"""Number of rows that are formatted at a time."""


def write_csv(table: ExportTable, stream: BinaryIO) -> None:
    """Write a table as CSV in UTF-8; a complex column becomes a real and an imaginary column."""
    real_columns = [
        real_column
        for column in (table.axis, *table.columns)
        for real_column in _real_parts(column)
    ]
    stream.write((",".join(column.name for column in real_columns) + "\n").encode("utf-8"))
    for first_row in range(0, len(table.axis.values), _BLOCK_ROWS):
        cell_texts = [
            map(repr, column.values[first_row : first_row + _BLOCK_ROWS].tolist())
            for column in real_columns
        ]
        csv_lines = "\n".join(map(",".join, zip(*cell_texts, strict=True)))
        stream.write((csv_lines + "\n").encode("ascii"))


def _real_parts(column: ExportColumn) -> Iterator[ExportColumn]:
    """Yield a real column itself, or the real and the imaginary part of a complex column."""
    if not np.iscomplexobj(column.values):
        yield column
        return
    quantity_name, _, unit = column.name.partition("_")
    for part_name, part_values in (("real", column.values.real), ("imaginary", column.values.imag)):
        yield replace(column, name=f"{quantity_name}_{part_name}_{unit}", values=part_values)
