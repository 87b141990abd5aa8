"""A table as CSV: one line of names with units, then numbers with all their digits."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import BinaryIO

    from analysis.exchange.table import Column, Table

_BLOCK: Final = 20_000


def write_csv(table: Table, stream: BinaryIO) -> None:
    """Write commas, decimal points and UTF-8; a complex column becomes two, real and imaginary."""
    columns = [part for column in (table.axis, *table.columns) for part in _real_parts(column)]
    stream.write((",".join(column.name for column in columns) + "\n").encode("utf-8"))
    for begin in range(0, len(table.axis.values), _BLOCK):
        texts = [map(repr, column.values[begin : begin + _BLOCK].tolist()) for column in columns]
        lines = "\n".join(map(",".join, zip(*texts, strict=True)))
        stream.write((lines + "\n").encode("ascii"))


def _real_parts(column: Column) -> Iterator[Column]:
    if not np.iscomplexobj(column.values):
        yield column
        return
    quantity, _, unit = column.name.partition("_")
    for part, values in (("real", column.values.real), ("imaginary", column.values.imag)):
        yield replace(column, name=f"{quantity}_{part}_{unit}", values=values)
