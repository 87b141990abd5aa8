"""Checks of an excitation's options; each refusal names option, value, unit and remedy."""

from math import isfinite, pi

SAMPLES_PER_PERIOD = 4
"""Fewest samples in a period of the reference: with less it is no sine any more."""


class ExcitationError(ValueError):
    """An option of an excitation is absurd; the message names option, value, unit and remedy."""


def whole_ticks(option: str, value_s: float, rate_hz: float) -> int:
    """Return a time as its number of ticks; refuse one that is no whole number of them."""
    ticks = round(value_s * rate_hz)
    if ticks < 2 or abs(ticks / rate_hz - value_s) > 1e-9 * value_s:
        raise ExcitationError(
            f"{option} = {value_s:g} s is not a whole number of ticks at {rate_hz:g} Hz; choose "
            f"for example {max(ticks, 2) / rate_hz:g} s."
        )
    return ticks


def finite(option: str, value: float, unit: str) -> None:
    """Refuse what is not a finite number."""
    if not isfinite(value):
        raise ExcitationError(f"{option} = {value} {unit} is not a finite number; give one.")


def positive(option: str, value: float, unit: str) -> None:
    """Refuse what is not a finite number above 0."""
    finite(option, value, unit)
    if value <= 0.0:
        raise ExcitationError(f"{option} = {value:g} {unit} must be more than 0 {unit}.")


def not_negative(option: str, value: float) -> None:
    """Refuse a time that is not finite or below 0 s."""
    finite(option, value, "s")
    if value < 0.0:
        raise ExcitationError(f"{option} = {value:g} s must not be negative.")


def within_a_turn(option: str, value_rad: float) -> None:
    """Refuse an angle beyond a full turn to either side."""
    if abs(value_rad) > 2.0 * pi:
        raise ExcitationError(
            f"{option} = {value_rad:g} rad is more than a full turn; give an angle in rad of at "
            f"most {2.0 * pi:.3f}."
        )


def frequency(option: str, value: float, rate_hz: float, *, zero_allowed: bool = False) -> None:
    """Refuse a frequency that is not above 0, or has too few samples a period."""
    finite(option, value, "Hz")
    highest = rate_hz / SAMPLES_PER_PERIOD
    if not (value > 0.0 or (zero_allowed and value == 0.0)):
        bound = "must not be negative" if zero_allowed else "must be more than 0 Hz"
        raise ExcitationError(f"{option} = {value:g} Hz {bound}.")
    if value > highest:
        raise ExcitationError(
            f"{option} = {value:g} Hz leaves fewer than {SAMPLES_PER_PERIOD} samples a period at "
            f"{rate_hz:g} Hz; choose at most {highest:g} Hz."
        )
