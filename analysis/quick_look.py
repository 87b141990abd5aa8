"""Quick look at one session: modes, coherence and flags, compared with the last session.

As a program, ``python -m analysis.quick_look FILE``, it writes the quick look into the folder of
the session file, as ``STEM.look.json``, and prints its text. `rigd run` and the daemon start it
after each session, at a low priority (`rigd.engine.workers`). The report of `analyze` is more
complete and takes longer.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import time
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rigd.estimates import change_between, modes_from_json, unseen_modes_text
from rigd.runtime import raise_on_signals
from rigd.runtime.background import use_one_thread
from rigd.session import SessionError, Validity
from rigd.session.quick_look import (
    QUICK_LOOK_VERSION,
    last_quick_look,
    quick_look_path,
    read_quick_look,
)
from rigd.spectral import WINDOW

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from analysis.identify import Finding
    from analysis.identify.headline import Headline
    from analysis.record import Record
    from rigd.estimates import ReportedMode
    from rigd.spectral import RunningEstimate, Segmentation

    RealArray = NDArray[np.float64]

_LONGEST_FULL_ANALYSIS_S: Final = 300.0
"""Longest record to which every structure is fitted, in seconds. Per second of record at 1 kHz, all
structures take 15 ms, the freest structure alone 4 ms."""

_MAX_JOINED_GAP_RATIO: Final = 0.1
"""Largest gap between two bands of low coherence, relative to their frequency, across which they
are joined to one band."""


class QuickLookError(ValueError):
    """Error if a quick look cannot be made or written; the message states the remedy."""


# The quick look


def make_quick_look(path: Path, last_session_path: Path | None = None) -> dict[str, Any]:
    """Return the quick look at a session.

    Parameters
    ----------
    path : Path
        Session file.
    last_session_path : Path, optional
        Session file whose quick look is compared. The default is the last session of the same
        specimen in the folder of the file.

    Returns
    -------
    dict
        JSON document as described in docs/quick_look.md.

    Raises
    ------
    rigd.session.SessionError, QuickLookError
        The session file does not exist, or there is no quick look of the session
        `last_session_path`.
    """
    from analysis.record import RecordError, load_record
    from analysis.results import finite_json

    started_s = time.monotonic()
    modes: list[ReportedMode] = []
    response_document, coherence_document, model_document = None, _empty_coherence(), None
    specimen, start_utc_ns, session_id, excitation = "", 0, path.stem, ""
    quality_flags: list[str] = []
    validity = Validity()
    comparison = None
    try:
        record = load_record(path)
    except RecordError as error:
        quality_flags.append(_remove_file_name(str(error), path))
    else:
        metadata = record.metadata
        specimen, excitation = metadata.get("specimen", ""), metadata.get("excitation", "")
        session_id = metadata.get("id", path.stem)
        start_utc_ns = _parse_integer(metadata.get("start_utc_ns", ""))
        quality_flags += record.warnings
        headline, validity, remarks = _fit_headline(record)
        modes = [] if headline is None else list(headline.modes)
        quality_flags += remarks
        response_document, coherence_document, remarks = _response_document(record)
        quality_flags += remarks
        if headline is not None and response_document is not None:
            model_document = _model_document(headline, record, response_document["frequency_hz"])
    last_quick_look_document = (
        _stored_quick_look(last_session_path)
        if last_session_path is not None
        else _last_quick_look(path, specimen, start_utc_ns)
    )
    if last_quick_look_document is not None and any(mode.shown for mode in modes):
        comparison = _compare_modes(modes, last_quick_look_document)
    quick_look_document = {
        "version": QUICK_LOOK_VERSION,
        "file": path.name,
        "session_id": session_id,
        "start_utc_ns": start_utc_ns,
        "made_utc_ns": time.time_ns(),
        "took_s": round(time.monotonic() - started_s, 2),
        "specimen": specimen,
        "excitation": excitation,
        "modes": [mode.as_json() for mode in modes],
        "validity": validity.as_json(),
        "coherence": coherence_document,
        "flags": quality_flags,
        "against_last": comparison,
        "response": response_document,
        "model": model_document,
    }
    quick_look_document["text"] = list(_text_lines(quick_look_document))
    return dict(finite_json(quick_look_document))


def _fit_headline(record: Record) -> tuple[Headline | None, Validity, list[str]]:
    """Fit a record; return its reported estimates, their validity, and remarks.

    The estimates are None if the record is not fitted.
    """
    from analysis.applicability import record_band_hz
    from analysis.identify import Measurement, MeasurementError, fit_freest_alone
    from analysis.results import stored_whole_record, whole_record
    from analysis.validity import record_validity, stated_validity

    remark_sentences = []
    duration_s = record.time_s.size / record.rate_hz
    headline: Headline
    findings: tuple[Finding, ...]
    fit_or_read = whole_record if duration_s <= _LONGEST_FULL_ANALYSIS_S else stored_whole_record
    try:
        if (whole_fits := fit_or_read(record)) is not None:
            headline, findings, validity = (
                whole_fits.headline,
                whole_fits.verdict.findings,
                whole_fits.validity,
            )
        else:
            headline, findings, _ = fit_freest_alone(
                Measurement.from_record(record), record_band_hz(record)
            )
            validity = record_validity(
                record.metadata, record.angle_rad, record.rate_hz, headline.fit.plant
            )
            remark_sentences.append(
                f"The record is long ({duration_s:.0f} s): type {headline.name} alone was "
                "fitted; non-uniform beams, air drag, nonlinear forces and changes along the "
                "record were not tried. analyze tries them."
            )
    except MeasurementError as error:
        no_modes_sentence = f"No modes: {_remove_file_name(str(error), record.path)}"
        return None, stated_validity(record.metadata), [no_modes_sentence]
    if headline.uniform_beam is not None:
        validity = replace(validity, uniform_beam=headline.uniform_beam.summary)
    remark_sentences += [finding.sentence for finding in findings]
    if not headline.modes:
        remark_sentences.append("No modes: none lies in the excited band.")
    return headline, validity, remark_sentences


def _model_document(
    headline: Headline, record: Record, shown_frequencies_hz: Sequence[float]
) -> dict[str, Any] | None:
    """Return the model's frequency response with its 95 % band, at the excited frequencies.

    Return None if the model does not explain the record, or depends on the amplitude because of
    drag: then the band would be wrong.
    """
    import numpy as np

    from analysis.report import ShownModel
    from analysis.report.bands import dense_grid
    from rigd.sweep_response import response_decimation

    if (
        not headline.is_explained
        or headline.drag_speed_m_s is not None
        or len(shown_frequencies_hz) == 0
    ):
        return None
    shown_model = ShownModel.from_headline(headline, record)
    peaks_hz = [mode.frequency_hz for mode in shown_model.modes]
    response_band = shown_model.band(
        dense_grid(min(shown_frequencies_hz), max(shown_frequencies_hz), peaks_hz)
    )
    magnitude, magnitude_limits = np.abs(response_band.response), response_band.magnitude_limits()
    selected_bins = response_decimation(response_band.frequency_hz).extreme_indices(magnitude)
    return {
        "frequency_hz": _round_digits(response_band.frequency_hz[selected_bins]),
        "magnitude": _round_digits(magnitude[selected_bins]),
        "magnitude_low_95": _round_digits(magnitude_limits[0][selected_bins]),
        "magnitude_high_95": _round_digits(magnitude_limits[1][selected_bins]),
        "phase_rad": _round_digits(np.angle(response_band.response[selected_bins])),
    }


def _response_document(record: Record) -> tuple[dict[str, Any] | None, dict[str, Any], list[str]]:
    """Return response and coherence at the excited frequencies, and remarks.

    The first two are sections of the JSON document; the response is None if it cannot be estimated.
    The estimates are those of the live view of a running session.
    """
    import numpy as np

    from analysis.applicability import welch_exclusion_reason
    from analysis.models import MAX_FREQUENCY_TO_RATE_RATIO
    from rigd.spectral import SpectralError, segmentation_of
    from rigd.sweep_response import (
        HIGHEST_SHOWN_HZ,
        LOW_COHERENCE,
        LOWEST_SHOWN_HZ,
        response_decimation,
    )

    last_hz = min(HIGHEST_SHOWN_HZ, MAX_FREQUENCY_TO_RATE_RATIO * record.rate_hz)
    segmentation = segmentation_of(record.first_sweep_samples, record.rate_hz)
    resolution_hz = WINDOW.half_power_bins * record.rate_hz / segmentation.segment_length
    try:
        estimate = _estimate_response(record, segmentation, last_hz)
        # For steps, multisines and narrow sweeps, the coherence would depend on the segments.
        coherence_values = None
        if (
            estimate is not None
            and welch_exclusion_reason(record, (LOWEST_SHOWN_HZ, last_hz)) is None
        ):
            coherence_values, segmentation = _estimate_coherence(
                record, estimate, segmentation, last_hz
            )
    except SpectralError as error:
        return None, _empty_coherence(), [str(error)]
    if estimate is None:
        return None, _empty_coherence(), []
    undelayed_response = estimate.response.without_delays(
        input_delay_s=record.angle_delay_s, output_delay_s=record.torque_delay_s
    )
    is_shown_bin = (
        estimate.is_excited
        & (undelayed_response.frequency_hz >= LOWEST_SHOWN_HZ)
        & np.isfinite(undelayed_response.response)
    )
    shown_frequency_hz, shown_response = (
        undelayed_response.frequency_hz[is_shown_bin],
        undelayed_response.response[is_shown_bin],
    )
    selected_bins = response_decimation(shown_frequency_hz).extreme_indices(np.abs(shown_response))
    response_document = {
        "frequency_hz": _round_digits(shown_frequency_hz[selected_bins]),
        "magnitude": _round_digits(np.abs(shown_response[selected_bins])),
        "phase_rad": _round_digits(np.angle(shown_response[selected_bins])),
        "coherence": None
        if coherence_values is None
        else _round_digits(coherence_values[is_shown_bin][selected_bins]),
        "resolution_hz": round(resolution_hz, 4),
    }
    if coherence_values is None or shown_frequency_hz.size == 0:
        return response_document, _empty_coherence(), []
    shown_coherence = coherence_values[is_shown_bin]
    incoherent_bands = _join_bins(
        shown_frequency_hz,
        shown_coherence < LOW_COHERENCE,
        record.rate_hz / segmentation.segment_length,
    )
    low_bands = [[round(band_edge, 3) for band_edge in band] for band in incoherent_bands]
    return (
        response_document,
        {"mean": round(float(shown_coherence.mean()), 4), "low_bands": low_bands},
        [],
    )


def _estimate_response(
    record: Record, segmentation: Segmentation, last_hz: float
) -> RunningEstimate | None:
    """Return the estimate of the frequency response from a record's sweep."""
    import numpy as np

    from rigd.spectral import RunningResponse

    sweep_range, rest_rad = record.first_sweep, record.rest_angle_rad or 0.0
    running_response = RunningResponse(
        record.rate_hz, record.first_sweep_samples, last_hz=last_hz, segmentation=segmentation
    )
    running_response.feed(
        np.arange(record.first_sweep_samples),
        record.reference_rad[sweep_range] - rest_rad,
        record.angle_rad[sweep_range] - rest_rad,
        record.torque_nm[sweep_range],
    )
    return running_response.estimate()


