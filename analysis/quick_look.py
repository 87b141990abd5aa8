"""Quick look at one session: modes, coherence and flags, compared with the last session.

As a program, ``python -m analysis.quick_look FILE``, it writes the quick look into the folder of
the session file, as ``STEM.look.json``, and prints its text. `rigd run` and the daemon start it
after each session, at a low priority. The report of `analyze` is more complete and takes longer.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import sys
import time
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rigd.library.trend import change_between
from rigd.printable import listed
from rigd.runtime import begin_background, raise_on_signals
from rigd.session import SessionError, Validity
from rigd.session.online_fit import mode_line
from rigd.session.quick_look import (
    QUICK_LOOK_VERSION,
    last_quick_look,
    quick_look_path,
    read_quick_look,
)
from rigd.units import decimals

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from analysis.identify import Finding
    from analysis.identify.headline import Headline, ReportedMode
    from analysis.record import Record
    from rigd.spectral import RunningEstimate, Segmentation

    Real = NDArray[np.float64]

_LONGEST_FULL_ANALYSIS_S: Final = 300.0
"""Longest record to which every structure is fitted, in seconds. Per second of record at 1 kHz, all
structures take 15 ms, the freest structure alone 4 ms."""

_JOIN_DISTANCE: Final = 0.1
"""Distance of two bands of low coherence, relative to their frequency, up to which they are joined
to one band."""

_HAMMING_WIDTH_BINS: Final = 1.30
"""Width of a Hamming window's main lobe at half power, in bins of a segment's transform."""

_MODE_QUANTITIES: Final = ("frequency_hz", "damping_ratio")
"""Quantities of a mode that are compared between sessions."""

_NICENESS: Final = 10
"""Niceness of the program, which gives it a tenth of the processor time of an ordinary one."""


class QuickLookError(ValueError):
    """Error if a quick look cannot be made or written; the message states the remedy."""


# The quick look


def make_quick_look(path: Path, last: Path | None = None) -> dict[str, Any]:
    """Return the quick look at a session.

    Parameters
    ----------
    path : Path
        Session file.
    last : Path, optional
        Session file whose quick look is compared. The default is the last session of the same
        specimen in the folder of the file.

    Returns
    -------
    dict
        JSON document as described in docs/quick_look.md.

    Raises
    ------
    rigd.session.SessionError, QuickLookError
        The session file, or the quick look of `last`, does not exist.
    """
    from analysis.record import RecordError, load_record
    from analysis.results import finite

    started_s = time.monotonic()
    modes: list[dict[str, Any]] = []
    response, coherence, model = None, _empty_coherence(), None
    specimen, start_utc_ns, session_id, excitation = "", 0, path.stem, ""
    flags: list[str] = []
    validity = Validity()
    comparison = None
    try:
        record = load_record(path)
    except RecordError as error:
        flags.append(_remove_file_name(str(error), path))
    else:
        metadata = record.metadata
        specimen, excitation = metadata.get("specimen", ""), metadata.get("excitation", "")
        session_id = metadata.get("id", path.stem)
        start_utc_ns = _parse_integer(metadata.get("start_utc_ns", ""))
        flags += record.warnings
        headline, validity, remarks = _fit_headline(record)
        modes = (
            []
            if headline is None
            else [_mode_document(reported_mode) for reported_mode in headline.modes]
        )
        flags += remarks
        response, coherence, remarks = _response_document(record)
        flags += remarks
        if headline is not None and response is not None:
            model = _model_document(headline, record, response["frequency_hz"])
    last_quick_look_document = (
        _stored_quick_look(last)
        if last is not None
        else _last_quick_look(path, specimen, start_utc_ns)
    )
    if last_quick_look_document is not None and any(mode["shown"] for mode in modes):
        comparison = _compare_modes(modes, last_quick_look_document)
    document = {
        "version": QUICK_LOOK_VERSION,
        "file": path.name,
        "session_id": session_id,
        "start_utc_ns": start_utc_ns,
        "made_utc_ns": time.time_ns(),
        "took_s": round(time.monotonic() - started_s, 2),
        "specimen": specimen,
        "excitation": excitation,
        "modes": modes,
        "validity": validity.as_json(),
        "coherence": coherence,
        "flags": flags,
        "against_last": comparison,
        "response": response,
        "model": model,
    }
    document["text"] = list(_text_lines(document))
    return dict(finite(document))


def _fit_headline(record: Record) -> tuple[Headline | None, Validity, list[str]]:
    """Fit a record; return the estimates (or None), their validity, and remarks."""
    from analysis.identify import Measurement, MeasurementError, fit_freest_alone
    from analysis.results import whole_record
    from analysis.suited import record_band_hz
    from analysis.validity import record_validity, stated_validity

    sentences = []
    length_s = record.time_s.size / record.rate_hz
    headline: Headline
    findings: tuple[Finding, ...]
    try:
        if length_s <= _LONGEST_FULL_ANALYSIS_S:
            whole = whole_record(record)
            headline, findings, validity = whole.headline, whole.verdict.findings, whole.validity
        else:
            headline, findings, _ = fit_freest_alone(
                Measurement.of_record(record), record_band_hz(record)
            )
            model = headline.fit.plant.beam, headline.fit.plant.damping
            validity = record_validity(record.metadata, record.angle_rad, record.rate_hz, model)
            sentences.append(
                f"The record is long ({length_s:.0f} s): type {headline.name} alone was fitted; "
                "non-uniform beams, air drag, nonlinear forces and changes along the record were "
                "not tried. analyze tries them."
            )
    except MeasurementError as error:
        no_modes = f"No modes: {_remove_file_name(str(error), record.path)}"
        return None, stated_validity(record.metadata), [no_modes]
    if headline.uniform_beam is not None:
        validity = replace(validity, uniform_beam=headline.uniform_beam.summary)
    sentences += [finding.sentence for finding in findings]
    if not headline.modes:
        sentences.append("No modes: none lies in the excited band.")
    return headline, validity, sentences


def _mode_document(mode: ReportedMode) -> dict[str, Any]:
    """Return a mode as part of the JSON document."""
    return {
        "mode": mode.number,
        "frequency_hz": mode.frequency_hz.as_json(),
        "damping_ratio": mode.damping_ratio.as_json(),
        "participation": None if mode.participation is None else mode.participation.as_json(),
        "source": mode.source,
        "shown": mode.shown,
    }


def _model_document(
    headline: Headline, record: Record, shown_hz: Sequence[float]
) -> dict[str, Any] | None:
    """Return the model's frequency response with its 95 % band, at the excited frequencies.

    Return None if the model does not explain the record or depends on the amplitude, as with drag,
    because there is no such band then.
    """
    import numpy as np

    from analysis.report import ShownModel
    from analysis.report.bands import dense_grid
    from rigd.view.frequency_charts import response_decimation

    if not headline.explained or headline.drag_speed_m_s is not None or len(shown_hz) == 0:
        return None
    shown = ShownModel.of(headline, record)
    peaks_hz = [mode.frequency_hz for mode in shown.modes]
    band = shown.band(dense_grid(min(shown_hz), max(shown_hz), peaks_hz))
    magnitude, limits = np.abs(band.response), band.magnitude_limits()
    selected = response_decimation(band.frequency_hz).extremes(magnitude)
    return {
        "frequency_hz": _round_digits(band.frequency_hz[selected]),
        "magnitude": _round_digits(magnitude[selected]),
        "magnitude_low_95": _round_digits(limits[0][selected]),
        "magnitude_high_95": _round_digits(limits[1][selected]),
        "phase_rad": _round_digits(np.angle(band.response[selected])),
    }


def _response_document(record: Record) -> tuple[dict[str, Any] | None, dict[str, Any], list[str]]:
    """Return response and coherence at the excited frequencies, and remarks.

    The estimates are those of the live view.
    """
    import numpy as np

    from analysis.models import LARGEST_FRACTION_OF_RATE
    from analysis.suited import welch_exclusion_reason
    from rigd.spectral import SpectralError, segmentation_of
    from rigd.view.frequency_charts import FIRST_HZ, LAST_HZ, LOW_COHERENCE, response_decimation

    last_hz = min(LAST_HZ, LARGEST_FRACTION_OF_RATE * record.rate_hz)
    segments = segmentation_of(record.first_sweep_samples, record.rate_hz)
    resolution_hz = _HAMMING_WIDTH_BINS * record.rate_hz / segments.segment_length
    try:
        estimate = _estimate_response(record, segments, last_hz)
        # For steps, multisines and narrow sweeps, the coherence would depend on the segments.
        coherence = None
        if estimate is not None and welch_exclusion_reason(record, (FIRST_HZ, last_hz)) is None:
            coherence, segments = _estimate_coherence(record, estimate, segments, last_hz)
    except SpectralError as error:
        return None, _empty_coherence(), [str(error)]
    if estimate is None:
        return None, _empty_coherence(), []
    undelayed = estimate.response.without_delays(
        input_delay_s=record.angle_delay_s, output_delay_s=record.torque_delay_s
    )
    shown = (
        estimate.excited & (undelayed.frequency_hz >= FIRST_HZ) & np.isfinite(undelayed.response)
    )
    hz, values = undelayed.frequency_hz[shown], undelayed.response[shown]
    selected = response_decimation(hz).extremes(np.abs(values))
    response = {
        "frequency_hz": _round_digits(hz[selected]),
        "magnitude": _round_digits(np.abs(values[selected])),
        "phase_rad": _round_digits(np.angle(values[selected])),
        "coherence": None if coherence is None else _round_digits(coherence[shown][selected]),
        "resolution_hz": round(resolution_hz, 4),
    }
    if coherence is None or hz.size == 0:
        return response, _empty_coherence(), []
    coherent = coherence[shown]
    low = _join_bins(hz, coherent < LOW_COHERENCE, record.rate_hz / segments.segment_length)
    bands = [[round(edge, 3) for edge in band] for band in low]
    return response, {"mean": round(float(coherent.mean()), 4), "low_bands": bands}, []


def _estimate_response(
    record: Record, segments: Segmentation, last_hz: float
) -> RunningEstimate | None:
    """Return the estimate of the frequency response from a record's sweep."""
    import numpy as np

    from rigd.spectral import RunningResponse

    sweep_range, rest_rad = record.first_sweep, record.rest_angle_rad or 0.0
    running = RunningResponse(
        record.rate_hz, record.first_sweep_samples, last_hz=last_hz, segmentation=segments
    )
    running.feed(
        np.arange(record.first_sweep_samples),
        record.reference_rad[sweep_range] - rest_rad,
        record.angle_rad[sweep_range] - rest_rad,
        record.torque_nm[sweep_range],
    )
    return running.estimate()


