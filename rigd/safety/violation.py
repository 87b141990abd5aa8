"""A limit that was left, or whose warning level was, in words."""

from dataclasses import dataclass
from math import isfinite


@dataclass(frozen=True, slots=True)
class Violation:
    """A limit that was left, or is near.

    Attributes
    ----------
    channel, value, limit, unit
        What is wrong by how much.
    remedy
        What the operator can do, a sentence; may be empty.
    key
        Of the profile, where the limit stands; may be empty.
    below
        The value must not fall below the limit, instead of exceeding it.
    warning
        The level that was reached instead, if the limit was not left yet.
    """

    channel: str
    value: float
    limit: float
    unit: str
    remedy: str = ""
    key: str = ""
    below: bool = False
    warning: float | None = None

    def __str__(self) -> str:
        """Return one or two sentences for the operator."""
        if not isfinite(self.value):
            return f"The {self.channel} is not a number: no usable reading came from its device."
        left = "is below its limit of" if self.below else "exceeds its limit of"
        how = left
        if self.warning is not None:
            how = f"is past its warning level of {self.warning:.4g} {self.unit}; its limit is"
        where = f" ({self.key})" if self.key else ""
        remedy = f" {self.remedy}" if self.remedy else ""
        return (
            f"The {self.channel} of {self.value:.4g} {self.unit} {how} "
            f"{self.limit:.4g} {self.unit}{where}.{remedy}"
        )
