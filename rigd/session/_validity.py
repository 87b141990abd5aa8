"""Validity of numbers that are estimated from a record.

The validity consists of the error of the linear beam model at the record's tip slopes, and the
result of a test whether the model of a uniform beam predicts the modes.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from rigd.units import finite_number

_MIN_SHOWN_P_VALUE: Final = 1e-300
"""Smallest p-value that is shown; a smaller one is shown as "p < 1e-300"."""
_NOT_TESTED: Final = "not tested"
_UNIFORM_BY_STATUS: Final = {"passed": "yes", "refused": "no", _NOT_TESTED: _NOT_TESTED}
"""Status of the test of a uniform beam → text for a table: whether the beam is uniform."""

_MIN_SHOWN_ERROR: Final = 1e-3
"""Smallest relative error of the linear model that is shown; smaller ones are shown as "below"."""


@dataclass(frozen=True, slots=True)
class BeamUniformity:
    """Result of a test whether the model of a uniform beam predicts the modes in a record.

    Attributes
    ----------
    status
        "passed", "refused" or "not tested".
    p_value
        Probability that chance alone causes a difference between predicted and estimated modes as
        large as observed, or None if not tested.

    Examples
    --------
    >>> from rigd.session import BeamUniformity
    >>> print(BeamUniformity("passed", 0.44).sentence)
    A uniform beam predicts the modes (p = 0.44).
    >>> print(BeamUniformity("refused", 0.0).short_text)
    no (p < 1e-300)
    """

    status: str
    p_value: float | None = None

    @classmethod
    def from_document(cls, document: object) -> "BeamUniformity | None":
        """Return the test result in a document, or None if the document contains no valid one.

        Parameters
        ----------
        document
            Value of the key ``uniform_beam`` of a document from any source.
        """
        if not isinstance(document, Mapping):
            return None
        test_status, p_value = str(document.get("status")), finite_number(document.get("p_value"))
        if test_status not in _UNIFORM_BY_STATUS:
            return None
        if test_status == _NOT_TESTED:
            return cls(test_status)
        return None if p_value is None or not 0.0 <= p_value <= 1.0 else cls(test_status, p_value)

    @property
    def sentence(self) -> str:
        """Sentence that states whether a uniform beam predicts the modes."""
        if self.status == "passed":
            return f"A uniform beam predicts the modes ({self.chance})."
        if self.status == "refused":
            return (
                f"A uniform beam does not predict the modes ({self.chance}): orders that assume "
                "one are not properties of the material."
            )
        return (
            "Whether a uniform beam predicts the modes was not tested: too few modes are "
            "determined."
        )

    @property
    def short_text(self) -> str:
        """Test result for a cell of a table: "yes", "no" or "not tested", with the p-value."""
        is_uniform = _UNIFORM_BY_STATUS[self.status]
        return is_uniform if self.p_value is None else f"{is_uniform} ({self.chance})"

    @property
    def chance(self) -> str:
        """Text with the p-value, such as "p = 0.44"."""
        p_value = self.p_value or 0.0
        return (
            f"p = {p_value:.2g}" if p_value >= _MIN_SHOWN_P_VALUE else f"p < {_MIN_SHOWN_P_VALUE:g}"
        )

    def as_json(self) -> dict[str, Any]:
        """Return the test result as a dictionary for JSON: status, p-value and sentence."""
        return {"status": self.status, "p_value": self.p_value, "sentence": self.sentence}


@dataclass(frozen=True, slots=True)
class Validity:
    """Validity of the numbers from a record: error of the linear model, test of a uniform beam.

    Attributes
    ----------
    predicted_peak_tip_slope_rad
        Largest slope of the antenna's tip relative to its root that the linear model predicts, or
        None if unknown.
    linear_model_error
        Upper bound of the linear model's relative error at such slopes, or None if unknown.
    uniform_beam
        Result of the test whether a uniform beam predicts the modes, or None if unknown.

    Examples
    --------
    >>> from rigd.session import Validity
    >>> print(Validity(0.6, 0.12).sentence)
    Tip slopes up to 0.6 rad; error of the linear model at most 12 %.
    >>> print(Validity().short_text)
    unknown
    """

    predicted_peak_tip_slope_rad: float | None = None
    linear_model_error: float | None = None
    uniform_beam: BeamUniformity | None = None

    @classmethod
    def from_document(cls, document: object) -> "Validity":
        """Return the validity that a document states; its values are None if not stated.

        Parameters
        ----------
        document
            Value of the key ``validity`` of a document from any source.
        """
        if not isinstance(document, Mapping):
            return cls()
        beam_uniformity = BeamUniformity.from_document(document.get("uniform_beam"))
        tip_slope_rad = finite_number(document.get("predicted_peak_tip_slope_rad"))
        model_error = finite_number(document.get("linear_model_error"))
        if tip_slope_rad is None or model_error is None or tip_slope_rad < 0.0 or model_error < 0.0:
            tip_slope_rad = model_error = None
        return cls(tip_slope_rad, model_error, beam_uniformity)

    @property
    def sentence(self) -> str:
        """Sentence that states the beam's peak tip slope and the error of the linear beam model."""
        if self.predicted_peak_tip_slope_rad is None or self.linear_model_error is None:
            return "The slope of the tip, and with it the error of the linear model, is unknown."
        slope_text = f"Tip slopes up to {self.predicted_peak_tip_slope_rad:.2g} rad"
        if self.linear_model_error >= 1.0:
            return f"{slope_text}: the linear model does not hold there (error above 100 %)."
        return (
            f"{slope_text}; error of the linear model "
            f"{self._error_bound_text('at most ', 'below ')}."
        )

    @property
    def short_text(self) -> str:
        """Peak tip slope and error of the linear model as text for a cell of a table."""
        if self.predicted_peak_tip_slope_rad is None or self.linear_model_error is None:
            return "unknown"
        slope_text = f"{self.predicted_peak_tip_slope_rad:.2g} rad"
        if self.linear_model_error >= 1.0:
            return f"{slope_text}, error > 100 %"
        return f"{slope_text}, error {self._error_bound_text('≤ ', '< ')}"

    def _error_bound_text(self, upper_bound_words: str, below_words: str) -> str:
        """Return text with the upper bound of the linear model's error in percent.

        It begins with `below_words` if the error is below the smallest value that is shown, else
        with `upper_bound_words`.
        """
        model_error = self.linear_model_error or 0.0
        if model_error < _MIN_SHOWN_ERROR:
            return f"{below_words}{100.0 * _MIN_SHOWN_ERROR:g} %"
        return f"{upper_bound_words}{100.0 * model_error:.2g} %"

    def as_json(self) -> dict[str, Any]:
        """Return the validity as a dictionary for JSON, with sentences."""
        uniform_beam = self.uniform_beam
        return {
            "predicted_peak_tip_slope_rad": self.predicted_peak_tip_slope_rad,
            "linear_model_error": self.linear_model_error,
            "sentence": self.sentence,
            "uniform_beam": None if uniform_beam is None else uniform_beam.as_json(),
        }
