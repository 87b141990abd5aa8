"""Estimates with their uncertainty, and estimated modes of the beam, in Python and in JSON.

The analyzer writes them, and the rig reads them: in quick looks, in the fit of a running session,
in session files and in the library. What is read may come from anywhere, so it is checked.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Final, Literal, get_args

from rigd.printable import listed, printable
from rigd.units import decimals, finite_number, with_half_width

ModeSource = Literal["modal", "beam"]
"""Model that provides the numbers of a mode: the modal model, or the beam."""

_MIN_SIGNIFICANT_HALF_WIDTHS: Final = 3.0 / 1.96
"""Ratio of three standard deviations to the half-width of a 95 % interval."""

_MAX_DOCUMENT_MODES: Final = 20
"""Maximum number of modes that are read from a document."""
_MAX_FLAG_CHARACTERS: Final = 1000
"""Maximum number of characters of a flag that are read from a document."""
_KG_MM2_PER_KG_M2: Final = 1e6
"""Conversion factor from kg m² to kg mm²."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """Estimated number with its uncertainty, and the reason to doubt it if there is one.

    Examples
    --------
    >>> from rigd.estimates import Estimate
    >>> damping_ratio = Estimate(0.00909, 1.2e-4, (0.00885, 0.00933))
    >>> print(damping_ratio.text(100.0), "%")
    0.909 ± 0.024 %
    >>> Estimate.from_json(damping_ratio.as_json()) == damping_ratio
    True
    """

    value: float
    """Estimate, in SI units."""
    std: float | None
    """Standard deviation; None if the data do not determine it."""
    interval_95: tuple[float, float] | None
    """95 % interval; None if the data do not determine it."""
    flag: str | None = None
    """Reason why the value is not a property of the antenna or the rig; None if it is one."""

    def with_flag(self, flag: str | None) -> "Estimate":
        """Return the estimate with a flag, unless it already has one.

        Parameters
        ----------
        flag
            Reason why the value is not valid; None changes nothing.
        """
        return self if flag is None else replace(self, flag=self.flag or flag)

    def percent_above(self, reference_estimate: "Estimate") -> float:
        """Return the value's excess over that of another estimate in percent; NaN if that is 0."""
        return (
            100 * (self.value / reference_estimate.value - 1)
            if reference_estimate.value
            else math.nan
        )

    def text(self, unit_factor: float = 1.0) -> str:
        """Return value and half-width of the 95 % interval as text, without unit.

        Parameters
        ----------
        unit_factor
            Factor to the unit of the text, such as 100 for per cent.
        """
        return with_half_width(self.value, self.interval_95, unit_factor)

    def as_json(self) -> dict[str, Any]:
        """Return the estimate as a JSON object."""
        return {
            "value": self.value,
            "std": self.std,
            "interval_95": None if self.interval_95 is None else list(self.interval_95),
            "flag": self.flag,
        }

    @classmethod
    def from_json(cls, document: object) -> "Estimate | None":
        """Return the estimate that a JSON value describes, or None if it describes none.

        The value must be a finite number. An interval without two finite ends counts as unknown. A
        flag of any type is converted to text.

        Parameters
        ----------
        document
            JSON value from any source.
        """
        if (
            not isinstance(document, dict)
            or (value := finite_number(document.get("value"))) is None
        ):
            return None
        interval_ends, flag = document.get("interval_95"), document.get("flag")
        interval_95 = None
        if isinstance(interval_ends, list) and len(interval_ends) == 2:
            low, high = map(finite_number, interval_ends)
            interval_95 = None if low is None or high is None else (low, high)
        return cls(
            value,
            finite_number(document.get("std")),
            interval_95,
            None if flag is None else printable(str(flag), _MAX_FLAG_CHARACTERS),
        )


@dataclass(frozen=True, slots=True)
class Change:
    """Difference of two estimates of one quantity, and whether it is significant."""

    difference: float
    """Later value minus earlier value, in the unit of the quantity."""
    significant: bool | None
    """Whether the difference exceeds three standard deviations.

    None if this is unknown, because an interval is missing or a value is flagged."""

    def as_json(self) -> dict[str, Any]:
        """Return the change as a JSON object."""
        return {"difference": self.difference, "significant": self.significant}


def change_between(earlier: Estimate, later: Estimate) -> Change:
    """Return the change of a quantity between two sessions.

    Parameters
    ----------
    earlier, later
        Estimates from the earlier and from the later session.

    Notes
    -----
    Both errors are independent. The half-width of the 95 % interval of the difference is the root
    of the sum of the squared half-widths, each on the side of the other value. A change is
    significant beyond three standard deviations, 1.53 times this half-width, because a trend has
    many changes and one in twenty exceeds a 95 % interval by chance.

    Examples
    --------
    >>> from rigd.estimates import Estimate, change_between
    >>> before, after = Estimate(2.60, 0.005, (2.59, 2.61)), Estimate(2.63, 0.005, (2.62, 2.64))
    >>> change_between(before, after).significant
    True
    """
    difference = later.value - earlier.value
    lower, higher = (earlier, later) if difference >= 0 else (later, earlier)
    if lower.interval_95 is None or higher.interval_95 is None or earlier.flag or later.flag:
        return Change(difference, None)
    half_width_95 = math.hypot(
        lower.interval_95[1] - lower.value, higher.value - higher.interval_95[0]
    )
    return Change(difference, abs(difference) > _MIN_SIGNIFICANT_HALF_WIDTHS * half_width_95 > 0.0)


