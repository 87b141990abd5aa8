"""Stream to the online fit, and its answers in words.

A process of rigd that watches a session starts ``python -m analysis.online`` and writes to its
standard input:

* one line of JSON, UTF-8: ``version`` (1), ``metadata`` and ``segments`` as `SessionWriter.begin`
  takes them, and ``every_s``: time between two estimates without a request, null for none;
* frames: one byte of kind, four bytes of length (little-endian), and as many bytes of content:

  ======  ===========================================================================
  ``S``   consecutive samples in the format of session files (``SAMPLE_WIRE_DTYPE``)
  ``R``   JSON: `EstimateRequest`
  ======  ===========================================================================

The end of the stream ends the program. It answers on its standard output, one line of JSON per
estimate (docs/online_fit.md).
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

_VERSION: Final = 1
_HEAD: Final = struct.Struct("<cI")
_SAMPLES: Final = b"S"
_REQUEST: Final = b"R"
_KG_MM2: Final = 1e6
_LONGEST_LINE: Final = 1 << 20
_LONGEST_FRAME: Final = 1 << 26


@dataclass(frozen=True, slots=True)
class StreamStart:
    """Metadata of a session that are known before its first sample."""

    metadata: dict[str, str]
    """The record ``session`` of the future file."""
    segments: dict[str, tuple[int, int]]
    """Name → first tick and end (exclusive), as planned."""
    every_s: float | None
    """Time between two estimates without a request; None: on request only."""


@dataclass(frozen=True, slots=True)
class EstimateRequest:
    """Request for an estimate from the samples so far."""

    id: int
    """Number that the answer repeats."""
    tick: int
    """Samples from this tick on are left out."""
    whole: bool
    """Whether every structure is tried, as in `analyze`; else the freest one alone is fitted."""
    from_last: bool = False
    """Whether the fit may start from the last such estimate, in a third of the time."""


def write_start(stream: BinaryIO, start: StreamStart) -> None:
    """Write the start of a stream: metadata and segments of the session.

    Parameters
    ----------
    stream
        Standard input of the program.
    start
        The session.
    """
    stream.write(json.dumps({"version": _VERSION, **asdict(start)}).encode() + b"\n")
    stream.flush()


def write_samples(stream: BinaryIO, block: Buffer) -> None:
    """Write consecutive samples to the stream.

    Parameters
    ----------
    stream
        Stream that was begun.
    block
        n × ``SAMPLE_SIZE`` bytes, as `pack_sample_into` writes them.
    """
    _write(stream, _SAMPLES, block)


def write_request(stream: BinaryIO, request: EstimateRequest) -> None:
    """Write a request for an estimate to the stream.

    Parameters
    ----------
    stream
        Stream that was begun.
    request
        The request; the samples before its tick have been sent.
    """
    _write(stream, _REQUEST, json.dumps(asdict(request)).encode())


def _write(stream: BinaryIO, kind: bytes, content: Buffer) -> None:
    stream.write(_HEAD.pack(kind, memoryview(content).nbytes))
    stream.write(content)
    stream.flush()


def read_start(stream: BinaryIO) -> StreamStart:
    """Read the start of a stream.

    Raises
    ------
    SessionError
        It is not the beginning of such a stream.
    """
    try:
        found = json.loads(stream.readline(_LONGEST_LINE))
        if found["version"] != _VERSION:
            raise _broken(f"it is of version {found['version']!r}, not {_VERSION}")
        segments = found["segments"].items()
        return StreamStart(
            metadata={str(key): str(value) for key, value in found["metadata"].items()},
            segments={str(name): (int(first), int(end)) for name, (first, end) in segments},
            every_s=None if found["every_s"] is None else float(found["every_s"]),
        )
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
        raise _broken(f"its first line is no description of a session ({error!r})") from None


def read_frames(stream: BinaryIO) -> Iterator[npt.NDArray[np.void] | EstimateRequest]:
    """Read samples and requests until the stream ends.

    Yields
    ------
    ndarray of ``SAMPLE_DTYPE``, shape (n,), or EstimateRequest

    Raises
    ------
    SessionError
        If the data is not a frame, or ends within one.
    """
    while head := stream.read(_HEAD.size):
        if len(head) < _HEAD.size:
            raise _broken("it ended within a frame")
        kind, length = _HEAD.unpack(head)
        if length > _LONGEST_FRAME:
            raise _broken(f"a frame of {length} bytes")
        content = stream.read(length)
        if len(content) < length:
            raise _broken("it ended within a frame")
        try:
            if kind == _SAMPLES:
                yield decode_samples(content)
            elif kind == _REQUEST:
                yield _request(json.loads(content))
            else:
                raise _broken(f"a frame of unknown kind {kind!r}")
        except (ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
            raise _broken(f"a frame that cannot be read ({error!r})") from None


def _request(found: Mapping[str, Any]) -> EstimateRequest:
    return EstimateRequest(
        int(found["id"]), int(found["tick"]), bool(found["whole"]), bool(found["from_last"])
    )


def _broken(what: str) -> SessionError:
    return SessionError(
        f"The stream of samples to the online fit is broken: {what}. It has to come from a program "
        "of the same version."
    )


# Answers in words


def mode_line(mode: Mapping[str, Any]) -> str:
    """Write one estimated mode.

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
    hz, damping = mode["frequency_hz"], mode["damping_ratio"]
    text = (
        f"mode {mode['mode']}: {with_half_width(hz['value'], hz['interval_95'])} Hz, "
        f"damping {with_half_width(damping['value'], damping['interval_95'], 100.0)} %"
    )
    inertia = mode.get("participation")
    if inertia is None:
        return text
    shown = with_half_width(inertia["value"], inertia["interval_95"], _KG_MM2)
    return f"{text}, inertia {shown} kg·mm²"


