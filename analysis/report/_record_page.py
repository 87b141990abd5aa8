"""The page on a record: verdict, figures, tables, and how it was computed, in one file."""

from __future__ import annotations

import hashlib
import math
import platform
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Final

import matplotlib as mpl
import numpy as np

import rigd
from analysis.identify import MISREAD, fast_length
from analysis.models import ESTIMATOR_WORDS
from analysis.report._bands import supported_band_hz
from analysis.report._html import Markup, element, joined, section, table, void
from analysis.report._table import estimate
from rigd.beam import undamped_frequencies_rad_s
from rigd.spectral import fft_response

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from datetime import datetime
    from pathlib import Path

    from matplotlib.figure import Figure

    from analysis.identify import Headline, Mode, Quantity, Size
    from analysis.paper import WelchAnalysis
    from analysis.record import Record
    from analysis.report._table import Table
    from analysis.results import Subject
    from rigd.spectral import FrequencyResponse

_SMALL: Final = 1e-3
"""Sizes below are told in the power of ten that zeta has in the paper."""

_SYMBOLS: Final = {
    "internal": ("ζ", "", "zeta", "alpha", "α"),
    "external": ("γ", " 1/m⁴", "gamma", "lambda", "λ"),
}


def damping_sentences(told: Headline) -> tuple[str, ...]:
    """Say how the modes are damped, and by which internal and external damping.

    Of modes that the record does not show nothing is said, nor of any where no number is the
    antenna's. Where part of the record is unexplained the numbers are named as what they would be,
    without intervals.

    Parameters
    ----------
    told : Headline

    Returns
    -------
    tuple of str
        95 % intervals in brackets.
    """
    found = []
    if any(mode.damping_ratio.flag == MISREAD for mode in told.modes):
        return ()
    shown = [_mode(mode) for mode in told.modes if mode.shown]
    if not told.explained:
        if not shown:
            return ()
        return (
            "Part of the record is unexplained. If that spoilt nothing, the antenna's damping "
            f"ratio would be {_listed(shown)}.",
        )
    if shown:
        found.append(
            f"The antenna's damping ratio is {_listed(shown)} (in brackets: 95 % intervals)."
        )
    found.extend(
        f"The {each.damping} damping {_size(each)}{_order(told, each)}."
        for each in told.sizes
        # A coefficient that holds for one assumed order says nothing of the antenna.
        if each.size.flag is None and (each.omega_rad_s is not None or not _flagged(told, each))
    )
    return tuple(found)


def _mode(mode: Mode) -> str:
    ratio = mode.damping_ratio
    return f"{_percent(ratio)} at {mode.frequency_hz.value:.4g} Hz"


def _percent(ratio: Quantity) -> str:
    value, low, high = estimate(
        (ratio.value, *(ratio.interval_95 or (None, None))), ratio.std, 100.0
    )
    if ratio.flag is not None:
        return f"{value.text} %"
    return f"{value.text} % ({low.text} to {high.text} %)"


def _size(each: Size) -> str:
    coefficient, unit, *_names = _SYMBOLS[each.damping]
    size = each.size
    factor, tenth = (1e5, " · 10⁻⁵") if size.value < _SMALL else (1.0, "")
    value, low, high = estimate((size.value, *(size.interval_95 or (None, None))), size.std, factor)
    bounds = f"{value.text} ({low.text} to {high.text}){tenth}"
    if each.omega_rad_s is None:
        return f"is {coefficient}\u00a0=\u00a0{bounds}{unit}"
    return f"has a loss factor of {bounds} at {each.omega_rad_s / (2 * math.pi):.3g} Hz"


def _flagged(told: Headline, each: Size) -> bool:
    """Whether coefficient and order of a damping carry a flag."""
    return told.parameters[_SYMBOLS[each.damping][2]].flag is not None


def _order(told: Headline, each: Size) -> str:
    *_others, name, symbol = _SYMBOLS[each.damping]
    order = told.parameters[name]
    if name not in told.fit.structure.free:
        return f", of the fixed order {symbol}\u00a0=\u00a0{order.value:g}"
    if order.interval_95 is None or order.flag is not None:
        return f"; its order {symbol} is not known"
    value, low, high = estimate((order.value, *order.interval_95), order.std)
    return f" and the order {symbol}\u00a0=\u00a0{value.text} ({low.text} to {high.text})"


