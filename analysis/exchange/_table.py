"""Tables for export, the same for every file format: named columns with units and a common axis."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

import rigd
from analysis.applicability import highest_frequency_hz, welch_settings
from analysis.exchange._source import ExchangeError
from analysis.paper import estimate
from analysis.record import load_record
from analysis.record_part import part_of_session, read_session_part
from rigd.session.layout import SAMPLE_FIELDS
from rigd.session.limits import MAX_SAMPLES
from rigd.units import unit_of

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from analysis.models import WelchSettings
    from analysis.record_part import PartOption


@dataclass(frozen=True, slots=True)
class ExportColumn:
    """Column of a table for export: values of one quantity.

    Attributes
    ----------
    name : str
        Name with the unit as its suffix.
    title : str
        Title in ASCII; that of a ratio is two texts of at most 20 characters with " / " between.
    unit : str
        Unit in ASCII; empty for a number without a unit.
    values : ndarray, shape (n,)
        Integers, floats or complex numbers.
    """

    name: str
    title: str
    unit: str
    values: NDArray[np.generic]


@dataclass(frozen=True, slots=True)
class ExportTable:
    """Table to be exported: columns of values at common times or frequencies.

    Attributes
    ----------
    source : str
        Name of the session file.
    axis : ExportColumn
        Time or frequency, increasing.
    columns : tuple of ExportColumn
        Columns of the table.
    information : mapping of str to str
        Metadata of the session or the estimate, for formats that can store them.
    """

    source: str
    axis: ExportColumn
    columns: tuple[ExportColumn, ...]
    information: Mapping[str, str]


_COLUMN_TITLES: Final = {
    "tick": "Tick",
    "angle_reference_rad": "Angle reference",
    "angle_rad": "Angle",
    "torque_command_nm": "Torque command",
    "coupling_torque_nm": "Coupling torque",
    **{f"f{axis}_n": f"Force {axis}" for axis in "xyz"},
    **{f"t{axis}_nm": f"Torque {axis}" for axis in "xyz"},
    "status": "Status bits",
}
"""Title of each exported field of a sample."""


def record_table(path: Path, part_s: PartOption | None = None) -> ExportTable:
    """Return the samples of a session as recorded, with gaps, and the status bits as a column.

    `part_s` is a part of the session, as for `analysis.record.load_record`. Raise `SessionError` if
    the file cannot be read. Raise `ExchangeError` if the session has no samples or no sampling
    rate. Raise `RecordError` if the part is not in the record.
    """
    session, _ = read_session_part(
        path, part_s, fields=("t_ns", *_COLUMN_TITLES), max_samples=MAX_SAMPLES
    )
    rate_hz = session.number("rate_hz")
    if len(session.samples) == 0 or not rate_hz > 0.0:
        raise ExchangeError(
            f"{path}: the session has {len(session.samples)} samples at {rate_hz:g} Hz; there is "
            "nothing to export."
        )
    if part_s is not None:
        session, _ = part_of_session(session, part_s, rate_hz, needs_sweep=False)
    session_samples = session.samples
    return ExportTable(
        path.name,
        ExportColumn("time_s", "Time", "s", session_samples["tick"] / rate_hz),
        tuple(
            ExportColumn(
                field_name,
                _COLUMN_TITLES[field_name],
                _ascii_unit(field_name),
                session_samples[field_name],  # a view: copies would take as much memory again
            )
            for field_name in SAMPLE_FIELDS
            if field_name in _COLUMN_TITLES
        ),
        {**session.metadata, **_segment_texts(session.segments), **_file_origin_information(path)},
    )


def frf_table(
    path: Path, settings: WelchSettings, band_hz: tuple[float, float] | None = None
) -> ExportTable:
    """Estimate the response from angle to coupling torque, as in the analysis of a session.

    The response is corrected for the channels' delays, but not for the tool inertia. The default
    band is that of the settings, limited by the record's sampling rate. Raise `SessionError`,
    `RecordError` or `FrequencyResponseError` if the session cannot be read or analysed.
    """
    record = load_record(path, highest_hz=highest_frequency_hz(band_hz))
    settings = welch_settings(record, settings, band_hz)
    response, _ = estimate(record, settings)
    export_columns = [
        ExportColumn("response_nm_per_rad", "Coupling torque / Angle", "N.m/rad", response.response)
    ]
    if response.coherence is not None:
        export_columns.append(ExportColumn("coherence", "Coherence", "", response.coherence))
    segmentation = settings.segmentation(record.rate_hz)
    welch_lengths = {} if settings.estimator == "fft" else asdict(segmentation)
    return ExportTable(
        path.name,
        ExportColumn("frequency_hz", "Frequency", "Hz", response.frequency_hz),
        tuple(export_columns),
        {
            "estimator": response.estimator,
            "segments": str(response.segments),
            **{
                f"{length_name}_samples": str(sample_count)
                for length_name, sample_count in welch_lengths.items()
            },
            "rate_hz": repr(record.rate_hz),
            "angle_delay_removed_s": repr(record.angle_delay_s),
            "torque_delay_removed_s": repr(record.torque_delay_s),
            "tool_inertia_included_kg_m2": repr(record.tool_inertia_kg_m2),
            "beam_length_m": repr(record.beam.length_m),
            "beam_density_kg_per_m": repr(record.beam.density_kg_per_m),
            "beam_bending_stiffness_n_m2": repr(record.beam.bending_stiffness_n_m2),
            **_file_origin_information(path),
        },
    )


def _ascii_unit(column_name: str) -> str:
    """Return the unit of a field in ASCII, as written to files."""
    return unit_of(column_name).replace("·", ".")


def _segment_texts(segments: Mapping[str, tuple[int, int]]) -> dict[str, str]:
    """Return first and end tick of each segment as text."""
    return {
        f"segment_{segment_name}_ticks": f"{first_tick},{end_tick}"
        for segment_name, (first_tick, end_tick) in segments.items()
    }


def _file_origin_information(path: Path) -> dict[str, str]:
    """Return the names of the session file and of the exporting program."""
    return {"session_file": path.name, "exported_by": f"rigd {rigd.__version__}"}
