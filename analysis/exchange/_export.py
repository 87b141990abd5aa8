"""Export of a session's record, frequency response or model to a file for another program."""

from __future__ import annotations

import os
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

import rigd
from analysis.exchange._model_files import MODEL_FORMATS
from analysis.exchange._source import TargetError
from analysis.exchange._table import frf_table, record_table
from analysis.report.folder import OutputError, check_new_file

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator
    from typing import BinaryIO

    from analysis.exchange._table import ExportTable
    from analysis.linear_model import LinearModel, ModelOptions
    from analysis.models import WelchSettings
    from analysis.record_part import PartOption

_UNIVERSAL_SUFFIXES: Final = (".uff", ".unv", ".uf58")
"""Suffixes of universal files."""
SUFFIXES: Final = (".csv", ".mat", *_UNIVERSAL_SUFFIXES)
"""Suffixes of the files to which records and frequency responses can be written."""


def export_record(
    session: Path | str,
    target: Path | str,
    *,
    binary: bool = False,
    part_s: PartOption | None = None,
) -> ExportTable:
    """Write the samples of a session, as recorded, to a file for another program.

    Parameters
    ----------
    session : Path or str
        Session file.
    target : Path or str
        New file, whose suffix (one of `SUFFIXES`) selects the format.
    binary : bool
        Whether a universal file has 8-byte floats instead of text.
    part_s : tuple of float or None, optional
        Beginning and end of the part to be written, in seconds since the session's start; None for
        the session's beginning or end. By default, all samples are written.

    Returns
    -------
    ExportTable
        Table that was written.

    Raises
    ------
    TargetError
        If the suffix is unknown, or its format does not support `binary`.
    ExchangeError
        If the record does not fit the format, or a library is missing.
    analysis.report.folder.OutputExistsError, analysis.report.folder.OutputError
        If the file exists or cannot be written.
    rigd.session.SessionError
        If the session cannot be read.
    analysis.record.RecordError
        If the part is not in the record.

    Examples
    --------
    >>> from analysis.exchange import export_record
    >>> table = export_record("session.mcap", "record.csv")
    >>> [column.name for column in table.columns][:3]
    ['tick', 'angle_reference_rad', 'angle_rad']
    """
    session, target = Path(session), Path(target)
    check_target(target, binary=binary)
    table = record_table(session, part_s)
    _write_table(table, target, binary=binary)
    return table


def export_frf(
    session: Path | str,
    target: Path | str,
    settings: WelchSettings,
    band_hz: tuple[float, float] | None = None,
    *,
    binary: bool = False,
) -> ExportTable:
    """Write the estimated frequency response of a session to a file for another program.

    An analysis with the same settings and band fits the same response. The function raises the
    errors of `export_record` and those of the estimate.

    Parameters
    ----------
    session, target, binary
        Session, new file and number format, as for `export_record`.
    settings : WelchSettings
        Estimator and segments.
    band_hz : tuple of float, optional
        First and last frequency; by default chosen for the record.
    """
    session, target = Path(session), Path(target)
    check_target(target, binary=binary)
    table = frf_table(session, settings, band_hz)
    _write_table(table, target, binary=binary)
    return table


def export_model(
    source: Path | str,
    target: Path | str,
    options: ModelOptions | None = None,
    on_step: Callable[[str], None] = lambda _step: None,
) -> LinearModel:
    """Write a linear model of the flexible beam to a file: modal model and state-space matrices.

    Parameters
    ----------
    source : Path or str
        Session file, which is analysed, or the document of ``analyze --json``.
    target : Path or str
        New file, whose suffix (a key of `MODEL_FORMATS`) selects the format.
    options : ModelOptions, optional
        Kind of model, input, and number of states.
    on_step : callable, optional
        Called before each step with the name of the step.

    Returns
    -------
    LinearModel
        Model that was written.

    Raises
    ------
    TargetError
        If the suffix is unknown.
    analysis.report.folder.OutputExistsError, analysis.report.folder.OutputError
        If the file exists or cannot be written.
    analysis.linear_model.LinearModelError, rigd.identified_beam.IdentifiedBeamError
        If the source has no such model, or the model cannot be realised.
    rigd.session.SessionError, analysis.record.RecordError, analysis.identify.MeasurementError
        If the session cannot be read or analysed.
    """
    from analysis.linear_model import (
        ModelOptions,
        identify_session,
        linear_model,
        read_identified_model,
    )

    source, target = Path(source), Path(target)
    _check_suffix(target, MODEL_FORMATS)
    check_new_file(target, "The file")
    is_session_file = source.suffix.lower() == ".mcap"
    on_step("analysis" if is_session_file else "document")
    identified_model = (
        identify_session(source) if is_session_file else read_identified_model(source)
    )
    model = linear_model(identified_model, options or ModelOptions(), on_step)
    on_step("file")
    variables = {**model.variables(), "exported_by": f"rigd {rigd.__version__}"}
    with _open_new_file(target) as stream:
        MODEL_FORMATS[target.suffix.lower()](variables, stream)
    return model


def check_target(target: Path, *, binary: bool) -> None:
    """Raise an error if a record or response cannot be written to a file.

    The error is TargetError for an unsuitable suffix, or that of `check_new_file`. The check is
    made before anything is computed.
    """
    _check_suffix(target, SUFFIXES)
    suffix = target.suffix.lower()
    if binary and suffix not in _UNIVERSAL_SUFFIXES:
        raise TargetError(
            f"{target}: --binary is for universal files ({', '.join(_UNIVERSAL_SUFFIXES)}); leave "
            "it out."
        )
    check_new_file(target, "The file")


def _check_suffix(target: Path, suffixes: Collection[str]) -> None:
    """Raise TargetError if the suffix of a file is not one of the given suffixes."""
    if target.suffix.lower() not in suffixes:
        raise TargetError(
            f"{target}: the ending selects the format; choose one of {', '.join(suffixes)}."
        )


def _write_table(table: ExportTable, target: Path, *, binary: bool) -> None:
    """Write a table to a new file in the format of its suffix."""
    with _open_new_file(target) as stream:
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
def _open_new_file(path: Path) -> Iterator[BinaryIO]:
    """Open a new file for writing; the file is removed if writing fails."""
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
