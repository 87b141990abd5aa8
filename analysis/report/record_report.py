"""Report of one record: an HTML page, and a folder with figures, tables, text and JSON."""

from __future__ import annotations

from contextlib import suppress
from datetime import UTC, datetime
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING, Final

from analysis.models import ESTIMATOR_NAMES
from analysis.report import _fit_tables as fit_tables
from analysis.report import _record_tables as tables
from analysis.report._document import document, document_text
from analysis.report._equation import definitions, equations, latex, mathml, types_table
from analysis.report._text import damping_sentences, tables_text
from analysis.report._uniformity import uniformity_table
from analysis.report.folder import (
    UNIFORMITY_FIGURE,
    WELCH_FIGURES,
    sha256,
    welch_figure_names,
    write_new_file,
)
from analysis.report.table import Table, csv_text, latex_table, with_validity
from analysis.results import DEFAULT_FORMATS
from rigd.spectral import WINDOW

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

    from analysis.paper.welch_analysis import WelchAnalysis
    from analysis.record import Record
    from analysis.report._page import FactGroup
    from analysis.report._style import Illustration, Picture
    from analysis.results import FigureFormat, ImagesByName, RecordResult, WholeRecord

# Page


def record_page(
    result: RecordResult,
    pictures: Sequence[Picture],
    mode_table: Table,
    record_tables: Sequence[Table],
    made_at: datetime,
    paper_pictures: Sequence[Picture] = (),
    paper_tables: Sequence[Table] = (),
) -> str:
    """Return the HTML page with the results of one record.

    Parameters
    ----------
    result : RecordResult
        Results of the record, with whole-record fits.
    pictures : sequence of Picture
        Figures of the whole-record fits. The table of modes follows the first figure.
    mode_table : Table
        Table of the modes.
    record_tables : sequence of Table
        Tables of the whole-record fits.
    made_at : datetime
        Date and time of the report, with a time zone.
    paper_pictures : sequence of Picture, optional
        Figures of the Welch fits.
    paper_tables : sequence of Table, optional
        Tables of the Welch fits. Without tables, the section of the Welch fits is omitted.

    Returns
    -------
    str
        HTML document that refers to no other files.
    """
    from analysis.report._page import render_page, version_facts

    whole_record = result.whole
    assert whole_record is not None
    other_pictures = [picture for picture in pictures if picture.name != UNIFORMITY_FIGURE]
    uniformity_test = whole_record.headline.uniform_beam
    return render_page(
        "record.html",
        title=result.name,
        session=_session_lines(result.record),
        note=result.record.metadata.get("note"),
        first=damping_sentences(whole_record.headline),
        sentences=whole_record.verdict.sentences,
        experiments=whole_record.verdict.experiments,
        warnings=result.warnings,
        pictures=other_pictures,
        uniformity=None
        if uniformity_test is None
        else {
            "sentence": uniformity_test.summary.sentence,
            "pictures": [picture for picture in pictures if picture.name == UNIFORMITY_FIGURE],
            "tables": uniformity_tables(whole_record),
        },
        equations=[mathml(picture_or_formula) for picture_or_formula in equations(whole_record)],
        definitions=definitions(whole_record),
        types=types_table(whole_record),
        modes=mode_table,
        tables=record_tables,
        paper_pictures=paper_pictures,
        paper_tables=paper_tables,
        how=[*_collect_facts(result, whole_record), version_facts(made_at)],
    )


def _session_lines(record: Record) -> list[str]:
    """Return lines that state start, outcome, specimen and operator of the session."""
    record_metadata = record.metadata
    fact_lines = [
        f"{key}: {record_metadata[key]}"
        for key in ("specimen", "operator")
        if record_metadata.get(key)
    ]
    part_lines = [] if record.part_text is None else [f"analysed: {record.part_text}"]
    return [
        *_start_lines(record_metadata), f"outcome {record.outcome}", *part_lines, *fact_lines,
    ]  # fmt: skip


def _start_lines(metadata: Mapping[str, str]) -> list[str]:
    """Return a list of one line with the session's start time; empty if the file states none."""
    try:
        start_utc_s = int(metadata["start_utc_ns"]) / 1e9
        start_time = datetime.fromtimestamp(start_utc_s, UTC)
    except (KeyError, ValueError, OverflowError, OSError):
        return []
    return [f"recorded {start_time:%Y-%m-%d %H:%M:%S} UTC"]


