"""Estimated touches (contacts of the beam with an obstacle) in a session file.

A session file contains them as JSON in the record ``outcome``, and as messages of the topic
``/rig/touch``.
"""

import json
from collections.abc import Mapping, Sequence
from math import isfinite, nan
from typing import Any, Final

from rigd.session.layout import pack_touch
from rigd.units import with_interval

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
        touch_documents = json.loads((outcome or {}).get("touches", "[]"))
    except (ValueError, RecursionError):
        return []
    if not isinstance(touch_documents, list):
        return []
    return [
        _checked_touch(touch_document)
        for touch_document in touch_documents[:_MAX_TOUCHES]
        if isinstance(touch_document, dict)
    ]


def _checked_touch(touch_document: Mapping[str, Any]) -> dict[str, Any]:
    """Return the touch that a JSON object states, with None for each invalid quantity."""
    touch_number, touch_kind = touch_document.get("number"), touch_document.get("kind")
    touch: dict[str, Any] = {
        "number": touch_number if isinstance(touch_number, int) and 0 < touch_number < 10**9 else 0,
        **{
            quantity_name: _checked_estimate(touch_document.get(quantity_name))
            for quantity_name in _QUANTITY_UNITS
        },
    }
    not_final_entry = {"final": False} if touch_document.get("final") is False else {}
    return (
        touch
        | {"kind": touch_kind[:_MAX_KIND_CHARACTERS] if isinstance(touch_kind, str) else ""}
        | not_final_entry
    )


def _checked_estimate(estimate_document: Any) -> dict[str, Any] | None:  # noqa: ANN401 - any JSON value
    """Return a touch's estimate with its uncertainty from a JSON value, or None if invalid."""
    if not isinstance(estimate_document, dict):
        return None
    interval_bounds = estimate_document.get("interval_95")
    estimate_numbers = [
        estimate_document.get("value"),
        estimate_document.get("std"),
        *(interval_bounds if isinstance(interval_bounds, list) else ()),
    ]
    if len(estimate_numbers) != 4 or not all(
        isinstance(number, int | float) and abs(number) < 1e15 and isfinite(number)
        for number in estimate_numbers
    ):
        return None
    estimated_value, std, lower_bound, upper_bound = map(float, estimate_numbers)
    return {"value": estimated_value, "std": std, "interval_95": [lower_bound, upper_bound]}


def touch_line(touch: Mapping[str, Any]) -> str:
    """Return one line of text with the estimated quantities and the kind of a touch.

    Parameters
    ----------
    touch
        Touch as in JSON documents and from `touches_of`.
    """
    quantity_texts = [
        f"{with_interval(estimate['value'], estimate['interval_95'])} {unit_text}"
        for quantity_name, unit_text in _QUANTITY_UNITS.items()
        if (estimate := touch.get(quantity_name)) is not None
    ]
    touch_kind = touch.get("kind", "")
    quantity_texts.append("kind: not identifiable" if touch_kind == "unknown" else touch_kind)
    estimates_text = (
        ", ".join(quantity_text for quantity_text in quantity_texts if quantity_text)
        or "not estimated"
    )
    first_estimate_note = "" if touch.get("final", True) else " (first estimate)"
    return f"Touch {touch['number']}: {estimates_text}{first_estimate_note}"


def packed_touches(touches: Sequence[tuple[int, Mapping[str, Any]]], rate_hz: float) -> bytes:
    """Return the encoded messages of the topic ``/rig/touch`` for estimated touches.

    Parameters
    ----------
    touches
        For each touch, the tick in which it was detected, and the touch as in JSON documents.
    rate_hz
        Sample rate, in ticks per second.
    """

    def value_and_std(touch: Mapping[str, Any], quantity_name: str) -> tuple[float, float]:
        estimate = touch.get(quantity_name)
        return (nan, nan) if estimate is None else (estimate["value"], estimate["std"])

    encoded_messages = []
    for tick, touch in touches:
        touch_time = touch.get("time_s")
        time_s = tick / rate_hz if touch_time is None else touch_time["value"]
        touch_values = (
            value_and_std(touch, quantity_name)
            for quantity_name in ("x_m", "force_n", "stiffness_n_per_m")
        )
        x, force, stiffness = touch_values
        encoded_messages.append(
            pack_touch(round(1e9 * time_s), tick, *x, *force, *stiffness, touch.get("kind", ""))
        )
    return b"".join(encoded_messages)
