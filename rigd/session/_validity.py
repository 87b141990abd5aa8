"""Validity of the numbers that are estimated from a record.

States the error of the linear model, and whether a uniform beam predicts the modes.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from rigd.units import finite_number

_LEAST_P: Final = 1e-300
_NOT_TESTED: Final = "not tested"
_SHORT: Final = {"passed": "yes", "refused": "no", _NOT_TESTED: _NOT_TESTED}
"""Whether the beam is uniform, by status."""

_LEAST_ERROR: Final = 1e-3
"""Errors of the linear model below this are stated as an upper bound."""


@dataclass(frozen=True, slots=True)
class BeamUniformity:
    """Whether a uniform beam predicts the modes that a record shows.

    Attributes
    ----------
    status
        "passed", "refused" or "not tested".
    p_value
        Probability of such a difference by chance; None: not tested.

    Examples
    --------
    >>> from rigd.session import BeamUniformity
    >>> print(BeamUniformity("passed", 0.44).sentence)
    A uniform beam predicts the modes (p = 0.44).
    >>> print(BeamUniformity("refused", 0.0).short)
    no (p < 1e-300)
    """

    status: str
    p_value: float | None = None

    @classmethod
    def of_document(cls, document: object) -> "BeamUniformity | None":
        """Return the result in a document; None without a usable one.

        Parameters
        ----------
        document
            Value of ``uniform_beam`` in any document.
        """
        if not isinstance(document, Mapping) or document.get("status") not in _SHORT:
            return None
        status, p_value = str(document["status"]), finite_number(document.get("p_value"))
        if status == _NOT_TESTED:
            return cls(status)
        return None if p_value is None or not 0.0 <= p_value <= 1.0 else cls(status, p_value)

    @property
    def sentence(self) -> str:
        """The result as a sentence."""
        if self.status == "passed":
            return f"A uniform beam predicts the modes ({self.chance})."
        if self.status == "refused":
            return (
                f"A uniform beam does not predict the modes ({self.chance}): orders that assume "
                "one are not properties of the material."
            )
        return "Whether a uniform beam predicts the modes was not tested: too few modes show."

    @property
    def short(self) -> str:
        """The result for a cell of a table."""
        word = _SHORT[self.status]
        return word if self.p_value is None else f"{word} ({self.chance})"

    @property
    def chance(self) -> str:
        """The p-value as text."""
        p_value = self.p_value or 0.0
        return f"p = {p_value:.2g}" if p_value >= _LEAST_P else f"p < {_LEAST_P:g}"

    def as_json(self) -> dict[str, Any]:
        """Return the result as in documents, with the sentence."""
        return {"status": self.status, "p_value": self.p_value, "sentence": self.sentence}


@dataclass(frozen=True, slots=True)
class Validity:
    """Validity of the linear model for a record, and of a uniform beam.

    Attributes
    ----------
    predicted_peak_tip_slope_rad
        Largest slope of the antenna's tip against its root, by the linear model; None: unknown.
    linear_model_error
        Bound of that model's relative error at such slopes; None: unknown.
    uniform_beam
        Whether a uniform beam predicts the modes; None: unknown.

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
    uniform_beam: BeamUniformity | None = None

    @classmethod
    def of_document(cls, document: object) -> "Validity":
        """Return the validity in a document; unknown without one.

        Parameters
        ----------
        document
            Value of ``validity`` in any document.
        """
        if not isinstance(document, Mapping):
            return cls()
        uniform_beam = BeamUniformity.of_document(document.get("uniform_beam"))
        slope_rad = finite_number(document.get("predicted_peak_tip_slope_rad"))
        error = finite_number(document.get("linear_model_error"))
        if slope_rad is None or error is None or slope_rad < 0.0 or error < 0.0:
            slope_rad = error = None
        return cls(slope_rad, error, uniform_beam)

    @property
    def sentence(self) -> str:
        """Slope and error as a sentence."""
        if self.predicted_peak_tip_slope_rad is None or self.linear_model_error is None:
            return "The slope of the tip, and with it the error of the linear model, is unknown."
        slope = f"Tip slopes up to {self.predicted_peak_tip_slope_rad:.2g} rad"
        if self.linear_model_error >= 1.0:
            return f"{slope}: the linear model does not hold there (error above 100 %)."
        return f"{slope}; error of the linear model {self._at_most('at most ', 'below ')}."

    @property
    def short(self) -> str:
        """Slope and error for a cell of a table."""
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
        """Return the validity as in documents, with the sentences."""
        uniform_beam = self.uniform_beam
        return {
            "predicted_peak_tip_slope_rad": self.predicted_peak_tip_slope_rad,
            "linear_model_error": self.linear_model_error,
            "sentence": self.sentence,
            "uniform_beam": None if uniform_beam is None else uniform_beam.as_json(),
        }