_METADATA_SHOWN_ELSEWHERE = frozenset(
    (
        "rate_hz", "beam_length_m", "beam_density_kg_per_m", "beam_bending_stiffness_n_m2",
        "tool_inertia_kg_m2", "angle_delay_s", "torque_delay_s",
    )
)  # fmt: skip
"""Keys of metadata that the page shows in another section."""


def _collect_facts(result: RecordResult, whole_record: WholeRecord) -> list[FactGroup]:
    """Return groups of facts on file, record, session and settings, for the HTML page."""
    record, welch_analysis = result.record, result.welch
    return [
        ("File", _file_facts(record.path)),
        ("Record", _record_facts(record)),
        (
            "Session, as the file states it",
            [
                (key, value)
                for key, value in record.metadata.items()
                if key not in _METADATA_SHOWN_ELSEWHERE
            ],
        ),
        ("Whole-record fits", _record_fit_facts(whole_record)),
        *(
            []
            if welch_analysis is None
            else [("Welch method (as in the paper)", _welch_facts(welch_analysis))]
        ),
    ]


def _file_facts(path: Path) -> list[tuple[str, str]]:
    """Return facts (name, text) on a file: path, size and checksum."""
    file_facts = [("path", str(path))]
    with suppress(OSError):  # the file may have been removed since it was analysed
        file_facts += [("size", f"{path.stat().st_size} bytes"), ("SHA-256", sha256(path))]
    return file_facts


def _record_facts(record: Record) -> list[tuple[str, str]]:
    """Return facts (name, text) on a record: outcome, samples, beam, latencies and gaps."""
    stated_beam, sample_gaps = record.beam, record.gaps
    full_rate = record.full_rate
    decimation_text = (
        "" if record.decimated_from is None else f", analysed at {record.rate_hz:g} Hz"
    )
    flag_counts_text = ", ".join(
        f"{flag_count} × {flag_meaning}" for flag_meaning, flag_count in record.flags.items()
    )
    return [
        ("outcome", record.outcome),
        ("analysed", record.part_text or "the whole session"),
        (
            "samples",
            f"{full_rate.samples} at {full_rate.rate_hz:g} Hz, "
            f"{full_rate.samples / full_rate.rate_hz:.6g} s{decimation_text}",
        ),
        ("sweep", f"samples {full_rate.sweep.start} to {full_rate.sweep.stop - 1}"),
        ("beam length", f"{stated_beam.length_m:g} m"),
        ("beam density", f"{stated_beam.density_kg_per_m:g} kg/m"),
        ("bending stiffness", f"{stated_beam.bending_stiffness_n_m2:g} N·m²"),
        ("tool inertia", f"{record.tool_inertia_kg_m2:g} kg·m²"),
        ("measurement latency of the angle", f"{1e3 * record.angle_delay_s:g} ms"),
        ("measurement latency of the torque", f"{1e3 * record.torque_delay_s:g} ms"),
        (
            "missing ticks",
            f"{sample_gaps.missing_ticks}, {sample_gaps.sweep_missing_ticks} of them in the sweep",
        ),
        (
            "stale values in the sweep",
            f"{sample_gaps.sweep_stale_angles} of the angle, {sample_gaps.sweep_stale_torques} of "
            "the torque",
        ),
        ("flags in the sweep", flag_counts_text or "none"),
    ]


def _record_fit_facts(whole_record: WholeRecord) -> list[tuple[str, str]]:
    """Return facts (name, text) on the whole-record fits: estimator, band, types, fixed values."""
    first_hz, last_hz = whole_record.band_hz
    hum_texts = [
        f"{hum_line.frequency_hz:.5g} Hz, {1e3 * hum_line.amplitude_nm:.3g} mN·m"
        for hum_line in whole_record.analysis.lines
    ]
    return [
        (
            "estimator",
            "output error on the whole record: the torque that a model (modal model; Eq. 25) gives "
            "for the measured angle minus the measured torque, whitened by the noise model; "
            "maximum likelihood for noise in the torque",
        ),
        ("band", f"{first_hz:g} to {last_hz:g} Hz, {whole_record.analysis.frequency_hz.size} bins"),
        ("types", ", ".join(whole_record.fits)),
        ("fixed at the file's values", ", ".join(whole_record.fixed_parameters) or "none"),
        ("narrow-band disturbances removed", "; ".join(hum_texts) or "none found"),
        (
            "intervals and bands",
            "95 %, from the covariance of the parameters at the minimum; curves by linearisation",
        ),
    ]


