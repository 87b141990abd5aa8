"""Quick looks: the reports that the analyzer writes next to session files, and their reader.

docs/quick_look.md describes the files. Any user may have written such a file: its contents are
checked here, once for the live view, the page, the library and the analyzer. The same checks apply
to the fit in a session file.
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
"""Ending of a quick look's file, instead of the session file's."""
QUICK_LOOK_VERSION: Final = 1
"""Version of the file's layout."""

_MOST_BYTES: Final = 1 << 20
_WITHOUT_WAITING: Final = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
"""Flags with which a pipe reads as empty; Windows has neither."""
_MOST_MODES: Final = 20
_MOST_CHARACTERS: Final = 1000
_MOST_READ: Final = 200
"""Most quick looks that are read to find the last one: some thousand would take seconds."""
_TEXTS: Final = ("file", "session_id", "specimen", "excitation")
_TIMES: Final = ("start_utc_ns", "made_utc_ns")
_LINES: Final = ("flags", "text")
_UNREADABLE: Final = (OSError, ValueError, TypeError, KeyError, OverflowError, RecursionError)
_SOURCES: Final = ("modal", "beam")
_CURVES: Final = ("frequency_hz", "magnitude", "phase_rad")
_BAND: Final = ("magnitude_low_95", "magnitude_high_95")


def quick_look_path(path: Path) -> Path:
    """Return the path of a session's quick look, in the same folder as its file.

    Examples
    --------
    >>> from pathlib import Path
    >>> from rigd.session.quick_look import quick_look_path
    >>> print(quick_look_path(Path("sessions/20261120-101500-chirp.mcap")))
    sessions/20261120-101500-chirp.look.json
    """
    return path.with_suffix(QUICK_LOOK_SUFFIX)


def read_quick_look(path: Path) -> Document | None:
    """Read the file of a quick look.

    Parameters
    ----------
    path
        Path of the quick look, from `quick_look_path`.

    Returns
    -------
    dict or None
        Document of docs/quick_look.md, with empty values for missing ones. All numbers are finite,
        texts printable, `modes` the valid ones, and `response` and `model` None if invalid. None if
        the file does not exist, cannot be read, or is of another version.
    """
    try:
        found = json.loads(_content(path), parse_constant=lambda _: None, parse_float=_parsed)
        if found["version"] != QUICK_LOOK_VERSION:
            return None
        return dict(found) | {
            **{name: _text(found.get(name) or "") for name in _TEXTS},
            **{name: int(found.get(name) or 0) for name in _TIMES},
            "modes": modes_of(found.get("modes")),
            "validity": Validity.of_document(found.get("validity")).as_json(),
            "response": _response(found.get("response")),
            "model": _curves(found.get("model"), (*_CURVES, *_BAND)),
            **{name: [_text(line) for line in found.get(name) or []] for name in _LINES},
        }
    except _UNREADABLE:
        return None


def last_quick_look(
    folder: Path,
    specimen: str,
    *,
    before_utc_ns: int | None = None,
    but: str = "",
    usable: Callable[[Document], object],
) -> tuple[Path, Document] | None:
    """Find the quick look at the last session of a specimen.

    Parameters
    ----------
    folder
        Folder of the session files.
    specimen
        Name of the specimen; empty: sessions that name none.
    before_utc_ns
        The session began before this time; None: at any time.
    but
        Name of a session, without ending, to be left out.
    usable
        Returns whether a quick look can be used, by its document.

    Returns
    -------
    tuple of Path and dict, or None
        Path of the session file, and the quick look as `read_quick_look` returns it.
    """
    for path in sorted(_newest(folder), key=_start_utc_ns, reverse=True):
        if (
            path.name != but + QUICK_LOOK_SUFFIX
            and (report := read_quick_look(path)) is not None
            and report["specimen"] == specimen
            and (before_utc_ns is None or report["start_utc_ns"] < before_utc_ns)
            and usable(report)
        ):
            return path.with_name(path.name.removesuffix(QUICK_LOOK_SUFFIX) + ".mcap"), report
    return None


def _newest(folder: Path) -> list[Path]:
    """Return the newest quick looks of a folder."""
    made: list[tuple[float, Path]] = []
    with suppress(OSError):
        for path in folder.glob(f"*{QUICK_LOOK_SUFFIX}"):
            with suppress(OSError):
                made.append((path.stat().st_mtime, path))
    return [path for _, path in sorted(made, reverse=True)[:_MOST_READ]]


def _start_utc_ns(path: Path) -> int:
    """Return the start of a quick look's session, six times faster than by checking the file."""
    try:
        return int(json.loads(_content(path)).get("start_utc_ns") or 0)
    except (*_UNREADABLE, AttributeError):
        return 0


def _content(path: Path) -> bytes:
    descriptor = os.open(path, os.O_RDONLY | _WITHOUT_WAITING)
    with open(descriptor, "rb") as file:  # noqa: PTH123 - of a descriptor
        return file.read(_MOST_BYTES)