def _estimate_coherence(
    record: Record, estimate: RunningEstimate, segments: Segmentation, last_hz: float
) -> tuple[Real | None, Segmentation]:
    """Return the coherence, from shorter segments if there is only one, and these segments."""
    from rigd.spectral import PAPER_OVERLAP_FRACTION, PAPER_SEGMENTS, segment_lengths

    if estimate.response.coherence is None:
        length, overlap = segment_lengths(
            record.first_sweep_samples, PAPER_SEGMENTS, PAPER_OVERLAP_FRACTION
        )
        segments = replace(segments, segment_length=length, overlap=overlap)
        shorter = _estimate_response(record, segments, last_hz)
        return None if shorter is None else shorter.response.coherence, segments
    return estimate.response.coherence, segments


def _join_bins(
    frequency_hz: Real, is_selected: NDArray[np.bool_], resolution_hz: float
) -> Iterator[tuple[float, float]]:
    """Yield the frequency bands that the selected bins form.

    Bins nearer than a tenth of their frequency belong to one band. A band narrower than the
    resolution of the segments is omitted.
    """
    import numpy as np

    hz = frequency_hz[is_selected]
    band_starts = (
        np.flatnonzero(np.diff(hz) > np.maximum(_JOIN_DISTANCE * hz[:-1], resolution_hz)) + 1
    )
    for start, end in pairwise([0, *band_starts, hz.size]):
        if end > start and hz[end - 1] - hz[start] >= resolution_hz:
            yield float(hz[start]), float(hz[end - 1])


