"""Reader of quick looks, the short reports that the analyzer writes next to session files.

docs/quick_look.md describes the files. Since any user may have written such a file, its contents
are checked here for the live view, the page, the library and the analyzer. The fit in a session
file is checked in the same way.
"""

import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from rigd.printable import printable
from rigd.session._validity import Validity
from rigd.units import finite_number

Document = dict[str, Any]

QUICK_LOOK_SUFFIX: Final = ".look.json"
"""Suffix of a quick look's file, which replaces the suffix of the session file."""
QUICK_LOOK_VERSION: Final = 1
"""Version of the format of quick looks."""

_MAX_FILE_BYTES: Final = 1 << 20
"""Maximum length in bytes of a quick look that is read."""
_NONBLOCKING_FLAGS: Final = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
"""Flags for opening a file without blocking: a pipe then reads as empty."""
_MAX_MODES: Final = 20
"""Maximum number of modes that are read from a document."""
_MAX_TEXT_CHARACTERS: Final = 1000
"""Maximum number of characters of a text that are read from a document."""
_MAX_FILES_READ: Final = 200
"""Maximum number of quick looks that are read to find the last one: a thousand take seconds."""
_TEXT_KEYS: Final = ("file", "session_id", "specimen", "excitation")
_TIME_KEYS: Final = ("start_utc_ns", "made_utc_ns")
_LINE_LIST_KEYS: Final = ("flags", "text")
_PARSING_ERRORS: Final = (OSError, ValueError, TypeError, KeyError, OverflowError, RecursionError)
_MODE_SOURCES: Final = ("modal", "beam")
_CURVE_KEYS: Final = ("frequency_hz", "magnitude", "phase_rad")
_CONFIDENCE_BAND_KEYS: Final = ("magnitude_low_95", "magnitude_high_95")


def quick_look_path(path: Path) -> Path:
    """Return the path of a session's quick look, which is in the folder of the session file.

    Examples
    --------
    >>> from pathlib import Path
    >>> from rigd.session.quick_look import quick_look_path
    >>> print(quick_look_path(Path("sessions/20261120-101500-chirp.mcap")))
    sessions/20261120-101500-chirp.look.json
    """
    return path.with_suffix(QUICK_LOOK_SUFFIX)


def read_quick_look(path: Path) -> Document | None:
    """Read and check the file of a quick look.

    Parameters
    ----------
    path
        Path of the quick look, from `quick_look_path`.

    Returns
    -------
    dict or None
        Document in the format of docs/quick_look.md, with empty values for missing keys. All
        numbers are finite and all texts printable. ``modes`` contains valid modes only.
        ``response`` and ``model`` are None if invalid. The result is None if the file does not
        exist, cannot be read, or has another version.
    """
    try:
        document = json.loads(
            _file_beginning(path), parse_constant=lambda _: None, parse_float=_finite_or_none
        )
        if document["version"] != QUICK_LOOK_VERSION:
            return None
        return dict(document) | {
            **{name: _checked_text(document.get(name) or "") for name in _TEXT_KEYS},
            **{name: int(document.get(name) or 0) for name in _TIME_KEYS},
            "modes": modes_of(document.get("modes")),
            "validity": Validity.of_document(document.get("validity")).as_json(),
            "response": _valid_response(document.get("response")),
            "model": _valid_curves(document.get("model"), (*_CURVE_KEYS, *_CONFIDENCE_BAND_KEYS)),
            **{
                name: [_checked_text(line) for line in document.get(name) or []]
                for name in _LINE_LIST_KEYS
            },
        }
    except _PARSING_ERRORS:
        return None