def modes_of(documents: object) -> list[Document]:
    """Return the valid modes of a quick look or a report.

    Parameters
    ----------
    documents
        Value of `modes` in any document.

    Returns
    -------
    list of dict
        ``mode`` (its number), ``shown`` (whether the record shows it), ``source`` ("modal", "beam"
        or None), and ``frequency_hz``, ``damping_ratio`` and ``participation`` (kg m², or None),
        each with ``value``, ``std``, ``interval_95`` and ``flag``; modes without finite numbers or
        a positive frequency are left out.
    """
    return list(_modes(documents)) if isinstance(documents, list) else []


def _modes(documents: list[object]) -> Iterator[Document]:
    for index, mode in enumerate(documents[:_MOST_MODES], start=1):
        if isinstance(mode, dict):
            number, shown = mode.get("mode", index), mode.get("shown") is not False
            frequency, damping = (_quantity(mode.get(k)) for k in ("frequency_hz", "damping_ratio"))
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
                    "participation": _quantity(mode.get("participation")),
                    "source": source if source in _SOURCES else None,
                }


def fit_of(outcome: Mapping[str, str] | None) -> Document | None:
    """Return the fit of a record that was made during its session.

    Parameters
    ----------
    outcome
        The record ``outcome`` of any file.

    Returns
    -------
    dict or None
        ``duration_s`` of the fitted record, ``problem``, ``validity`` as of
        `Validity.as_json`, ``modes`` as of `modes_of`,
        ``parameters`` by name, ``findings``, and ``search`` of a session that ended when a
        precision was reached: ``reason`` of its end, and ``targets`` with ``name``,
        ``quantity``, ``mode``, ``value``, ``std`` and ``target_std``. None without a valid fit.
    """
    try:
        text = (outcome or {})["fit"]
        found = json.loads(text, parse_constant=lambda _: None, parse_float=_parsed)
        duration_s = finite_number(found["duration_s"])
        parameters = {
            _text(name): _quantity(value) for name, value in found.get("parameters", {}).items()
        }
        search = found.get("search") or {}
        return {
            "duration_s": max(duration_s or 0.0, 0.0),
            "problem": _text(found.get("problem") or ""),
            "validity": Validity.of_document(found.get("validity")).as_json(),
            "modes": modes_of(found.get("modes")),
            "parameters": {name: value for name, value in parameters.items() if value is not None},
            "findings": [_text(line) for line in found.get("findings") or []],
            "search": {
                "reason": _text(search.get("reason") or ""),
                "targets": list(_targets(search.get("targets"))),
            },
        }
    except (*_UNREADABLE, AttributeError):
        return None


def _targets(documents: object) -> Iterator[Document]:
    for target in documents if isinstance(documents, list) else ():
        if isinstance(target, dict):
            numbers = {
                name: finite_number(target.get(name)) for name in ("value", "std", "asked_std")
            }
            if numbers["asked_std"] is not None:
                mode = target.get("mode")
                yield {
                    "name": _text(target.get("name") or ""),
                    # Older files have names only.
                    "quantity": _text(target.get("quantity") or ""),
                    "mode": mode if type(mode) is int else None,
                    **numbers,
                }


def _quantity(document: object) -> Document | None:
    if not isinstance(document, dict) or (value := finite_number(document.get("value"))) is None:
        return None
    ends = document.get("interval_95")
    interval = (
        [finite_number(end) for end in ends] if isinstance(ends, list) and len(ends) == 2 else None
    )
    flag = document.get("flag")
    return {
        "value": value,
        "std": finite_number(document.get("std")),
        "interval_95": None if interval is None or None in interval else interval,
        "flag": _text(flag) if isinstance(flag, str) else None,
    }


def _response(document: object) -> Document | None:
    """Return a response with its coherence and resolution; None if it is invalid."""
    curves = _curves(document, _CURVES)
    if curves is None or not isinstance(document, dict):
        return None
    coherence = _finite_numbers(document.get("coherence"))
    return {
        **curves,
        "coherence": coherence if len(coherence) == len(curves["frequency_hz"]) else None,
        "resolution_hz": finite_number(document.get("resolution_hz")),
    }


def _curves(document: object, names: tuple[str, ...]) -> Document | None:
    """Return curves of equal length above 0."""
    if not isinstance(document, dict):
        return None
    curves = {name: _finite_numbers(document.get(name)) for name in names}
    points = len(curves["frequency_hz"])
    if not points or any(len(curve) != points for curve in curves.values()):
        return None
    return curves


def _finite_numbers(values: object) -> list[float]:
    """Return the numbers; none at all if there is any other value."""
    numbers = [finite_number(value) for value in values] if isinstance(values, list) else []
    return [] if None in numbers else numbers  # type: ignore[return-value]


def _parsed(text: str) -> float | None:
    return finite_number(float(text))


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError
    return printable(value, _MOST_CHARACTERS)