def _empty_coherence() -> dict[str, Any]:
    """Return the coherence section of the JSON document with null values."""
    return {"mean": None, "low_bands": []}


# Against the last session


def _stored_quick_look(last: Path) -> dict[str, Any]:
    """Return the stored quick look of a session; raise if it has none."""
    quick_look = read_quick_look(quick_look_path(last))
    if quick_look is None:
        raise QuickLookError(
            f"--last {last}: there is no readable quick look beside it; make one with "
            f"python -m analysis.quick_look {last}."
        )
    return quick_look


def _last_quick_look(path: Path, specimen: str, before_utc_ns: int) -> dict[str, Any] | None:
    """Return the last quick look of a specimen before a time, from a session's folder."""
    path_and_document = last_quick_look(
        path.parent,
        specimen,
        before_utc_ns=before_utc_ns,
        excluded_session=path.stem,
        is_usable=lambda document: any(mode["shown"] for mode in document["modes"]),
    )
    return None if path_and_document is None else path_and_document[1]


def _compare_modes(
    modes: list[dict[str, Any]], other_document: Mapping[str, Any]
) -> dict[str, Any]:
    """Compare the modes of a session with those of an earlier one, if visible in both."""
    other_modes = {mode["mode"]: mode for mode in other_document["modes"] if mode["shown"]}
    compared, changed, unchanged = [], [], []
    for mode in modes:
        other = other_modes.get(mode["mode"])
        if other is None or not mode["shown"]:
            continue
        hz, damping = mode["frequency_hz"], mode["damping_ratio"]
        change_hz = hz["value"] - other["frequency_hz"]["value"]
        other_damping_ratio = other["damping_ratio"]["value"]
        percent = (
            100 * (damping["value"] / other_damping_ratio - 1) if other_damping_ratio else math.nan
        )
        significant = [
            change_between(other[name], mode[name]).significant is True for name in _MODE_QUANTITIES
        ]
        compared.append(
            {
                "mode": mode["mode"],
                "frequency_hz_change": change_hz,
                "damping_ratio_change_percent": percent,
                "significant": any(significant),
            }
        )
        digits = decimals(hz["std"]) if hz["std"] else 4
        texts = (f"{change_hz:+.{digits}f} Hz", f"damping {percent:+.2g} %")
        significant_texts = [
            text for text, differs in zip(texts, significant, strict=True) if differs
        ]
        if significant_texts:
            changed.append(f"mode {mode['mode']} {', '.join(significant_texts)}")
        else:
            unchanged.append(f"mode {mode['mode']} {', '.join(texts)}")
    name = Path(other_document["file"]).stem
    if not compared:
        sentence = f"No mode can be compared with {name}."
    elif changed:
        sentence = f"Significant change against {name}: {'; '.join(changed)}."
    else:
        sentence = f"No significant change against {name} ({'; '.join(unchanged)})."
    return {"file": other_document["file"], "sentence": sentence, "modes": compared}


