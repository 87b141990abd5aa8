"""Estimated touches (contacts of the beam with an obstacle) in a session file.

They are JSON in the record ``outcome``, and messages of the topic ``/rig/touch``.
"""

import json
from collections.abc import Mapping, Sequence
from math import isfinite, nan
from typing import Any, Final

from rigd.session.layout import pack_touch
from rigd.units import with_half_width

_QUANTITY_UNITS: Final = {
    "x_m": "m from the axis",
    "time_s": "s",
    "force_n": "N",
    "stiffness_n_per_m": "N/m",
}
"""Name of an estimated quantity of a touch → its unit in the text for the operator."""
_MAX_TOUCHES: Final = 1000
"""Maximum number of touches that are read from a session file."""
_MAX_KIND_CHARACTERS: Final = 100
"""Maximum number of characters of a touch's kind that are read."""


def touches_of(outcome: Mapping[str, str] | None) -> list[dict[str, Any]]:
    """Return the estimated touches that the record ``outcome`` of a session states.

    Parameters
    ----------
    outcome
        Record ``outcome`` of a session file from any source.

    Returns
    -------
    list of dict
        For each touch its number, kind and estimated quantities; an invalid quantity is None.
    """
    try:
        documents = json.loads((outcome or {}).get("touches", "[]"))
    except (ValueError, RecursionError):
        return []
    if not isinstance(documents, list):
        return []
    return [_checked_touch(each) for each in documents[:_MAX_TOUCHES] if isinstance(each, dict)]


def _checked_touch(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a touch with checked values from a JSON object."""
    number, kind = document.get("number"), document.get("kind")
    touch: dict[str, Any] = {
        "number": number if isinstance(number, int) and 0 < number < 10**9 else 0,
        **{name: _checked_estimate(document.get(name)) for name in _QUANTITY_UNITS},
    }
    first_estimate_mark = {"final": False} if document.get("final") is False else {}
    return (
        touch
        | {"kind": kind[:_MAX_KIND_CHARACTERS] if isinstance(kind, str) else ""}
        | first_estimate_mark
    )


def _checked_estimate(document: Any) -> dict[str, Any] | None:  # noqa: ANN401 - any JSON value
    """Return an estimate with its uncertainty from any JSON value, or None if it is invalid."""
    if not isinstance(document, dict):
        return None
    bounds = document.get("interval_95")
    numbers = [
        document.get("value"),
        document.get("std"),
        *(bounds if isinstance(bounds, list) else ()),
    ]
    if len(numbers) != 4 or not all(
        isinstance(each, int | float) and abs(each) < 1e15 and isfinite(each) for each in numbers
    ):
        return None
    value, std, low, high = map(float, numbers)
    return {"value": value, "std": std, "interval_95": [low, high]}


def touch_line(touch: Mapping[str, Any]) -> str:
    """Return one line of text with the estimated quantities and the kind of a touch.

    Parameters
    ----------
    touch
        Touch as in JSON documents and from `touches_of`.
    """
    texts = [
        f"{with_half_width(estimate['value'], estimate['interval_95'])} {unit}"
        for name, unit in _QUANTITY_UNITS.items()
        if (estimate := touch.get(name)) is not None
    ]
    kind = touch.get("kind", "")
    texts.append("kind: cannot tell" if kind == "unknown" else kind)
    estimates_text = ", ".join(part for part in texts if part) or "not estimated"
    first = "" if touch.get("final", True) else " (first estimate)"
    return f"Touch {touch['number']}: {estimates_text}{first}"


def packed_touches(touches: Sequence[tuple[int, Mapping[str, Any]]], rate_hz: float) -> bytes:
    """Return the encoded messages of the topic ``/rig/touch`` for estimated touches.

    Parameters
    ----------
    touches
        For each touch, the tick in which it was detected, and the touch as in JSON documents.
    rate_hz
        Sample rate, in ticks per second.
    """

    def value_and_std(touch: Mapping[str, Any], name: str) -> tuple[float, float]:
        estimate = touch.get(name)
        return (nan, nan) if estimate is None else (estimate["value"], estimate["std"])

    messages = []
    for tick, touch in touches:
        time = touch.get("time_s")
        time_s = tick / rate_hz if time is None else time["value"]
        values = (value_and_std(touch, name) for name in ("x_m", "force_n", "stiffness_n_per_m"))
        x, force, stiffness = values
        messages.append(
            pack_touch(round(1e9 * time_s), tick, *x, *force, *stiffness, touch.get("kind", ""))
        )
    return b"".join(messages)