def _estimate_coherence(
    record: Record, estimate: RunningEstimate, segmentation: Segmentation, last_hz: float
) -> tuple[RealArray | None, Segmentation]:
    """Return the coherence of a record, and the segments by which it is estimated.

    If `segmentation` give only one segment, which has no coherence, shorter ones are used. The
    coherence is None if these do not give an estimate either.
    """
    from rigd.spectral import PAPER_OVERLAP_FRACTION, PAPER_SEGMENTS, segment_lengths

    if estimate.response.coherence is None:
        segment_length, overlap_samples = segment_lengths(
            record.first_sweep_samples, PAPER_SEGMENTS, PAPER_OVERLAP_FRACTION
        )
        segmentation = replace(segmentation, segment_length=segment_length, overlap=overlap_samples)
        short_segment_estimate = _estimate_response(record, segmentation, last_hz)
        return (
            None if short_segment_estimate is None else short_segment_estimate.response.coherence,
            segmentation,
        )
    return estimate.response.coherence, segmentation


def _join_bins(
    frequency_hz: RealArray, is_selected_bin: NDArray[np.bool_], resolution_hz: float
) -> Iterator[tuple[float, float]]:
    """Yield the frequency bands, as first and last frequency in Hz, that the selected bins form.

    Bins nearer than a tenth of their frequency belong to one band. A band narrower than
    `resolution_hz`, the resolution of the segments, is omitted.
    """
    import numpy as np

    selected_hz = frequency_hz[is_selected_bin]
    band_start_indices = (
        np.flatnonzero(
            np.diff(selected_hz)
            > np.maximum(_MAX_JOINED_GAP_RATIO * selected_hz[:-1], resolution_hz)
        )
        + 1
    )
    for start_index, end_index in pairwise([0, *band_start_indices, selected_hz.size]):
        if (
            end_index > start_index
            and selected_hz[end_index - 1] - selected_hz[start_index] >= resolution_hz
        ):
            yield float(selected_hz[start_index]), float(selected_hz[end_index - 1])