def _welch_facts(analysis: WelchAnalysis) -> list[tuple[str, str]]:
    """Return facts (name, text) on the Welch fits: estimator, band, types and segments."""
    settings, segmentation, response = analysis.settings, analysis.segmentation, analysis.response
    first_hz, last_hz = settings.band_hz
    welch_facts = [
        ("estimator", ESTIMATOR_NAMES[settings.estimator]),
        ("band", f"{first_hz:g} to {last_hz:g} Hz, {len(response.frequency_hz)} bins"),
        ("types", ", ".join(settings.types)),
        ("weights", ", ".join(settings.weightings)),
    ]
    if settings.estimator == "iv":
        welch_facts.append(("instrument", "the reference"))
    if settings.estimator != "fft":
        welch_facts.append(
            (
                "segments",
                f"{response.segments} of {segmentation.segment_length} samples ({WINDOW.name}), "
                f"overlap {segmentation.overlap}, nfft {segmentation.nfft}",
            )
        )
    return welch_facts


# Folder

_WELCH_DESCRIPTION: Final = (
    "Frequency response by Welch's method, as in the paper, with the fits of each type and "
    "weighting, and the coherence."
)
"""Caption of the Welch fits' figures."""


_LATEX_TABLES: Final = ("modes", "parameters")
"""Tables that are also written as LaTeX."""


def _write_page(
    result: RecordResult,
    whole_record: WholeRecord,
    folder: Path,
    pictures: Sequence[Picture],
    paper_pictures: Sequence[Picture],
) -> None:
    """Write the page of a record's report, ``report.html``, and the files in ``tables/``."""
    mode_table, record_tables, paper_tables = report_tables(result)
    for report_table in (
        mode_table,
        *uniformity_tables(whole_record),
        *record_tables,
        *paper_tables,
    ):
        result_table = with_validity(report_table, result.validity)
        write_new_file(folder / "tables" / f"{result_table.name}.csv", csv_text(result_table))
        if result_table.name in _LATEX_TABLES:
            write_new_file(
                folder / "tables" / f"{result_table.name}.tex", latex_table(result_table)
            )
    write_new_file(folder / "tables" / "model.tex", latex(equations(whole_record)))
    made_at = datetime.now().astimezone()
    page_html = record_page(
        result, pictures, mode_table, record_tables, made_at, paper_pictures, paper_tables
    )
    write_new_file(folder / "report.html", page_html)


def uniformity_tables(whole_record: WholeRecord) -> tuple[Table, ...]:
    """Return the tables of the test of the beam's uniformity; empty if there was no test."""
    uniformity_test = whole_record.headline.uniform_beam
    if uniformity_test is None or uniformity_test.p_value is None:
        return ()
    exact_modes = tables.exact_modes_table(whole_record)
    return (uniformity_table(uniformity_test), *(() if exact_modes is None else (exact_modes,)))


def report_tables(result: RecordResult) -> tuple[Table, tuple[Table, ...], tuple[Table, ...]]:
    """Return the table of modes, the tables of whole-record fits, and the tables of Welch fits."""
    whole_record, welch_analysis = result.whole, result.welch
    assert whole_record is not None
    condition_tables = (
        tables.exact_geometry_table(whole_record),
        tables.simpler_structure_table(whole_record),
    )
    record_tables = (
        tables.loss_factors_table(whole_record),
        tables.parameters_table(whole_record),
        *(table for table in condition_tables if table is not None),
        tables.correlations_table(whole_record),
        *tables.amplitude_tables(whole_record),
        fit_tables.structures_table(whole_record),
        *fit_tables.added_structures_tables(whole_record),
    )
    paper_tables = (
        ()
        if welch_analysis is None
        else (
            fit_tables.welch_fits_table(welch_analysis, whole_record.unsupported_orders),
            fit_tables.peaks_table(welch_analysis),
        )
    )
    return tables.modes_table(whole_record), record_tables, paper_tables


_FIRST_FIGURES: Final = 2
"""Number of a whole record's figures that are drawn while another process makes the Welch fits."""