def last_quick_look(
    folder: Path,
    specimen: str,
    *,
    before_utc_ns: int | None = None,
    but: str = "",
    usable: Callable[[Document], object],
) -> tuple[Path, Document] | None:
    """Return the last usable quick look at a session of a specimen.

    Parameters
    ----------
    folder
        Folder of the session files.
    specimen
        Name of the specimen, or empty for sessions that state no specimen.
    before_utc_ns
        Only sessions that started before this time are considered; None for all sessions.
    but
        File name, without suffix, of a session that is not considered.
    usable
        Function that returns whether a quick look's document can be used.

    Returns
    -------
    tuple of Path and dict, or None
        Path of the session file, and the quick look's document from `read_quick_look`; None if
        there is no such session.
    """
    for path in sorted(_newest_quick_looks(folder), key=_start_utc_ns, reverse=True):
        if (
            path.name != but + QUICK_LOOK_SUFFIX
            and (report := read_quick_look(path)) is not None
            and report["specimen"] == specimen
            and (before_utc_ns is None or report["start_utc_ns"] < before_utc_ns)
            and usable(report)
        ):
            return path.with_name(path.name.removesuffix(QUICK_LOOK_SUFFIX) + ".mcap"), report
    return None


def _newest_quick_looks(folder: Path) -> list[Path]:
    """Return the paths of the 200 newest quick looks in a folder."""
    times_and_paths: list[tuple[float, Path]] = []
    with suppress(OSError):
        for path in folder.glob(f"*{QUICK_LOOK_SUFFIX}"):
            with suppress(OSError):
                times_and_paths.append((path.stat().st_mtime, path))
    return [path for _, path in sorted(times_and_paths, reverse=True)[:_MAX_FILES_READ]]


def _start_utc_ns(path: Path) -> int:
    """Return the start time of a quick look's session in ns since the Unix epoch, or 0.

    The file is not checked, which makes this six times faster than `read_quick_look`.
    """
    try:
        return int(json.loads(_file_beginning(path)).get("start_utc_ns") or 0)
    except (*_PARSING_ERRORS, AttributeError):
        return 0


def _file_beginning(path: Path) -> bytes:
    """Return the first mebibyte of a file, without waiting if the file is a pipe."""
    descriptor = os.open(path, os.O_RDONLY | _NONBLOCKING_FLAGS)
    with open(descriptor, "rb") as file:  # noqa: PTH123 - of a descriptor
        return file.read(_MAX_FILE_BYTES)


def modes_of(documents: object) -> list[Document]:
    """Return the valid modes of a quick look or a report.

    Parameters
    ----------
    documents
        Value of the key ``modes`` of a document from any source.

    Returns
    -------
    list of dict
        For each mode: ``mode`` (its number), ``shown`` (whether the record shows it), ``source``
        ("modal", "beam" or None), and ``frequency_hz``, ``damping_ratio`` and ``participation``
        (kg m², or None), each with ``value``, ``std``, ``interval_95`` and ``flag``. Modes without
        finite numbers or without a positive frequency are left out.
    """
    return list(_valid_modes(documents)) if isinstance(documents, list) else []


def _valid_modes(documents: list[object]) -> Iterator[Document]:
    """Yield the valid modes of a list of any JSON values."""
    for index, mode in enumerate(documents[:_MAX_MODES], start=1):
        if isinstance(mode, dict):
            number, shown = mode.get("mode", index), mode.get("shown") is not False
            frequency, damping = (
                _valid_estimate(mode.get(k)) for k in ("frequency_hz", "damping_ratio")
            )
            if (
                type(number) is int
                and frequency is not None
                and frequency["value"] > 0
                and damping is not None
            ):
                source = mode.get("source")
                yield {
                    "mode": number,
                    "shown": shown,
                    "frequency_hz": frequency,
                    "damping_ratio": damping,
                    "participation": _valid_estimate(mode.get("participation")),
                    "source": source if source in _MODE_SOURCES else None,
                }


