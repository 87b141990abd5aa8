"""A session's record, its frequency response or its model into a new file for another program."""

from __future__ import annotations

import os
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

import rigd
from analysis.exchange._model_files import MODEL_FORMATS
from analysis.exchange._source import TargetError
from analysis.exchange._table import frf_table, record_table
from analysis.report.folder import OutputError, check_new_file

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator
    from pathlib import Path
    from typing import BinaryIO

    from analysis.exchange._table import ExportTable
    from analysis.linear_model import LinearModel, ModelOptions
    from analysis.models import WelchSettings

_UNIVERSAL: Final = (".uff", ".unv", ".uf58")
SUFFIXES: Final = (".csv", ".mat", *_UNIVERSAL)
"""Endings of the files that can be written."""


def export_record(session: Path, target: Path, *, binary: bool = False) -> ExportTable:
    """Write the samples of a session as they were recorded.

    Parameters
    ----------
    session : Path
    target : Path
        A new file; its ending, one of `SUFFIXES`, is its format.
    binary : bool
        Write a universal file's numbers as 8-byte floats instead of text.

    Returns
    -------
    ExportTable
        What was written.

    Raises
    ------
    TargetError
        If the ending is unknown, or `binary` is not for it.
    ExchangeError
        If the record does not fit the format, or a library is missing.
    analysis.report.folder.OutputExistsError, analysis.report.folder.OutputError
        If the file exists or cannot be written.
    rigd.session.SessionError
        If the session cannot be read.

    Examples
    --------
    >>> from pathlib import Path
    >>> from analysis.exchange import export_record
    >>> table = export_record(Path("session.mcap"), Path("record.csv"))
    >>> [column.name for column in table.columns][:3]
    ['tick', 'angle_reference_rad', 'angle_rad']
    """
    check_target(target, binary=binary)
    table = record_table(session)
    _write(table, target, binary=binary)
    return table


def export_frf(
    session: Path,
    target: Path,
    settings: WelchSettings,
    band_hz: tuple[float, float] | None = None,
    *,
    binary: bool = False,
) -> ExportTable:
    """Write the frequency response that an analysis with these settings and band would fit.

    Otherwise as `export_record`; the analysis' own errors come on top.

    Parameters
    ----------
    session, target, binary
        As for `export_record`.
    settings : WelchSettings
        Estimator and segments.
    band_hz : tuple of float, optional
        First and last frequency; by default what suits the record.
    """
    check_target(target, binary=binary)
    table = frf_table(session, settings, band_hz)
    _write(table, target, binary=binary)
    return table


def export_model(
    source: Path,
    target: Path,
    options: ModelOptions,
    on_step: Callable[[str], None] = lambda _step: None,
) -> LinearModel:
    """Write a linear model of the antenna: the modal model, and a state space.

    Parameters
    ----------
    source : Path
        A session, which is analysed, or the document of ``analyze --json``.
    target : Path
        A new file; its ending, one of `MODEL_FORMATS`, is its format.
    options : ModelOptions
        Which model, which input, how many states.
    on_step : callable, optional
        Called with a few words before each step.

    Returns
    -------
    LinearModel
        What was written.

    Raises
    ------
    TargetError
        If the ending is unknown.
    analysis.report.folder.OutputExistsError, analysis.report.folder.OutputError
        If the file exists or cannot be written.
    analysis.linear_model.LinearModelError, rigd.identified_beam.IdentifiedBeamError
        If there is no such model, or it cannot be realised.
    rigd.session.SessionError, analysis.record.RecordError, analysis.identify.MeasurementError
        If the session cannot be read or analysed.
    """
    from analysis.linear_model import identified_in_document, identified_in_session, linear_model

    _check_ending(target, MODEL_FORMATS)
    check_new_file(target, "The file")
    is_session = source.suffix.lower() == ".mcap"
    on_step("analysis" if is_session else "document")
    found = identified_in_session(source) if is_session else identified_in_document(source)
    model = linear_model(found, options, on_step)
    on_step("file")
    variables = {**model.variables(), "exported_by": f"rigd {rigd.__version__}"}
    with _new_file(target) as stream:
        MODEL_FORMATS[target.suffix.lower()](variables, stream)
    return model


def check_target(target: Path, *, binary: bool) -> None:
    """Refuse what cannot be written, before anything is computed."""
    _check_ending(target, SUFFIXES)
    suffix = target.suffix.lower()
    if binary and suffix not in _UNIVERSAL:
        raise TargetError(
            f"{target}: --binary is for universal files ({', '.join(_UNIVERSAL)}); leave it out."
        )
    check_new_file(target, "The file")


def _check_ending(target: Path, endings: Collection[str]) -> None:
    if target.suffix.lower() not in endings:
        raise TargetError(
            f"{target}: the ending selects the format; choose one of {', '.join(endings)}."
        )


def _write(table: ExportTable, target: Path, *, binary: bool) -> None:
    with _new_file(target) as stream:
        match target.suffix.lower():
            case ".csv":
                from analysis.exchange._csv_format import write_csv

                write_csv(table, stream)
            case ".mat":
                from analysis.exchange._matlab_format import write_mat

                write_mat(table, stream)
            case _:
                from analysis.exchange._uff_format import write_uff58

                write_uff58(table, stream, binary=binary)


@contextmanager
def _new_file(path: Path) -> Iterator[BinaryIO]:
    """Open a new file that vanishes again if it cannot be completed."""
    try:
        stream = path.open("xb")
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror or error}.") from error
    try:
        with stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
    except BaseException as error:
        path.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise OutputError(f"{path} cannot be written: {error.strerror or error}.") from error
        raise