def _listed(parts: list[str]) -> str:
    if len(parts) == 1:
        return parts[0]
    return f"{', '.join(parts[:-1])} and {parts[-1]}"


@dataclass(frozen=True, slots=True)
class Illustration:
    """A figure, the name of its files, and what is seen in it."""

    name: str
    figure: Figure
    description: str


NAMES = ("record_frf", "loss_factor", "residual", "record_signals")


def illustrations(subject: Subject) -> Iterator[Illustration]:
    """Draw the figures one after the other; within `style.styled`."""
    from analysis.report._record_figures import frf_figure, loss_figure, residual_figure
    from analysis.report._signal_figures import signals_figure

    name, highest_hz, shown = subject.name, subject.band_hz[1], subject.visible_modes
    # Details and lines are of modes that the record shows, not of what the model adds.
    fit = replace(subject.fit, modes=tuple(m for m in subject.fit.modes if m.number in shown))
    modes = ", ".join(f"{mode.frequency_hz:.3g}" for mode in subject.fit.modes)
    frf, loss, residual, signals = NAMES
    measured = measured_response(subject)
    yield Illustration(
        frf,
        frf_figure(name, measured, subject.fit),
        f"Frequency response from motor angle to coupling torque: magnitude and phase as measured "
        f"and of the model, half-width of the model's 95 % band, and details of the modes ({modes} "
        "Hz). The band is narrower than the line where it is not seen.",
    )
    yield Illustration(
        loss,
        loss_figure(
            name,
            fit,
            (float(measured.frequency_hz[0]), highest_hz),
            supported_band_hz(subject),
            withheld=subject.withheld,
        ),
        _loss_description(subject),
    )
    yield Illustration(
        residual,
        residual_figure(name, subject.analysis, fit),
        "What the model leaves of the torque: its spectrum beside what was taken for noise; its "
        "cumulative periodogram, which stays in the shaded range in 95 of 100 records or more if "
        "only noise is left; and its power through the record. Excess at a mode or at one time "
        "is what the model lacks.",
    )
    yield Illustration(
        signals,
        signals_figure(subject.record, fit, highest_hz),
        "Motor angle, coupling torque as measured and as the model makes it of the measured angle, "
        "and their difference; below, where each mode rings most.",
    )


def _loss_description(subject: Subject) -> str:
    if subject.withheld:
        return (
            "Loss factor of all damping against frequency with its 95 % band, and at each mode "
            "that shows (points: twice its damping ratio). It is drawn between these modes only, "
            "and not split into internal and external: elsewhere, and for either part, the result "
            "would follow from an order that the data do not support."
        )
    return (
        "Loss factor of internal, external and all damping against frequency with 95 % bands; at a "
        "mode it is about twice the damping ratio (points). Between the modes the model "
        "interpolates, outside them it extrapolates; where the torque does not stand out of the "
        "noise nothing is drawn."
    )


def measured_response(subject: Subject) -> FrequencyResponse:
    """Ratio of the whole record's transforms, from well below the first mode to the band's end.

    The delay between the channels is still in it.
    """
    record = subject.record
    angle = record.angle_rad - (record.rest_angle_rad or 0.0)
    response = fft_response(angle, record.torque_nm, record.rate_hz, fast_length(len(angle)))
    first_mode_hz = float(undamped_frequencies_rad_s(subject.fit.plant.beam, 1)[0]) / (2 * np.pi)
    first_hz, last_hz = subject.band_hz
    response = response.band(max(first_hz, min(first_mode_hz / 4, last_hz / 4)), last_hz)
    known = np.isfinite(response.response)
    return replace(
        response,
        frequency_hz=response.frequency_hz[known],
        response=response.response[known],
    )


_SHOWN_ALREADY = frozenset(
    (
        "rate_hz", "beam_length_m", "beam_density_kg_per_m", "beam_bending_stiffness_n_m2",
        "tool_inertia_kg_m2", "angle_delay_s", "torque_delay_s",
    )
)  # fmt: skip


