"""Data stream from a running session to the online fit, and text for the fit's estimates.

A process of rigd that watches a session starts ``python -m analysis.online`` and writes to its
standard input:

* one line of JSON, UTF-8: ``version`` (1), ``metadata`` and ``segments`` as for
  `SessionWriter.begin`, and ``every_s``: time between two estimates without a request, or null if
  estimates are made on request only;
* frames: one byte for the kind, four bytes for the length (little-endian), and the content:

  ======  ===========================================================================
  ``S``   consecutive samples in the format of session files (``SAMPLE_WIRE_DTYPE``)
  ``R``   JSON: `EstimateRequest`
  ======  ===========================================================================

The program ends at the end of the stream. It writes one line of JSON per estimate to its standard
output (docs/online_fit.md).
"""

import json
import struct
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any, BinaryIO, Final

import numpy as np
import numpy.typing as npt

from rigd.printable import listed
from rigd.session._errors import SessionError
from rigd.session._validity import Validity
from rigd.session.layout import Buffer, decode_samples
from rigd.units import decimals, with_half_width

_STREAM_VERSION: Final = 1
"""Version of the stream's format."""
_FRAME_HEAD_FORMAT: Final = struct.Struct("<cI")
_SAMPLES_FRAME: Final = b"S"
_REQUEST_FRAME: Final = b"R"
_KG_MM2_PER_KG_M2: Final = 1e6
"""Conversion factor from kg m² to kg mm²."""
_MAX_FIRST_LINE_BYTES: Final = 1 << 20
"""Maximum length of the stream's first line in bytes."""
_MAX_FRAME_BYTES: Final = 1 << 26
"""Maximum length of a frame's content in bytes."""


@dataclass(frozen=True, slots=True)
class StreamStart:
    """First line of the stream: metadata that are known before the session's first sample."""

    metadata: dict[str, str]
    """Record ``session`` that the session file will contain."""
    segments: dict[str, tuple[int, int]]
    """Segment name → planned first tick and end tick (exclusive)."""
    every_s: float | None
    """Time between two estimates without a request, or None for estimates on request only."""


@dataclass(frozen=True, slots=True)
class EstimateRequest:
    """Request to estimate the beam's parameters from the samples sent so far."""

    id: int
    """Identification number, which the line with the estimate repeats."""
    tick: int
    """First tick whose sample is not used for the estimate."""
    whole: bool
    """Whether all damping structures are fitted, as by `analyze`, or only the one with the most
    parameters."""
    from_last: bool = False
    """Whether the fit may start from the previous estimate, which takes a third of the time."""


def write_start(input_stream: BinaryIO, stream_start: StreamStart) -> None:
    """Write the first line of the online fit's input stream: the session's metadata.

    Parameters
    ----------
    input_stream
        Standard input of the fit program.
    stream_start
        Metadata and segments of the session.
    """
    input_stream.write(
        json.dumps({"version": _STREAM_VERSION, **asdict(stream_start)}).encode() + b"\n"
    )
    input_stream.flush()


def write_samples(stream: BinaryIO, block: Buffer) -> None:
    """Write consecutive samples to the online fit's input stream, as one frame.

    Parameters
    ----------
    stream
        Standard input of the fit program, after `write_start`.
    block
        Encoded samples: n × ``SAMPLE_SIZE`` bytes, as `pack_sample_into` writes them.
    """
    _write_frame(stream, _SAMPLES_FRAME, block)


def write_request(stream: BinaryIO, request: EstimateRequest) -> None:
    """Write a request for an estimate to the online fit's input stream, as one frame.

    Parameters
    ----------
    stream
        Standard input of the fit program, after `write_start`.
    request
        The request. All samples before its tick must have been written.
    """
    _write_frame(stream, _REQUEST_FRAME, json.dumps(asdict(request)).encode())


def _write_frame(stream: BinaryIO, frame_kind: bytes, frame_content: Buffer) -> None:
    """Write a frame (kind, length, content) to the stream."""
    stream.write(_FRAME_HEAD_FORMAT.pack(frame_kind, memoryview(frame_content).nbytes))
    stream.write(frame_content)
    stream.flush()


def read_start(stream: BinaryIO) -> StreamStart:
    """Return the metadata in the first line of the online fit's input stream.

    Raises
    ------
    SessionError
        If the line is not the beginning of such a stream, or is of another version.
    """
    try:
        first_line = json.loads(stream.readline(_MAX_FIRST_LINE_BYTES))
        if first_line["version"] != _STREAM_VERSION:
            raise _stream_error(
                f"it is of version {first_line['version']!r}, not {_STREAM_VERSION}"
            )
        segment_items = first_line["segments"].items()
        return StreamStart(
            metadata={
                str(key): str(metadata_value)
                for key, metadata_value in first_line["metadata"].items()
            },
            segments={
                str(segment_name): (int(first_tick), int(end))
                for segment_name, (first_tick, end) in segment_items
            },
            every_s=None if first_line["every_s"] is None else float(first_line["every_s"]),
        )
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
        raise _stream_error(f"its first line is no description of a session ({error!r})") from None