def _empty_coherence() -> dict[str, Any]:
    """Return the coherence section of the JSON document with null values."""
    return {"mean": None, "low_bands": []}


# Against the last session


def _stored_quick_look(session_path: Path) -> dict[str, Any]:
    """Return the stored quick look of a session file as a JSON document.

    Raise QuickLookError if the session has none.
    """
    quick_look = read_quick_look(quick_look_path(session_path))
    if quick_look is None:
        raise QuickLookError(
            f"--last {session_path}: there is no readable quick look next to it; make one with "
            f"python -m analysis.quick_look {session_path}."
        )
    return quick_look


def _last_quick_look(path: Path, specimen: str, before_utc_ns: int) -> dict[str, Any] | None:
    """Return the newest quick look of a specimen before a time; None without one with modes.

    The folder of the session file `path` is searched, except for that session's own quick look.
    """
    path_and_document = last_quick_look(
        path.parent,
        specimen,
        before_utc_ns=before_utc_ns,
        excluded_session=path.stem,
        is_usable=lambda document: any(mode.shown for mode in modes_from_json(document["modes"])),
    )
    return None if path_and_document is None else path_and_document[1]


def _compare_modes(modes: list[ReportedMode], other_document: Mapping[str, Any]) -> dict[str, Any]:
    """Compare the modes that are visible both in a session and in an earlier one.

    Return the comparison as a section of the JSON document.
    """
    other_modes = {
        mode.number: mode for mode in modes_from_json(other_document["modes"]) if mode.shown
    }
    compared_modes, changed_modes, unchanged_modes = [], [], []
    for mode in modes:
        other_mode = other_modes.get(mode.number)
        if other_mode is None or not mode.shown:
            continue
        frequency_change, damping_change = (
            change_between(other_mode.frequency_hz, mode.frequency_hz),
            change_between(other_mode.damping_ratio, mode.damping_ratio),
        )
        change_percent = mode.damping_ratio.percent_above(other_mode.damping_ratio)
        are_significant = [
            change.significant is True for change in (frequency_change, damping_change)
        ]
        compared_modes.append(
            {
                "mode": mode.number,
                "frequency_hz_change": frequency_change.difference,
                "damping_ratio_change_percent": change_percent,
                "significant": any(are_significant),
            }
        )
        change_texts = (mode.frequency_change_text(other_mode), f"damping {change_percent:+.2g} %")
        significant_texts = [
            change_text
            for change_text, is_different in zip(change_texts, are_significant, strict=True)
            if is_different
        ]
        if significant_texts:
            changed_modes.append(f"mode {mode.number} {', '.join(significant_texts)}")
        else:
            unchanged_modes.append(f"mode {mode.number} {', '.join(change_texts)}")
    other_session_name = Path(other_document["file"]).stem
    if not compared_modes:
        comparison_sentence = f"No mode can be compared with {other_session_name}."
    elif changed_modes:
        comparison_sentence = (
            f"Significant change against {other_session_name}: {'; '.join(changed_modes)}."
        )
    else:
        comparison_sentence = (
            f"No significant change against {other_session_name} ({'; '.join(unchanged_modes)})."
        )
    return {
        "file": other_document["file"],
        "sentence": comparison_sentence,
        "modes": compared_modes,
    }