@dataclass(frozen=True, slots=True)
class ReportedMode:
    """Mode of the beam with locked hub, as reported: with intervals and flags."""

    number: int
    """Number of the mode, from 1."""
    frequency_hz: Estimate
    """Frequency of the free decay."""
    damping_ratio: Estimate
    """Fraction of the critical damping."""
    shown: bool = True
    """Whether the record shows the mode; if not, it is computed from the model."""
    source: ModeSource | None = None
    """Model that provides the numbers; None if unknown."""
    participation: Estimate | None = None
    """Effective inertia about the motor's axis in kg m²; None for a mode from the beam."""

    @property
    def flag(self) -> str | None:
        """Reason to doubt damping ratio or frequency; None if there is none."""
        return self.damping_ratio.flag or self.frequency_hz.flag

    def as_json(self) -> dict[str, Any]:
        """Return the mode as a JSON object."""
        return {
            "mode": self.number,
            "frequency_hz": self.frequency_hz.as_json(),
            "damping_ratio": self.damping_ratio.as_json(),
            "participation": None if self.participation is None else self.participation.as_json(),
            "source": self.source,
            "shown": self.shown,
        }

    @classmethod
    def from_json(cls, document: object, number: int) -> "ReportedMode | None":
        """Return the mode that a JSON value describes, or None if it describes no mode.

        A mode has a positive frequency and a damping ratio.

        Parameters
        ----------
        document
            JSON value from any source.
        number
            Number of the mode if the document states none.
        """
        if not isinstance(document, dict) or type(document.get("mode", number)) is not int:
            return None
        frequency_hz, damping_ratio, participation = (
            Estimate.from_json(document.get(key))
            for key in ("frequency_hz", "damping_ratio", "participation")
        )
        if frequency_hz is None or frequency_hz.value <= 0 or damping_ratio is None:
            return None
        source = document.get("source")
        return cls(
            document.get("mode", number),
            frequency_hz,
            damping_ratio,
            shown=document.get("shown") is not False,
            source=source if source in get_args(ModeSource) else None,
            participation=participation,
        )

    def frequency_change_text(self, earlier: "ReportedMode") -> str:
        """Return the change of the frequency since an earlier estimate, in Hz with its sign."""
        change_hz = self.frequency_hz.value - earlier.frequency_hz.value
        decimal_count = decimals(self.frequency_hz.std) if self.frequency_hz.std else 4
        return f"{change_hz:+.{decimal_count}f} Hz"

    def summary_line(self) -> str:
        """Return one line of text with frequency, damping and inertia.

        Examples
        --------
        >>> from rigd.estimates import Estimate, ReportedMode
        >>> frequency_hz = Estimate(2.5699, 6e-4, (2.5687, 2.5711))
        >>> print(ReportedMode(1, frequency_hz, Estimate(0.00909, None, None)).summary_line())
        mode 1: 2.5699 ± 0.0012 Hz, damping 0.909 %
        """
        mode_text = (
            f"mode {self.number}: {self.frequency_hz.text()} Hz, damping "
            f"{self.damping_ratio.text(100.0)} %"
        )
        if self.participation is None:
            return mode_text
        return f"{mode_text}, inertia {self.participation.text(_KG_MM2_PER_KG_M2)} kg·mm²"


def modes_from_json(documents: object) -> list[ReportedMode]:
    """Return the modes that a JSON list describes; entries that are no modes are left out.

    Parameters
    ----------
    documents
        Value of the key ``modes`` of a document from any source.
    """
    return list(_modes_in_documents(documents)) if isinstance(documents, list) else []


def unseen_modes_text(modes: Iterable[ReportedMode]) -> str:
    """Return text that names the modes that are not visible in a record; empty if all are.

    Parameters
    ----------
    modes
        Modes of the record.

    Examples
    --------
    >>> from rigd.estimates import Estimate, ReportedMode, unseen_modes_text
    >>> one = Estimate(1.0, None, None)
    >>> unseen_modes_text(ReportedMode(n, one, one, shown=n == 1) for n in (1, 2, 3))
    'modes 2 and 3'
    """
    unseen_mode_numbers = [str(mode.number) for mode in modes if not mode.shown]
    return (
        f"mode{'s' if len(unseen_mode_numbers) > 1 else ''} {listed(unseen_mode_numbers)}"
        if unseen_mode_numbers
        else ""
    )


def _modes_in_documents(documents: list[object]) -> Iterator[ReportedMode]:
    """Yield the entries of a JSON list that are modes."""
    for number, document in enumerate(documents[:_MAX_DOCUMENT_MODES], start=1):
        if (mode := ReportedMode.from_json(document, number)) is not None:
            yield mode
