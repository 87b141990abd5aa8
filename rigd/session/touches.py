"""Touches in a session file: JSON in its metadata ``outcome``, and messages of `/rig/touch`."""

import json
from collections.abc import Mapping, Sequence
from math import isfinite, nan
from typing import Any, Final

from rigd.session.layout import pack_touch
from rigd.units import with_half_width

_ESTIMATED: Final = {
    "x_m": "m from the axis",
    "time_s": "s",
    "force_n": "N",
    "stiffness_n_per_m": "N/m",
}
"""Estimated quantities of a touch, and their units in words."""
_MOST: Final = 1000
"""Touches that are read."""
_MOST_CHARACTERS: Final = 100


def touches_of(outcome: Mapping[str, str] | None) -> list[dict[str, Any]]:
    """Return the valid touches in the outcome of a session.

    Parameters
    ----------
    outcome
        The record ``outcome`` of any file.
    """
    try:
        listed = json.loads((outcome or {}).get("touches", "[]"))
    except (ValueError, RecursionError):
        return []
    if not isinstance(listed, list):
        return []
    return [_touch(each) for each in listed[:_MOST] if isinstance(each, dict)]


def _touch(stated: Mapping[str, Any]) -> dict[str, Any]:
    number, kind = stated.get("number"), stated.get("kind")
    touch: dict[str, Any] = {
        "number": number if isinstance(number, int) and 0 < number < 10**9 else 0,
        **{name: _estimated(stated.get(name)) for name in _ESTIMATED},
    }
    first = {"final": False} if stated.get("final") is False else {}
    return touch | {"kind": kind[:_MOST_CHARACTERS] if isinstance(kind, str) else ""} | first


def _estimated(stated: Any) -> dict[str, Any] | None:  # noqa: ANN401 - any JSON value
    """Return a number with its uncertainty; None if it is invalid."""
    if not isinstance(stated, dict):
        return None
    ends = stated.get("interval_95")
    numbers = [stated.get("value"), stated.get("std"), *(ends if isinstance(ends, list) else ())]
    if len(numbers) != 4 or not all(
        isinstance(each, int | float) and abs(each) < 1e15 and isfinite(each) for each in numbers
    ):
        return None
    value, std, low, high = map(float, numbers)
    return {"value": value, "std": std, "interval_95": [low, high]}


def touch_line(touch: Mapping[str, Any]) -> str:
    """Return one line about a touch: its estimates and its kind.

    Parameters
    ----------
    touch
        As in JSON documents.
    """
    parts = [
        f"{with_half_width(found['value'], found['interval_95'])} {unit}"
        for name, unit in _ESTIMATED.items()
        if (found := touch.get(name)) is not None
    ]
    kind = touch.get("kind", "")
    parts.append("kind: cannot tell" if kind == "unknown" else kind)
    what = ", ".join(part for part in parts if part) or "not estimated"
    first = "" if touch.get("final", True) else " (first estimate)"
    return f"Touch {touch['number']}: {what}{first}"


def packed_touches(touches: Sequence[tuple[int, Mapping[str, Any]]], rate_hz: float) -> bytes:
    """Return estimated touches as messages of `/rig/touch`.

    Parameters
    ----------
    touches
        Tick of the detection, and the touch as in JSON documents.
    rate_hz
        Ticks a second.
    """

    def numbers(touch: Mapping[str, Any], name: str) -> tuple[float, float]:
        found = touch.get(name)
        return (nan, nan) if found is None else (found["value"], found["std"])

    messages = []
    for tick, touch in touches:
        time = touch.get("time_s")
        time_s = tick / rate_hz if time is None else time["value"]
        values = (numbers(touch, name) for name in ("x_m", "force_n", "stiffness_n_per_m"))
        x, force, stiffness = values
        messages.append(
            pack_touch(round(1e9 * time_s), tick, *x, *force, *stiffness, touch.get("kind", ""))
        )
    return b"".join(messages)