# Text


def _text_lines(quick_look_document: Mapping[str, Any]) -> Iterator[str]:
    """Yield the lines of text that show a quick look in a terminal."""
    from rigd.sweep_response import LOW_COHERENCE

    specimen_text = (
        f" ({quick_look_document['specimen']})" if quick_look_document["specimen"] else ""
    )
    # The intervals do not include scale of the torque, length and density of the beam.
    yield (
        f"Quick look at {quick_look_document['session_id']}{specimen_text}; ± 95 %, statistical "
        "only:"
    )
    modes = modes_from_json(quick_look_document["modes"])
    shown_modes = [mode for mode in modes if mode.shown]
    for mode in shown_modes:
        yield f"  {mode.summary_line()}"
    if shown_modes:
        validity = Validity.from_document(quick_look_document.get("validity"))
        yield f"  {validity.sentence}"
        if validity.uniform_beam is not None:
            yield f"  {validity.uniform_beam.sentence}"
    doubt_texts = dict.fromkeys(
        estimate.flag
        for mode in shown_modes
        for estimate in (mode.frequency_hz, mode.damping_ratio)
        if estimate.flag
    )
    yield from (f"  doubtful: {doubt_text}" for doubt_text in doubt_texts)
    if hidden_modes := unseen_modes_text(modes):
        yield f"  not visible in this record: {hidden_modes}"
    coherence = quick_look_document["coherence"]
    if coherence["mean"] is not None:
        bands_text = ", ".join(
            f"{first_hz:.3g} to {last_hz:.3g}" for first_hz, last_hz in coherence["low_bands"]
        )
        low_coherence_text = f", below {LOW_COHERENCE:g} from {bands_text} Hz" if bands_text else ""
        yield f"  mean coherence {coherence['mean']:.2f}{low_coherence_text}"
    yield from (f"  {value_flag}" for value_flag in quick_look_document["flags"])
    if quick_look_document["against_last"] is not None:
        yield f"  {quick_look_document['against_last']['sentence']}"