def read_frames(stream: BinaryIO) -> Iterator[npt.NDArray[np.void] | EstimateRequest]:
    """Yield blocks of samples and requests from the online fit's input stream until its end.

    Yields
    ------
    ndarray of ``SAMPLE_DTYPE``, shape (n,), or EstimateRequest

    Raises
    ------
    SessionError
        If the data is not a frame, or ends within a frame.
    """
    while frame_head := stream.read(_FRAME_HEAD_FORMAT.size):
        if len(frame_head) < _FRAME_HEAD_FORMAT.size:
            raise _stream_error("it ended within a frame")
        frame_kind, content_length = _FRAME_HEAD_FORMAT.unpack(frame_head)
        if content_length > _MAX_FRAME_BYTES:
            raise _stream_error(f"a frame of {content_length} bytes")
        frame_content = stream.read(content_length)
        if len(frame_content) < content_length:
            raise _stream_error("it ended within a frame")
        try:
            if frame_kind == _SAMPLES_FRAME:
                yield decode_samples(frame_content)
            elif frame_kind == _REQUEST_FRAME:
                yield _parsed_request(json.loads(frame_content))
            else:
                raise _stream_error(f"a frame of unknown kind {frame_kind!r}")
        except (ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
            raise _stream_error(f"a frame that cannot be read ({error!r})") from None


def _parsed_request(document: Mapping[str, Any]) -> EstimateRequest:
    """Return the request for an estimate that a JSON object describes."""
    return EstimateRequest(
        int(document["id"]),
        int(document["tick"]),
        bool(document["whole"]),
        bool(document["from_last"]),
    )


def _stream_error(defect_text: str) -> SessionError:
    """Return the error for an invalid stream; `defect_text` describes the defect."""
    return SessionError(
        f"The stream of samples to the online fit is broken: {defect_text}. It has to come from "
        "a program of the same version."
    )


# Text for estimates


def mode_line(mode: Mapping[str, Any]) -> str:
    """Return one line of text with frequency, damping and inertia of an estimated mode.

    Parameters
    ----------
    mode
        Mode in the format of quick looks and online fits.

    Examples
    --------
    >>> from rigd.session.online_fit import mode_line
    >>> hz = {"value": 2.5699, "interval_95": [2.5687, 2.5711]}
    >>> print(mode_line({"mode": 1, "frequency_hz": hz,
    ...                  "damping_ratio": {"value": 0.00909, "interval_95": None}}))
    mode 1: 2.5699 ± 0.0012 Hz, damping 0.909 %
    """
    hz, damping_estimate = mode["frequency_hz"], mode["damping_ratio"]
    mode_text = (
        f"mode {mode['mode']}: {with_half_width(hz['value'], hz['interval_95'])} Hz, "
        "damping "
        f"{with_half_width(damping_estimate['value'], damping_estimate['interval_95'], 100.0)} %"
    )
    inertia_estimate = mode.get("participation")
    if inertia_estimate is None:
        return mode_text
    inertia_text = with_half_width(
        inertia_estimate["value"], inertia_estimate["interval_95"], _KG_MM2_PER_KG_M2
    )
    return f"{mode_text}, inertia {inertia_text} kg·mm²"


def estimate_lines(
    fit_document: Mapping[str, Any], earlier_document: Mapping[str, Any] | None = None
) -> list[str]:
    """Return lines of text that report an estimate of the online fit to the operator.

    Parameters
    ----------
    fit_document
        Estimate in the format of docs/online_fit.md.
    earlier_document
        Earlier estimate with which the modes are compared, or None for no comparison.
    """
    findings = [f"  {finding_sentence}" for finding_sentence in fit_document["findings"]]
    if fit_document["problem"]:
        return [f"After {fit_document['duration_s']:.1f} s: {fit_document['problem']}", *findings]
    validity = Validity.of_document(fit_document.get("validity")).short
    heading = f"± 95 %, statistical only; tip slope {validity}"
    report_lines = [f"After {fit_document['duration_s']:.1f} s ({heading}):"]
    earlier_modes = {
        mode["mode"]: mode for mode in (earlier_document or {}).get("modes", ()) if mode["shown"]
    }
    for mode in fit_document["modes"]:
        if mode["shown"]:
            change_text = (
                _change_text(earlier_modes[mode["mode"]], mode)
                if mode["mode"] in earlier_modes
                else ""
            )
            doubt_text = mode["damping_ratio"]["flag"] or mode["frequency_hz"]["flag"]
            report_lines.append(
                f"  {mode_line(mode)}{change_text}"
                f"{f' (doubtful: {doubt_text})' if doubt_text else ''}"
            )
    unseen_text = unseen_modes(fit_document["modes"])
    if unseen_text:
        report_lines.append(f"  not visible so far: {unseen_text}")
    if uniform_beam := Validity.of_document(fit_document.get("validity")).uniform_beam:
        report_lines.append(f"  {uniform_beam.sentence}")
    return [*report_lines, *findings]


def unseen_modes(modes: Iterable[Mapping[str, Any]]) -> str:
    """Return text that names the modes that are not visible in the record so far.

    It is empty if the record shows all modes.

    Parameters
    ----------
    modes
        Modes in the format of the online fit's estimates.

    Examples
    --------
    >>> from rigd.session.online_fit import unseen_modes
    >>> unseen_modes([{"mode": n, "shown": n == 1} for n in (1, 2, 3)])
    'modes 2 and 3'
    """
    unseen_numbers = [str(mode["mode"]) for mode in modes if not mode.get("shown", True)]
    return (
        f"mode{'s' if len(unseen_numbers) > 1 else ''} {listed(unseen_numbers)}"
        if unseen_numbers
        else ""
    )


def _change_text(earlier_mode: Mapping[str, Any], mode: Mapping[str, Any]) -> str:
    """Return text with the change of a mode's frequency in Hz and of its damping in percent."""
    hz, damping_estimate = mode["frequency_hz"], mode["damping_ratio"]
    shift_hz = hz["value"] - earlier_mode["frequency_hz"]["value"]
    earlier_damping = earlier_mode["damping_ratio"]["value"]
    decimal_digits = decimals(hz["std"]) if hz["std"] else 4
    relative_change = (
        f", {100 * (damping_estimate['value'] / earlier_damping - 1):+.2g} %"
        if earlier_damping
        else ""
    )
    return f"; change {shift_hz:+.{decimal_digits}f} Hz{relative_change}"