# Text


def _text_lines(document: Mapping[str, Any]) -> Iterator[str]:
    """Yield the lines of text that show a quick look in a terminal."""
    from rigd.view.frequency_charts import LOW_COHERENCE

    specimen = f" ({document['specimen']})" if document["specimen"] else ""
    # The intervals do not include scale of the torque, length and density of the beam.
    yield f"Quick look at {document['session_id']}{specimen}; ± 95 %, statistical only:"
    shown = [mode for mode in document["modes"] if mode["shown"]]
    for mode in shown:
        yield f"  {mode_line(mode)}"
    if shown:
        validity = Validity.of_document(document.get("validity"))
        yield f"  {validity.sentence}"
        if validity.uniform_beam is not None:
            yield f"  {validity.uniform_beam.sentence}"
    doubts = dict.fromkeys(
        flag for mode in shown for name in _MODE_QUANTITIES if (flag := mode[name]["flag"])
    )
    yield from (f"  doubtful: {doubt_text}" for doubt_text in doubts)
    hidden_modes = [str(mode["mode"]) for mode in document["modes"] if not mode["shown"]]
    if hidden_modes:
        noun = "mode" if len(hidden_modes) == 1 else "modes"
        yield f"  not visible in this record: {noun} {listed(hidden_modes)}"
    coherence = document["coherence"]
    if coherence["mean"] is not None:
        bands = ", ".join(f"{first:.3g} to {last:.3g}" for first, last in coherence["low_bands"])
        low = f", below {LOW_COHERENCE:g} from {bands} Hz" if bands else ""
        yield f"  mean coherence {coherence['mean']:.2f}{low}"
    yield from (f"  {flag}" for flag in document["flags"])
    if document["against_last"] is not None:
        yield f"  {document['against_last']['sentence']}"