def how_sections(subject: Subject, made_at: datetime) -> tuple[Markup, ...]:
    """Make a table of facts for each of file, record, session, settings and versions."""
    record = subject.record
    parts = [
        ("File", _file_facts(record.path)),
        ("Record", _record_facts(record)),
        (
            "Session, as the file states it",
            [(key, value) for key, value in record.metadata.items() if key not in _SHOWN_ALREADY],
        ),
        ("Whole-record fits", _record_fit_facts(subject)),
    ]
    if subject.welch is not None:
        parts.append(("The paper's route", _welch_facts(subject.welch)))
    parts.append(
        (
            "Versions",
            [
                ("report made", made_at.isoformat(timespec="seconds")),
                ("rigd", rigd.__version__),
                ("Python", platform.python_version()),
                ("numpy", np.__version__),
                ("matplotlib", mpl.__version__),
            ],
        )
    )
    return tuple(_facts(title, facts) for title, facts in parts if facts)


def sha256(path: Path) -> str | None:
    """Checksum of a file, None if it is not there any more."""
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError:
        return None


def _facts(title: str, facts: list[tuple[str, str]]) -> Markup:
    rows = [
        element("tr", element("th", name, scope="row"), element("td", value))
        for name, value in facts
    ]
    made = element("table", element("caption", title), element("tbody", *rows))
    return element("div", made, class_="table")


def _file_facts(path: Path) -> list[tuple[str, str]]:
    checksum = sha256(path)
    facts = [("path", str(path))]
    if checksum is not None:
        facts += [("size", f"{path.stat().st_size} bytes"), ("SHA-256", checksum)]
    return facts


def _record_facts(record: Record) -> list[tuple[str, str]]:
    beam, gaps = record.beam, record.gaps
    samples = len(record.time_s)
    flags = ", ".join(f"{count} × {meaning}" for meaning, count in record.flags.items())
    return [
        ("outcome", record.outcome),
        ("samples", f"{samples} at {record.rate_hz:g} Hz, {samples / record.rate_hz:.6g} s"),
        ("sweep", f"samples {record.sweep.start} to {record.sweep.stop - 1}"),
        ("beam length", f"{beam.length_m:g} m"),
        ("beam density", f"{beam.density_kg_per_m:g} kg/m"),
        ("bending stiffness", f"{beam.bending_stiffness_n_m2:g} N·m²"),
        ("inertia of the clamp", f"{record.tool_inertia_kg_m2:g} kg·m²"),
        ("age of the angle", f"{1e3 * record.angle_delay_s:g} ms"),
        ("age of the torque", f"{1e3 * record.torque_delay_s:g} ms"),
        ("missing ticks", f"{gaps.missing_ticks}, {gaps.sweep_missing_ticks} of them in the sweep"),
        (
            "stale values in the sweep",
            f"{gaps.sweep_stale_angles} of the angle, {gaps.sweep_stale_torques} of the torque",
        ),
        ("flags in the sweep", flags or "none"),
    ]


def _record_fit_facts(subject: Subject) -> list[tuple[str, str]]:
    first_hz, last_hz = subject.band_hz
    lines = [
        f"{line.frequency_hz:.5g} Hz, {1e3 * line.amplitude_nm:.3g} mN·m"
        for line in subject.analysis.lines
    ]
    return [
        (
            "estimator",
            "output error on the whole record: the torque that the exact model (Eq. 25) makes of "
            "the measured angle against the measured one, whitened with the noise found; maximum "
            "likelihood for noise in the torque",
        ),
        ("band", f"{first_hz:g} to {last_hz:g} Hz, {subject.analysis.frequency_hz.size} bins"),
        ("types", ", ".join(subject.fits)),
        ("fixed at the file's values", ", ".join(subject.fixed) or "none"),
        ("hum taken out", "; ".join(lines) or "none found"),
        (
            "intervals and bands",
            "95 %, from the covariance of the parameters at the minimum; curves by linearisation",
        ),
    ]


