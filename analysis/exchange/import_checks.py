"""What a file says of itself against what the user says of it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from analysis.exchange.errors import ExchangeError
from analysis.exchange.timebase import from_time_stamps, uniform
from analysis.exchange.units import canonical_unit, unit_in_brackets, unit_in_suffix
from rigd.printable import printable

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from analysis.exchange.import_plan import ImportPlan
    from analysis.exchange.source import SourceChannel
    from analysis.exchange.timebase import Timebase

_RATE_TOLERANCE: Final = 2e-5
"""Largest relative difference between the rate stated and the file's own, of which UFF58 has six
digits."""

_NO_UNIT: Final = ("", "NONE", "none", "-")


def check_units(path: Path, plan: ImportPlan, channels: Mapping[str, SourceChannel]) -> list[str]:
    """Compare the units stated with those that the file has beside its channels.

    Returns
    -------
    list of str
        Warnings, where the file says something that is not understood.

    Raises
    ------
    ExchangeError
        If the file clearly says another unit.
    """
    warnings = []
    for choice in plan.choices:
        label = channels[choice.channel].unit_label.strip()
        said = canonical_unit(label) if label else unit_in_brackets(choice.channel)
        if said is not None and said != choice.unit:
            raise ExchangeError(
                f"{path}: the file says that '{choice.channel}' is in {said}, and {choice.unit} "
                f"was stated; state '{choice.channel}:{said}', or correct the file."
            )
        if said is None and label not in _NO_UNIT:
            warnings.append(
                f"The file says '{printable(label, 20)}' of '{choice.channel}', which was taken "
                f"to be in {choice.unit} as stated."
            )
        suffix = unit_in_suffix(choice.channel)
        if said is None and suffix not in (None, choice.unit):
            warnings.append(
                f"The name '{choice.channel}' sounds like {suffix}; it was taken to be in "
                f"{choice.unit} as stated."
            )
    return warnings


def timebase(path: Path, plan: ImportPlan, channels: Mapping[str, SourceChannel]) -> Timebase:
    """Place the samples in time, by the channel of times or by the rate stated.

    Raises
    ------
    ExchangeError
        If the times are no time base, or the file has another rate than was stated.
    """
    if plan.time is not None:
        time_s = channels[plan.time.channel].values * plan.time.factor
        found = from_time_stamps(path, plan.time.channel, time_s)
    else:
        samples = len(next(iter(channels.values())).values)
        found = uniform(path, samples, plan.rate_hz or 0.0)
    for name, channel in channels.items():
        own_hz = channel.rate_hz
        if own_hz is not None and abs(own_hz / found.rate_hz - 1) > _RATE_TOLERANCE:
            raise ExchangeError(
                f"{path}: the file says that '{name}' was sampled at {own_hz:.6g} Hz, and "
                f"{found.rate_hz:.6g} Hz was stated; state the true rate with --rate-hz."
            )
    return found
