"""Reader of quick looks, the short reports that the analyser writes next to session files.

docs/quick_look.md describes the files. Since any user may have written such a file, its contents
are checked here for the live view, the page, the library and the analyser. The fit in a session
file is checked in the same way.
"""

import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from rigd.estimates import Estimate, modes_from_json
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
"""Flags for opening a file without blocking, so that a pipe is read as an empty file."""
_MAX_TEXT_CHARACTERS: Final = 1000
"""Maximum number of characters of a text that are read from a document."""
_MAX_FILES_READ: Final = 200
"""Maximum number of quick looks that are read to find the last one; a thousand take seconds."""
_TEXT_KEYS: Final = ("file", "session_id", "specimen", "excitation")
_TIME_KEYS: Final = ("start_utc_ns", "made_utc_ns")
_LINE_LIST_KEYS: Final = ("flags", "text")
_PARSING_ERRORS: Final = (OSError, ValueError, TypeError, KeyError, OverflowError, RecursionError)
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
            **{key_name: _checked_text(document.get(key_name) or "") for key_name in _TEXT_KEYS},
            **{key_name: int(document.get(key_name) or 0) for key_name in _TIME_KEYS},
            "modes": [mode.as_json() for mode in modes_from_json(document.get("modes"))],
            "validity": Validity.from_document(document.get("validity")).as_json(),
            "response": _valid_response(document.get("response")),
            "model": _valid_curves(document.get("model"), (*_CURVE_KEYS, *_CONFIDENCE_BAND_KEYS)),
            **{
                key_name: [_checked_text(text_line) for text_line in document.get(key_name) or []]
                for key_name in _LINE_LIST_KEYS
            },
        }
    except _PARSING_ERRORS:
        return None


def last_quick_look(
    folder: Path,
    specimen: str,
    *,
    before_utc_ns: int | None = None,
    excluded_session: str = "",
    is_usable: Callable[[Document], object],
) -> tuple[Path, Document] | None:
    """Return the latest usable quick look at a session of a specimen.

    Parameters
    ----------
    folder
        Folder of the session files.
    specimen
        Name of the specimen, or empty for sessions that state no specimen.
    before_utc_ns
        Only sessions that started before this time are considered; None for all sessions.
    excluded_session
        File name, without suffix, of a session that is not considered.
    is_usable
        Function that returns whether a quick look's document can be used.

    Returns
    -------
    tuple of Path and dict, or None
        Path of the session file, and the quick look's document from `read_quick_look`; None if
        there is no such session.
    """
    for report_path in sorted(_newest_quick_looks(folder), key=_start_utc_ns, reverse=True):
        if (
            report_path.name != excluded_session + QUICK_LOOK_SUFFIX
            and (report_document := read_quick_look(report_path)) is not None
            and report_document["specimen"] == specimen
            and (before_utc_ns is None or report_document["start_utc_ns"] < before_utc_ns)
            and is_usable(report_document)
        ):
            return report_path.with_name(
                report_path.name.removesuffix(QUICK_LOOK_SUFFIX) + ".mcap"
            ), report_document
    return None


def _newest_quick_looks(folder: Path) -> list[Path]:
    """Return the paths of the 200 newest quick looks in a folder."""
    times_and_paths: list[tuple[float, Path]] = []
    with suppress(OSError):
        for report_path in folder.glob(f"*{QUICK_LOOK_SUFFIX}"):
            with suppress(OSError):
                times_and_paths.append((report_path.stat().st_mtime, report_path))
    return [
        report_path for _, report_path in sorted(times_and_paths, reverse=True)[:_MAX_FILES_READ]
    ]


def _start_utc_ns(path: Path) -> int:
    """Return the start time, in ns since the Unix epoch, of the session of a quick look.

    Returns 0 if it is unknown. This is six times faster than `read_quick_look`, because the file is
    not checked.
    """
    try:
        return int(json.loads(_file_beginning(path)).get("start_utc_ns") or 0)
    except (*_PARSING_ERRORS, AttributeError):
        return 0