def fit_of(outcome: Mapping[str, str] | None) -> Document | None:
    """Return the result of the fit that was made during a session, or None if there is none.

    Parameters
    ----------
    outcome
        Record ``outcome`` of a session file from any source.

    Returns
    -------
    dict or None
        ``duration_s`` of the fitted record, ``problem``, ``validity`` from `Validity.as_json`,
        ``modes`` from `modes_of`, ``parameters`` by name, and ``findings``. For a session that
        ended when a precision was reached, ``search`` contains the ``reason`` of its end, and
        ``targets`` with name, quantity, mode, value, and estimated and requested deviation.
    """
    try:
        text = (outcome or {})["fit"]
        document = json.loads(text, parse_constant=lambda _: None, parse_float=_finite_or_none)
        duration_s = finite_number(document["duration_s"])
        parameters = {
            _checked_text(name): _valid_estimate(value)
            for name, value in document.get("parameters", {}).items()
        }
        search = document.get("search") or {}
        return {
            "duration_s": max(duration_s or 0.0, 0.0),
            "problem": _checked_text(document.get("problem") or ""),
            "validity": Validity.of_document(document.get("validity")).as_json(),
            "modes": modes_of(document.get("modes")),
            "parameters": {name: value for name, value in parameters.items() if value is not None},
            "findings": [_checked_text(line) for line in document.get("findings") or []],
            "search": {
                "reason": _checked_text(search.get("reason") or ""),
                "targets": list(_valid_targets(search.get("targets"))),
            },
        }
    except (*_PARSING_ERRORS, AttributeError):
        return None


def _valid_targets(documents: object) -> Iterator[Document]:
    """Yield the valid precision targets of any JSON value."""
    for target in documents if isinstance(documents, list) else ():
        if isinstance(target, dict):
            numbers = {
                name: finite_number(target.get(name)) for name in ("value", "std", "asked_std")
            }
            if numbers["asked_std"] is not None:
                mode = target.get("mode")
                yield {
                    "name": _checked_text(target.get("name") or ""),
                    # Older files have names only.
                    "quantity": _checked_text(target.get("quantity") or ""),
                    "mode": mode if type(mode) is int else None,
                    **numbers,
                }


def _valid_estimate(document: object) -> Document | None:
    """Return an estimate with value, standard deviation and interval, or None if it is invalid."""
    if not isinstance(document, dict) or (value := finite_number(document.get("value"))) is None:
        return None
    bounds = document.get("interval_95")
    interval = (
        [finite_number(end) for end in bounds]
        if isinstance(bounds, list) and len(bounds) == 2
        else None
    )
    flag = document.get("flag")
    return {
        "value": value,
        "std": finite_number(document.get("std")),
        "interval_95": None if interval is None or None in interval else interval,
        "flag": _checked_text(flag) if isinstance(flag, str) else None,
    }


def _valid_response(document: object) -> Document | None:
    """Return a frequency response with coherence and resolution, or None if it is invalid."""
    curves = _valid_curves(document, _CURVE_KEYS)
    if curves is None or not isinstance(document, dict):
        return None
    coherence = _finite_numbers(document.get("coherence"))
    return {
        **curves,
        "coherence": coherence if len(coherence) == len(curves["frequency_hz"]) else None,
        "resolution_hz": finite_number(document.get("resolution_hz")),
    }


def _valid_curves(document: object, names: tuple[str, ...]) -> Document | None:
    """Return lists of finite numbers by name, or None unless all have the same length above 0."""
    if not isinstance(document, dict):
        return None
    curves = {name: _finite_numbers(document.get(name)) for name in names}
    points = len(curves["frequency_hz"])
    if not points or any(len(curve) != points for curve in curves.values()):
        return None
    return curves


def _finite_numbers(values: object) -> list[float]:
    """Return a list of finite numbers, or an empty list if it contains any other value."""
    numbers = [finite_number(value) for value in values] if isinstance(values, list) else []
    return [] if None in numbers else numbers  # type: ignore[return-value]


def _finite_or_none(text: str) -> float | None:
    """Return the finite number that a text states, or None if it is infinite or NaN."""
    return finite_number(float(text))


def _checked_text(value: object) -> str:
    """Return a text without control characters, cut to 1000; raise TypeError if it is no text."""
    if not isinstance(value, str):
        raise TypeError
    return printable(value, _MAX_TEXT_CHARACTERS)