def estimate_lines(answer: Mapping[str, Any], before: Mapping[str, Any] | None = None) -> list[str]:
    """Write an answer of the online fit in a few lines.

    Parameters
    ----------
    answer
        Answer in the format of docs/online_fit.md.
    before
        The answer with which the modes are compared; None: no comparison.
    """
    found = [f"  {sentence}" for sentence in answer["findings"]]
    if answer["problem"]:
        return [f"After {answer['duration_s']:.1f} s: {answer['problem']}", *found]
    validity = Validity.of_document(answer.get("validity")).short
    head = f"± 95 %, statistical only; tip slope {validity}"
    lines = [f"After {answer['duration_s']:.1f} s ({head}):"]
    earlier = {mode["mode"]: mode for mode in (before or {}).get("modes", ()) if mode["shown"]}
    for mode in answer["modes"]:
        if mode["shown"]:
            change = _change(earlier[mode["mode"]], mode) if mode["mode"] in earlier else ""
            doubt = mode["damping_ratio"]["flag"] or mode["frequency_hz"]["flag"]
            lines.append(f"  {mode_line(mode)}{change}{f' (doubtful: {doubt})' if doubt else ''}")
    unseen = unseen_modes(answer["modes"])
    if unseen:
        lines.append(f"  not visible so far: {unseen}")
    if uniform_beam := Validity.of_document(answer.get("validity")).uniform_beam:
        lines.append(f"  {uniform_beam.sentence}")
    return [*lines, *found]


def unseen_modes(modes: Iterable[Mapping[str, Any]]) -> str:
    """Name the modes that the record does not show so far; empty if it shows all.

    Parameters
    ----------
    modes
        Modes in the format of the online fit's answers.

    Examples
    --------
    >>> from rigd.session.online_fit import unseen_modes
    >>> unseen_modes([{"mode": n, "shown": n == 1} for n in (1, 2, 3)])
    'modes 2 and 3'
    """
    unseen = [str(mode["mode"]) for mode in modes if not mode.get("shown", True)]
    return f"mode{'s' if len(unseen) > 1 else ''} {listed(unseen)}" if unseen else ""


def _change(before: Mapping[str, Any], mode: Mapping[str, Any]) -> str:
    hz, damping = mode["frequency_hz"], mode["damping_ratio"]
    shift_hz = hz["value"] - before["frequency_hz"]["value"]
    was = before["damping_ratio"]["value"]
    digits = decimals(hz["std"]) if hz["std"] else 4
    relative = f", {100 * (damping['value'] / was - 1):+.2g} %" if was else ""
    return f"; change {shift_hz:+.{digits}f} Hz{relative}"
