"""A table as a MATLAB file of version 5 (``save -v7``), by scipy."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from analysis.exchange.source import missing_library

if TYPE_CHECKING:
    from typing import BinaryIO

    from analysis.exchange.table import Table


def write_mat(table: Table, stream: BinaryIO) -> None:
    """Write each column as a variable of its name, n×1, and ``information``, a struct of texts.

    Raises
    ------
    ExchangeError
        If scipy is not installed.
    """
    try:
        from scipy.io import savemat
    except ImportError as error:
        raise missing_library(Path(table.source), "scipy") from error
    variables = {column.name: column.values for column in (table.axis, *table.columns)}
    savemat(
        stream,
        {**variables, "information": {_identifier(k): v for k, v in table.information.items()}},
        long_field_names=True,
        do_compression=True,
        oned_as="column",
    )


def _identifier(key: str) -> str:
    """Make a key of any file a field name that MATLAB takes."""
    name = "".join(c if c.isascii() and (c.isalnum() or c == "_") else "_" for c in key)
    return (name if name[:1].isalpha() else f"x{name}")[:63]
