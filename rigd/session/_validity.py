"""Validity of the numbers that are estimated from a record: how exact the linear model is there."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final

from rigd.units import finite_number

_LEAST_ERROR: Final = 1e-3
"""Errors of the linear model below this are stated as being below it."""


@dataclass(frozen=True, slots=True)
class Validity:
    """Validity of the linear model for a record.

    Attributes
    ----------
    predicted_peak_tip_slope_rad
        Largest slope of the antenna's tip against its root, by the linear model; None: unknown.
    linear_model_error
        Bound of that model's relative error at such slopes; None: unknown.

    Examples
    --------
    >>> from rigd.session import Validity
    >>> print(Validity(0.6, 0.12).sentence)
    Tip slopes up to 0.6 rad; error of the linear model at most 12 %.
    >>> print(Validity().short)
    unknown
    """

    predicted_peak_tip_slope_rad: float | None = None
    linear_model_error: float | None = None

    @classmethod
    def of_document(cls, document: object) -> "Validity":
        """Return the validity that a document states; unknown if it states none.

        Parameters
        ----------
        document
            What stands there as ``validity``, as anybody may have written it.
        """
        if not isinstance(document, Mapping):
            return cls()
        slope_rad = finite_number(document.get("predicted_peak_tip_slope_rad"))
        error = finite_number(document.get("linear_model_error"))
        if slope_rad is None or error is None or slope_rad < 0.0 or error < 0.0:
            return cls()
        return cls(slope_rad, error)

    @property
    def sentence(self) -> str:
        """The same as a sentence."""
        if self.predicted_peak_tip_slope_rad is None or self.linear_model_error is None:
            return "The slope of the tip, and with it the error of the linear model, is unknown."
        slope = f"Tip slopes up to {self.predicted_peak_tip_slope_rad:.2g} rad"
        if self.linear_model_error >= 1.0:
            return f"{slope}: the linear model does not hold there (error above 100 %)."
        return f"{slope}; error of the linear model {self._at_most('at most ', 'below ')}."

    @property
    def short(self) -> str:
        """The same for a cell of a table: slope and error."""
        if self.predicted_peak_tip_slope_rad is None or self.linear_model_error is None:
            return "unknown"
        slope = f"{self.predicted_peak_tip_slope_rad:.2g} rad"
        if self.linear_model_error >= 1.0:
            return f"{slope}, error > 100 %"
        return f"{slope}, error {self._at_most('≤ ', '< ')}"

    def _at_most(self, at_most: str, below: str) -> str:
        error = self.linear_model_error or 0.0
        if error < _LEAST_ERROR:
            return f"{below}{100.0 * _LEAST_ERROR:g} %"
        return f"{at_most}{100.0 * error:.2g} %"

    def as_json(self) -> dict[str, Any]:
        """Return it as documents have it, with the sentence."""
        return {**asdict(self), "sentence": self.sentence}
