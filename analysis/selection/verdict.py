"""The verdict on one record: what was selected, what is known, what is not, and what would tell."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    from analysis.selection.amplitude import DampingAt
    from analysis.selection.finding import Finding
    from analysis.selection.harmonics import Harmonic
    from analysis.selection.orders import OrderVerdict
    from analysis.selection.whiteness import InputRelation, Whiteness


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table of candidates.

    Attributes
    ----------
    structure : str
        "I" to "VII".
    uniform : bool
        Whether the beam was taken to be uniform; else each mode has a stiffness of its own.
    parameters : int
    cost : float
        Sum of squares of the whitened residual.
    delta_bic, delta_aic : float
        Above the lowest of all.
    """

    structure: str
    uniform: bool
    parameters: int
    cost: float
    delta_bic: float
    delta_aic: float


@dataclass(frozen=True, slots=True)
class Verdict:
    """What can be said of one record.

    Attributes
    ----------
    name : str
        The file.
    structure : str
        Of the lowest BIC: "I" to "VII".
    uniform : bool
        Whether its beam is uniform.
    rivals : tuple of str
        Structures that the data cannot tell from it.
    parameters : mapping of str to float
        Of the freest structure on that beam, as `RecordFit` names them; those that carry a flag
        are left out.
    adequate : bool
        Whether what remains of that is noise.
    alpha, lambda_ : OrderVerdict
    visible_modes : tuple of int
        Modes that stand out of the noise.
    findings : tuple of Finding
        What else is in the record.
    table : tuple of Row
        All candidates, the lowest BIC first.
    whiteness : Whiteness
    input_relation : InputRelation
    harmonics : tuple of Harmonic
    sentences : tuple of str
        The verdict in words, the most important first.
    experiments : tuple of str
        What would tell more.
    damping_with_amplitude : tuple of DampingAt
        Of free vibration, where the air brakes the beam; else empty.
    """

    name: str
    structure: str
    uniform: bool
    rivals: tuple[str, ...]
    parameters: Mapping[str, float]
    adequate: bool
    alpha: OrderVerdict
    lambda_: OrderVerdict
    visible_modes: tuple[int, ...]
    findings: tuple[Finding, ...]
    table: tuple[Row, ...]
    whiteness: Whiteness
    input_relation: InputRelation
    harmonics: tuple[Harmonic, ...]
    sentences: tuple[str, ...]
    experiments: tuple[str, ...]
    damping_with_amplitude: tuple[DampingAt, ...] = ()

    def as_json(self) -> dict[str, object]:
        """As `json.dumps` takes it; what is not finite becomes null."""
        plain = _plain(dataclasses.asdict(self))
        assert isinstance(plain, dict)
        return plain


def _plain(value: object) -> object:
    if isinstance(value, dict):
        return {str(key).rstrip("_"): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