def _welch_facts(analysis: WelchAnalysis) -> list[tuple[str, str]]:
    settings, used, response = analysis.settings, analysis.segmentation, analysis.response
    first_hz, last_hz = settings.band_hz
    facts = [
        ("estimator", ESTIMATOR_WORDS[settings.estimator]),
        ("band", f"{first_hz:g} to {last_hz:g} Hz, {len(response.frequency_hz)} bins"),
        ("types", ", ".join(settings.types)),
        ("weights", ", ".join(settings.weightings)),
    ]
    if settings.estimator == "iv":
        facts.append(("instrument", "the reference"))
    if settings.estimator != "fft":
        facts.append(
            (
                "segments",
                f"{response.segments} of {used.segment_length} samples (Hamming), overlap "
                f"{used.overlap}, nfft {used.nfft}",
            )
        )
    return facts


STYLE: Final = Path(__file__).with_name("report.css")
_CONTENTS: Final = (
    ("verdict", "Verdict"),
    ("figures", "Figures"),
    ("tables", "Tables"),
    ("paper", "The paper's route"),
    ("how", "How it was computed"),
)


def page(
    subject: Subject,
    drawings: Sequence[Markup],
    modes: Table,
    tables: Iterable[Table],
    paper: Iterable[Markup | Table],
    made_at: datetime,
) -> str:
    """Put a report together.

    Parameters
    ----------
    subject : Subject
    drawings : sequence of Markup
        The figures; the table of the modes follows the first one.
    modes : Table
    tables : iterable of Table
        Of the whole-record fits.
    paper : iterable of Markup or Table
        Figures and tables of the paper's route; none leaves its section out.
    made_at : datetime
        When, with a time zone.

    Returns
    -------
    str
        An HTML document that refers to nothing outside it.
    """
    of_paper = [each if isinstance(each, Markup) else table(each) for each in paper]
    titles = {name: title for name, title in _CONTENTS if name != "paper" or of_paper}
    first, *others = drawings
    head = element(
        "head",
        void("meta", charset="utf-8"),
        void("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("title", f"{subject.name}: damping"),
        Markup(f"<style>\n{STYLE.read_text(encoding='utf-8')}</style>"),
    )
    links = [element("li", element("a", title, href=f"#{name}")) for name, title in titles.items()]
    body = element(
        "body",
        element("header", element("h1", subject.name), element("p", _session_line(subject))),
        element("nav", element("ul", *links), aria_label="Contents"),
        element(
            "main",
            _verdict(subject, titles["verdict"]),
            _warnings(subject),
            section("figures", titles["figures"], first, table(modes), *others),
            section("tables", titles["tables"], *map(table, tables)),
            section("paper", titles["paper"], *of_paper) if of_paper else "",
            section("how", titles["how"], *how_sections(subject, made_at)),
        ),
    )
    return f"<!DOCTYPE html>\n{element('html', head, body, lang='en')}\n"


def _verdict(subject: Subject, title: str) -> Markup:
    damping = [
        element("p", sentence, class_="damping") for sentence in damping_sentences(subject.headline)
    ]
    said = [element("p", sentence) for sentence in subject.verdict.sentences]
    advice = [element("li", sentence) for sentence in subject.verdict.experiments]
    more = [element("p", "What would tell more:"), element("ul", *advice)] if advice else []
    return section("verdict", title, *damping, *said, *more)


def _warnings(subject: Subject) -> Markup:
    if not subject.warnings:
        return Markup("")
    items = [element("li", warning) for warning in subject.warnings]
    return section("warnings", "Read this too", element("ul", *items))


def _session_line(subject: Subject) -> Markup:
    """Say whose session it is, as far as the file does."""
    metadata = subject.record.metadata
    parts = [*_start(metadata), f"outcome {subject.record.outcome}"]
    parts += [f"{key}: {metadata[key]}" for key in ("specimen", "operator") if metadata.get(key)]
    note = metadata.get("note")
    line = joined(["  ·  ".join(parts)])
    return joined([line, void("br"), f"Note: {note}"]) if note else line


def _start(metadata: Mapping[str, str]) -> list[str]:
    """Say when the session started, if the file knows."""
    try:
        seconds = int(metadata["start_utc_ns"]) / 1e9
        start = datetime.fromtimestamp(seconds, UTC)
    except (KeyError, ValueError, OverflowError, OSError):
        return []
    return [f"recorded {start:%Y-%m-%d %H:%M:%S} UTC"]