def _file_beginning(path: Path) -> bytes:
    """Return the first mebibyte of a file, without waiting if the file is a pipe."""
    file_descriptor = os.open(path, os.O_RDONLY | _NONBLOCKING_FLAGS)
    with open(file_descriptor, "rb") as opened_file:  # noqa: PTH123 - of a descriptor
        return opened_file.read(_MAX_FILE_BYTES)


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
        ``modes`` and ``parameters`` by name as in `rigd.estimates`, and ``findings``. For a session
        that ended when a precision was reached, ``search`` contains the ``reason`` of its end, and
        ``targets`` with name, quantity, mode, value, and estimated and requested deviation.
    """
    try:
        fit_text = (outcome or {})["fit"]
        fit_document = json.loads(
            fit_text, parse_constant=lambda _: None, parse_float=_finite_or_none
        )
        duration_s = finite_number(fit_document["duration_s"])
        parameter_estimates = {
            _checked_text(parameter_name): Estimate.from_json(estimate_document)
            for parameter_name, estimate_document in fit_document.get("parameters", {}).items()
        }
        search_document = fit_document.get("search") or {}
        return {
            "duration_s": max(duration_s or 0.0, 0.0),
            "problem": _checked_text(fit_document.get("problem") or ""),
            "validity": Validity.from_document(fit_document.get("validity")).as_json(),
            "modes": [mode.as_json() for mode in modes_from_json(fit_document.get("modes"))],
            "parameters": {
                parameter_name: estimate.as_json()
                for parameter_name, estimate in parameter_estimates.items()
                if estimate is not None
            },
            "findings": [
                _checked_text(text_line) for text_line in fit_document.get("findings") or []
            ],
            "search": {
                "reason": _checked_text(search_document.get("reason") or ""),
                "targets": list(_valid_targets(search_document.get("targets"))),
            },
        }
    except (*_PARSING_ERRORS, AttributeError):
        return None


def _valid_targets(documents: object) -> Iterator[Document]:
    """Yield the entries of a JSON value that are valid statements of a requested precision."""
    for target_document in documents if isinstance(documents, list) else ():
        if isinstance(target_document, dict):
            target_numbers = {
                number_key: finite_number(target_document.get(number_key))
                for number_key in ("value", "std", "asked_std")
            }
            if target_numbers["asked_std"] is not None:
                mode = target_document.get("mode")
                yield {
                    "name": _checked_text(target_document.get("name") or ""),
                    # Older files have names only.
                    "quantity": _checked_text(target_document.get("quantity") or ""),
                    "mode": mode if type(mode) is int else None,
                    **target_numbers,
                }


def _valid_response(response_document: object) -> Document | None:
    """Return a frequency response with coherence and resolution, or None if it is invalid."""
    response_curves = _valid_curves(response_document, _CURVE_KEYS)
    if response_curves is None or not isinstance(response_document, dict):
        return None
    coherence = _finite_numbers(response_document.get("coherence"))
    return {
        **response_curves,
        "coherence": coherence if len(coherence) == len(response_curves["frequency_hz"]) else None,
        "resolution_hz": finite_number(response_document.get("resolution_hz")),
    }


def _valid_curves(curves_document: object, curve_keys: tuple[str, ...]) -> Document | None:
    """Return curves, name → list of finite numbers; None if lengths differ or are 0."""
    if not isinstance(curves_document, dict):
        return None
    curves = {
        curve_key: _finite_numbers(curves_document.get(curve_key)) for curve_key in curve_keys
    }
    point_count = len(curves["frequency_hz"])
    if not point_count or any(len(curve) != point_count for curve in curves.values()):
        return None
    return curves


def _finite_numbers(json_values: object) -> list[float]:
    """Return a JSON list if it contains only finite numbers, otherwise an empty list."""
    finite_values = (
        [finite_number(json_value) for json_value in json_values]
        if isinstance(json_values, list)
        else []
    )
    return [] if None in finite_values else finite_values  # type: ignore[return-value]


def _finite_or_none(number_text: str) -> float | None:
    """Return the finite number that a text states, or None if it is infinite or NaN."""
    return finite_number(float(number_text))


def _checked_text(json_value: object) -> str:
    """Return a text without control characters, cut to 1000 characters; TypeError if no text."""
    if not isinstance(json_value, str):
        raise TypeError
    return printable(json_value, _MAX_TEXT_CHARACTERS)
