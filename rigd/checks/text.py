"""Values of devices as an operator reads them; the unit is the end of a key."""

from math import isfinite

_UNITS = {
    "_hz": (1.0, "Hz"),
    "_s": (1e3, "ms"),
    "_ns": (1e-6, "ms"),
    "_us": (1e-3, "ms"),
    "_n_nm": (1.0, "N, N·m"),
    "_nm": (1.0, "N·m"),
    "_n": (1.0, "N"),
    "_rad": (1.0, "rad"),
    "_rad_s": (1.0, "rad/s"),
    "_percent": (1.0, "%"),
}
_ENDS = sorted(_UNITS, key=len, reverse=True)


def name_of(key: str) -> str:
    """Return a key as words, without its unit."""
    end = _end(key)
    return (key[: -len(end)] if end else key).replace("_", " ")


def value_of(key: str, value: object) -> str:
    """Return the value of a key with its unit; numbers to four digits."""
    end = _end(key)
    factor, unit = _UNITS[end] if end else (1.0, "")
    if isinstance(value, list | tuple) and not all(_is_number(each) for each in value):
        return "; ".join(map(str, value))
    if isinstance(value, list | tuple):
        text = ", ".join(f"{factor * each:.4g}" for each in value) or "none"
    elif isinstance(value, float):
        text = f"{factor * value:.4g}" if isfinite(value) else "none"
    elif isinstance(value, int) and not isinstance(value, bool) and end:
        text = f"{factor * value:.4g}"
    else:
        return str(value)
    return f"{text} {unit}".rstrip()


def _end(key: str) -> str:
    return next((end for end in _ENDS if key.endswith(end)), "")


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