def _round_digits(values: Real) -> list[float]:
    """Return values rounded to six digits, which is finer than the accuracy of an estimate."""
    return [float(f"{value:.6g}") for value in values]


def _parse_integer(text: str) -> int:
    """Return the integer in a text, or 0 if it is none."""
    return int(text) if text.isascii() and text.isdigit() else 0


def _remove_file_name(sentence: str, path: Path) -> str:
    """Return a sentence without the session file's name at its start."""
    return sentence.removeprefix(f"{path}: ")


# The file


def write_quick_look(document: Mapping[str, Any], path: Path) -> Path:
    """Write a quick look to a file next to its session file, completely or not at all.

    An older quick look of the same session is replaced, a newer one is retained.

    Parameters
    ----------
    document : mapping
        Result of `make_quick_look`.
    path : Path
        Session file.

    Returns
    -------
    Path
        File of the quick look.

    Raises
    ------
    QuickLookError
        The file cannot be written, or its name belongs to another file.
    """
    target = quick_look_path(path)
    existing = read_quick_look(target)
    if existing is not None and existing["made_utc_ns"] > document["made_utc_ns"]:
        return target
    temporary_file = target.with_name(f".{target.name}.{os.getpid()}")
    try:
        if existing is None and target.exists() and target.stat().st_size > 0:
            raise QuickLookError(f"{target} is not a quick look of this version; move it away.")
        temporary_file.write_text(json.dumps(document, allow_nan=False), "utf-8")
        temporary_file.replace(target)
    except OSError as error:
        raise QuickLookError(f"{target} cannot be written ({error.strerror}).") from None
    finally:
        with suppress(OSError):
            temporary_file.unlink(missing_ok=True)
    return target


# The program


def main() -> None:
    """Write and print the quick look of the session that the command line names."""
    raise_on_signals(signal.SIGINT)
    parser = argparse.ArgumentParser(prog="python -m analysis.quick_look", description=__doc__)
    parser.add_argument("file", type=Path, metavar="FILE", help="Session file.")
    parser.add_argument(
        "--last", type=Path, metavar="FILE", help="Session to compare with (default: the last one)."
    )
    arguments = begin_background(parser)
    # The priority is not the lowest one, because other programs may never pause.
    with suppress(OSError):
        os.nice(_NICENESS)
    try:
        document = make_quick_look(arguments.file, arguments.last)
        write_quick_look(document, arguments.file)
    except (SessionError, QuickLookError) as error:
        sys.exit(f"Error: {error}")
    except KeyboardInterrupt:
        sys.exit(130)
    sys.stdout.write("\n".join(document["text"]) + "\n")


if __name__ == "__main__":
    main()