def write_report(
    result: RecordResult,
    folder: Path,
    on_step: Callable[[str], None] = lambda _step_text: None,
    formats: Sequence[FigureFormat] = DEFAULT_FORMATS,
    drawn_images: ImagesByName | None = None,
) -> None:
    """Write the report of a record into a folder.

    It consists of ``figures/``, ``tables.txt``, ``analysis.json`` and, with whole-record fits, the
    page ``report.html`` and ``tables/``. All file names are in lower case with underscores:
    ``figures/NAME.png``, ``.svg``, ``.pdf``; ``tables/NAME.csv``, ``.tex``.

    Parameters
    ----------
    result : RecordResult
        Results of the record.
    folder : Path
        Existing folder that contains none of these files.
    on_step : callable, optional
        Function that is called after each figure with a short text.
    formats : sequence of str
        Formats of the figures.
    drawn_images : mapping, optional
        Figures that `draw_welch_figures` or `draw_first_figures` has drawn already.

    Raises
    ------
    OutputExistsError, OutputError
        If a file exists or cannot be written.
    """
    from analysis.report._style import save_pictures

    whole_record = result.whole
    paper_illustrations = (
        []
        if result.welch is None
        else list(_welch_illustrations(result.welch, has_whole_record=whole_record is not None))
    )
    illustrations = paper_illustrations
    if whole_record is not None:
        from analysis.report._record_figures import illustrations as record_illustrations

        illustrations = [*paper_illustrations, *record_illustrations(whole_record)]
    pictures = save_pictures(illustrations, folder / "figures", formats, on_step, drawn_images)
    write_new_file(folder / "tables.txt", tables_text(result))
    if whole_record is not None:
        paper_figure_count = len(paper_illustrations)
        _write_page(
            result,
            whole_record,
            folder,
            pictures[paper_figure_count:],
            pictures[:paper_figure_count],
        )
    write_new_file(folder / "analysis.json", document_text(document([result])))


def draw_welch_figures(
    analysis: WelchAnalysis,
    formats: Sequence[FigureFormat] = DEFAULT_FORMATS,
    on_step: Callable[[str], None] = lambda _step_text: None,
) -> ImagesByName:
    """Draw the Welch fits' figures of a report with whole-record fits, before these are known.

    Parameters
    ----------
    analysis : WelchAnalysis
        Welch fits.
    formats : sequence of str
        Formats of the figures.
    on_step : callable, optional
        Function that is called after each figure with a short text.

    Returns
    -------
    dict
        Image files by the figure's name and the format.
    """
    from analysis.report._style import draw_images

    welch_images = draw_images(
        _welch_illustrations(analysis, has_whole_record=True), formats, on_step
    )
    # The rest of the report is imported now, because this process waits for the fits next.
    from analysis.report import _page, _record_figures  # noqa: F401

    return welch_images


def draw_first_figures(
    whole_record: WholeRecord,
    formats: Sequence[FigureFormat] = DEFAULT_FORMATS,
    on_step: Callable[[str], None] = lambda _step_text: None,
) -> ImagesByName:
    """Draw the first figures of a whole record in the time that the Welch fits take.

    Parameters
    ----------
    whole_record : WholeRecord
        Fits to the whole record.
    formats : sequence of str
        Formats of the figures.
    on_step : callable, optional
        Function that is called after each figure with a short text.

    Returns
    -------
    dict
        Image files by the figure's name and the format.
    """
    from analysis.report._record_figures import illustrations
    from analysis.report._style import draw_images

    return draw_images(islice(illustrations(whole_record), _FIRST_FIGURES), formats, on_step)


def _welch_illustrations(
    analysis: WelchAnalysis, *, has_whole_record: bool
) -> Iterator[Illustration]:
    """Yield the figures of the Welch fits."""
    from analysis.report._frf_figure import frf_figure
    from analysis.report._signal_figures import paper_signals_figure, torque_figure
    from analysis.report._style import Illustration

    drawing_functions = dict(
        zip(WELCH_FIGURES, (paper_signals_figure, frf_figure, torque_figure), strict=True)
    )
    for name in welch_figure_names(with_paper_figures=True, has_whole_record=has_whole_record):
        yield Illustration(name, partial(drawing_functions[name], analysis), _WELCH_DESCRIPTION)
