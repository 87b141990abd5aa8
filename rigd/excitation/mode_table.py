"""The modes that an analysis found, from its JSON document."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Annotated, Any, Final

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from rigd.excitation.files import open_plain_file
from rigd.excitation.options import ExcitationError

MOST_BYTES: Final = 64_000_000
SAME_MODE: Final = 1.1
"""Fits of one record differ by less than this factor in a mode's frequency; the frequencies of a
slender beam differ by more."""

_Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
_NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]


class _Entry(BaseModel):
    """A mode as one fit found it; null where the fit has none, 0 Hz where it does not oscillate."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    frequency_hz: _NotNegative | None
    damping_ratio: _Positive | None
    frequency_std_hz: _NotNegative | None = None
    estimator: str | None = None

    @property
    def oscillates(self) -> bool:
        return bool(self.frequency_hz) and self.damping_ratio is not None


class _Document(BaseModel):
    """What is needed of the analyser's document."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    modes: list[_Entry]


@dataclass(frozen=True, slots=True)
class FoundMode:
    """A mode, from one fit or from several."""

    frequency_hz: float
    damping_ratio: float
    uncertainty_hz: float
    """Of the frequency: two standard deviations, as stated or as the fits differ."""


def read_modes(path: str | Path) -> tuple[FoundMode, ...]:
    """Read the modes, lowest frequency first.

    Parameters
    ----------
    path
        JSON with the key ``modes``: a list of objects with ``frequency_hz`` (Hz, of the free decay)
        and ``damping_ratio``, and perhaps ``frequency_std_hz``. More keys are ignored. Where
        several fits found a mode, their medians are taken; where some of them are of the
        estimator ``record``, only these.

    Raises
    ------
    ExcitationError
        If the file cannot be read, or is not what it should be.
    """
    path = Path(path)
    try:
        document = _Document.model_validate(_read_json(path))
    except ValidationError as error:
        complaint = _complaint(error.errors(include_url=False, include_context=False)[0])
        raise ExcitationError(f"{path}: {complaint}") from None
    entries = [entry for entry in document.modes if entry.oscillates]
    of_records = [entry for entry in entries if entry.estimator == "record"]
    modes = tuple(_merged(group) for group in _groups(of_records or entries))
    if not modes:
        raise ExcitationError(
            f"{path}: modes has no mode that oscillates; take the document of an analysis that "
            "found one (analyze session.mcap --json fits.json)."
        )
    return modes


def _read_json(path: Path) -> Any:  # noqa: ANN401 - any JSON value
    try:
        with open_plain_file(path, MOST_BYTES) as file:
            return json.load(file)
    except OSError as error:
        raise ExcitationError(f"{path}: cannot be read ({error.strerror}).") from error
    except RecursionError:
        raise ExcitationError(f"{path}: is nested too deeply.") from None
    except ValueError as error:
        raise ExcitationError(
            f"{path}: is not a JSON document ({error}); write one with analyze session.mcap "
            "--json fits.json."
        ) from error


def _complaint(detail: ErrorDetails) -> str:
    """Say what is wrong with one value, in one sentence with a remedy."""
    where = ""
    for part in detail["loc"]:
        where += f"[{part}]" if isinstance(part, int) else f".{part}" if where else part
    if not where:
        return 'is no JSON object; it must have the key "modes".'
    if detail["type"] == "missing":
        return f"{where} is missing; give it as analyze --json writes it."
    unit = " Hz" if where.endswith("_hz") else ""
    given = json.dumps(detail["input"], default=str)
    given = given if len(given) <= 60 else f"{given[:60]}..."
    remedy = {
        "greater_than": f"must be more than 0{unit}",
        "greater_than_equal": f"must not be negative: give it in{unit}",
        "finite_number": "is not a finite number",
        "list_type": "must be a list of modes",
        "model_type": "must be an object with frequency_hz and damping_ratio",
        "string_type": "must be a text",
    }.get(detail["type"], f"must be a number{' in Hz' if unit else ''}")
    return f"{where} = {given}{unit} {remedy}."


def _groups(entries: Sequence[_Entry]) -> Iterator[list[_Entry]]:
    """Put together what is one mode, seen by several fits."""
    group: list[_Entry] = []
    for entry in sorted(entries, key=_frequency_hz):
        if group and _frequency_hz(entry) > SAME_MODE * _frequency_hz(group[0]):
            yield group
            group = []
        group.append(entry)
    if group:
        yield group


def _merged(group: Sequence[_Entry]) -> FoundMode:
    middle_hz = median(_frequency_hz(entry) for entry in group)
    stated_hz = median(entry.frequency_std_hz or 0.0 for entry in group)
    # Fits of structures that do not suit lie far off: the median of the distances bears them.
    between_hz = 1.4826 * median(abs(_frequency_hz(entry) - middle_hz) for entry in group)
    return FoundMode(
        frequency_hz=middle_hz,
        damping_ratio=median(entry.damping_ratio or 0.0 for entry in group),
        uncertainty_hz=2.0 * max(stated_hz, between_hz),
    )


def _frequency_hz(entry: _Entry) -> float:
    return entry.frequency_hz or 0.0