def _round_digits(numbers: RealArray) -> list[float]:
    """Return values rounded to six digits, which is finer than the accuracy of an estimate."""
    return [float(f"{number:.6g}") for number in numbers]


def _parse_integer(number_text: str) -> int:
    """Return the integer in a text, or 0 if the text is not an integer."""
    return int(number_text) if number_text.isascii() and number_text.isdigit() else 0


def _remove_file_name(sentence: str, path: Path) -> str:
    """Return a sentence without the session file's name at its start."""
    return sentence.removeprefix(f"{path}: ")


# The file


def write_quick_look(quick_look_document: Mapping[str, Any], session_path: Path) -> Path:
    """Write a quick look to a file next to its session file, completely or not at all.

    An older quick look of the same session is replaced, a newer one is retained.

    Parameters
    ----------
    quick_look_document : mapping
        Result of `make_quick_look`.
    session_path : Path
        Session file.

    Returns
    -------
    Path
        File of the quick look.

    Raises
    ------
    QuickLookError
        The file cannot be written, or a file of that name is no quick look.
    """
    quick_look_file = quick_look_path(session_path)
    existing_document = read_quick_look(quick_look_file)
    if (
        existing_document is not None
        and existing_document["made_utc_ns"] > quick_look_document["made_utc_ns"]
    ):
        return quick_look_file
    temporary_file = quick_look_file.with_name(f".{quick_look_file.name}.{os.getpid()}")
    try:
        if (
            existing_document is None
            and quick_look_file.exists()
            and quick_look_file.stat().st_size > 0
        ):
            raise QuickLookError(
                f"{quick_look_file} is not a quick look of this version; move it away."
            )
        temporary_file.write_text(json.dumps(quick_look_document, allow_nan=False), "utf-8")
        temporary_file.replace(quick_look_file)
    except OSError as error:
        raise QuickLookError(f"{quick_look_file} cannot be written ({error.strerror}).") from None
    finally:
        with suppress(OSError):
            temporary_file.unlink(missing_ok=True)
    return quick_look_file


# The program


def main() -> None:
    """Write and print the quick look of the session that the command line names."""
    raise_on_signals(signal.SIGINT)
    argument_parser = argparse.ArgumentParser(
        prog="python -m analysis.quick_look", description=__doc__
    )
    argument_parser.add_argument("file", type=Path, metavar="FILE", help="Session file.")
    argument_parser.add_argument(
        "--last", type=Path, metavar="FILE", help="Session to compare with (default: the last one)."
    )
    parsed_arguments = argument_parser.parse_args()
    use_one_thread()
    try:
        quick_look_document = make_quick_look(parsed_arguments.file, parsed_arguments.last)
        write_quick_look(quick_look_document, parsed_arguments.file)
    except (SessionError, QuickLookError) as error:
        sys.exit(f"Error: {error}")
    except KeyboardInterrupt:
        sys.exit(130)
    sys.stdout.write("\n".join(quick_look_document["text"]) + "\n")


if __name__ == "__main__":
    main()
