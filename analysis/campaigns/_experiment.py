"""Experiment of a campaign: what its sessions have in common, and errors of a campaign."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rigd.session.user_metadata import added_metadata
from rigd.units import unit_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from analysis.campaigns._session import SessionFailure
    from analysis.record import Record


class CampaignError(ValueError):
    """A campaign that cannot be analysed; the message says why and what to do."""


class SingleSessionError(CampaignError):
    """Only one file of a campaign can be used.

    Parameters
    ----------
    path : Path
        Session that can be used.
    failures : tuple of SessionFailure
        The others, and why.

    Attributes
    ----------
    path : Path
        That one.
    failures : tuple of SessionFailure
        The others, and why.
    """

    def __init__(self, path: Path, failures: tuple[SessionFailure, ...]) -> None:
        super().__init__(f"Of {len(failures) + 1} files only {path} can be used.")
        self.path = path
        self.failures = failures


def task_errors() -> tuple[type[Exception], ...]:
    """Errors that concern one session and leave the others as they are."""
    from analysis.identify import MeasurementError
    from analysis.paper import FrequencyResponseError
    from analysis.record import RecordError
    from rigd.session import SessionError

    return SessionError, RecordError, FrequencyResponseError, MeasurementError


_STATED: Final = ("excitation", "amplitude_rad", "start_hz", "stop_hz", "duration_s", "taper_s",
                  "there_and_back")  # fmt: skip
LABEL: Final = "specimen"
"""Key of what the operator calls the specimen."""

_OF_SPECIMEN: Final = (LABEL, "beam_length_m", "beam_density_kg_per_m",
                       "beam_bending_stiffness_n_m2", "tool_inertia_kg_m2")  # fmt: skip
_ENDS: Final = ("start_hz", "stop_hz")
"""Keys of the ends of a sweep. The same band in the other direction is the same experiment."""

_SWEEP: Final = "chirp"
_SEARCH: Final = "until"
"""Excitation that was planned while it ran: each is another one."""

_WHOLE: Final = 0.99
"""Fraction of the planned sweep from which it counts as complete: ticks may be missing at its
end."""


@dataclass(frozen=True, slots=True)
class Experiment:
    """Specimen and excitation of one session, as its file states them.

    Attributes
    ----------
    facts : mapping of str to (str or float)
        By the key of the session file; of what is optional there, what is stated.
    sweep_s : float
        How long the sweep in the file is.
    identity : tuple of str
        By which a copy of the file is recognised: the session's, or without one the file's path.
    start_utc : str
        When it was recorded, to the second; empty if the file does not say.
    operator, note : str
        What the file says of either, or nothing.
    added : mapping of str to (float or str)
        Metadata that the user added, by its names, such as ``temperature_c``.
    """

    facts: Mapping[str, str | float]
    sweep_s: float
    identity: tuple[str, ...]
    start_utc: str = ""
    operator: str = ""
    note: str = ""
    added: Mapping[str, float | str] = field(default_factory=dict)

    @classmethod
    def of(cls, record: Record) -> Experiment:
        """Collect what a record states."""
        beam, metadata = record.beam, record.metadata
        stated = {key: _number(metadata[key]) for key in _STATED if key in metadata}
        label = metadata.get(LABEL, "").strip()
        return cls(
            facts={
                **({LABEL: label} if label else {}),
                "beam_length_m": beam.length_m,
                "beam_density_kg_per_m": beam.density_kg_per_m,
                "beam_bending_stiffness_n_m2": beam.bending_stiffness_n_m2,
                "tool_inertia_kg_m2": record.tool_inertia_kg_m2,
                **stated,
            },
            sweep_s=record.sweep_samples / record.rate_hz,
            identity=(
                (metadata["id"], metadata["start_utc_ns"])
                if {"id", "start_utc_ns"} <= metadata.keys()
                else (str(record.path.resolve()),)
            ),
            start_utc=_time(metadata.get("start_utc_ns", "")),
            operator=metadata.get("operator", "").strip(),
            note=metadata.get("note", "").strip(),
            added=added_metadata(metadata),
        )

    @property
    def label(self) -> str:
        """What the file calls the specimen; empty if nothing."""
        return str(self.facts.get(LABEL, ""))

    @property
    def searched(self) -> bool:
        """Whether the session planned its own excitation, which agrees with any other."""
        return self.facts.get("excitation") == _SEARCH

    def unfinished(self, outcome: str) -> str:
        """Describe, as the end of a sentence, that the sweep ended early; empty if it did not."""
        planned_s = self.facts.get("duration_s")
        if not isinstance(planned_s, float):
            return ""
        if self.facts.get("there_and_back") == 1.0:
            planned_s *= 2
        if self.sweep_s >= _WHOLE * planned_s:
            return ""
        return (
            f"its sweep ended after {self.sweep_s:.4g} s of {planned_s:g} s (outcome: {outcome}), "
            "and is not averaged with whole ones; analyse it by itself."
        )

    def difference(self, other: Experiment) -> str | None:
        """Describe the first difference from another experiment, None if there is none."""
        planned = self.searched or other.searched
        stated = dict(other.facts)
        if {self.rising, other.rising} == {True, False}:
            first, last = _ENDS
            stated[first], stated[last] = stated[last], stated[first]
        for key, mine in self.facts.items():
            theirs = mine if planned and key in _STATED else stated.get(key, mine)
            if not _same(theirs, mine):
                return f"{key} is {fact_text(key, theirs)}, but {fact_text(key, mine)}"
        return None

    @property
    def rising(self) -> bool | None:
        """Whether the frequency of its sweep rises; None if it is no sweep, or does both."""
        if self.facts.get("excitation") != _SWEEP or "there_and_back" in self.facts:
            return None
        first, last = (self.facts.get(key) for key in _ENDS)
        if not isinstance(first, float) or not isinstance(last, float) or first == last:
            return None
        return first < last

    def same_specimen(self, other: Experiment) -> bool:
        """Whether another one states the same beam and the same tool inertia."""
        return not any(
            key in self.facts and not _same(other.facts.get(key, self.facts[key]), self.facts[key])
            for key in _OF_SPECIMEN
        )


def distinct_names(paths: Sequence[Path]) -> list[str]:
    """Return the shortest end of each path that no other one has.

    Parameters
    ----------
    paths : sequence of Path
    """
    names = [path.name for path in paths]
    for depth in range(2, max((len(path.parts) for path in paths), default=0) + 1):
        often = Counter(names)
        names = [
            str(Path(*path.parts[-depth:])) if often[name] > 1 else name
            for path, name in zip(paths, names, strict=True)
        ]
    return names


@dataclass(frozen=True, slots=True)
class StatedSpecimen:
    """One specimen, as files state it.

    Attributes
    ----------
    facts : mapping of str to (str or float)
        Beam and tool inertia by the keys of the session files.
    files : tuple of str
        Names of the files that state it, whether they can be used or not.
    """

    facts: Mapping[str, str | float]
    files: tuple[str, ...]


def stated_specimens(
    stated: Iterable[tuple[str, Experiment | None]], of_campaign: Experiment
) -> tuple[StatedSpecimen, ...]:
    """Group files by the specimen that they state; first that of the campaign, then as they come.

    Parameters
    ----------
    stated : iterable of (str, Experiment or None)
        Name of each file, with None of one that could not be read.
    of_campaign : Experiment
        Experiment of the sessions that are pooled.
    """
    found: list[tuple[Experiment, list[str]]] = [(of_campaign, [])]
    for file, experiment in stated:
        if experiment is None:
            continue
        for specimen, files in found:
            if specimen.same_specimen(experiment):
                files.append(file)
                break
        else:
            found.append((experiment, [file]))
    return tuple(
        StatedSpecimen(
            {key: specimen.facts[key] for key in _OF_SPECIMEN if key in specimen.facts},
            tuple(files),
        )
        for specimen, files in found
    )


def labelled(experiments: Sequence[Experiment]) -> list[Experiment]:
    """Distinguish unlabelled from labelled sessions if there are several labels.

    With one label alone, a session without it is taken for the same specimen. With several labels
    its specimen is unknown.
    """
    if len({each.label for each in experiments if each.label}) < 2:
        return list(experiments)
    return [replace(each, facts={LABEL: each.label, **each.facts}) for each in experiments]


def in_dispute(specimens: Sequence[StatedSpecimen]) -> tuple[str, ...]:
    """Return the keys in which specimens differ."""
    first = specimens[0].facts
    return tuple(
        key
        for key, value in first.items()
        if not all(_same(each.facts.get(key, value), value) for each in specimens)
    )


def most_common(experiments: Sequence[Experiment]) -> int:
    """Return the index of the experiment with which most others agree, the first of several.

    A search agrees with any excitation, so it does not count as a candidate.
    """
    indices = [i for i, each in enumerate(experiments) if not each.searched]
    return max(
        indices or range(len(experiments)),
        key=lambda i: sum(experiments[i].difference(two) is None for two in experiments),
    )


def _same(one: str | float, two: str | float) -> bool:
    if isinstance(one, str) or isinstance(two, str):
        return one == two
    return math.isclose(one, two, rel_tol=1e-9)


def fact_text(key: str, value: str | float) -> str:
    """Write a fact with its unit.

    Parameters
    ----------
    key : str
        Name of the fact, with its unit as a suffix.
    value : str or float
        The fact.
    """
    if isinstance(value, str):
        return (f"“{value}”" if value else "not stated") if key == LABEL else value
    return f"{value:g} {unit_of(key)}".rstrip()


def _time(utc_ns: str) -> str:
    """Write the wall clock's time as in ISO 8601, to the second; nothing where there is none."""
    try:
        return f"{datetime.fromtimestamp(int(utc_ns) // 10**9, UTC):%Y-%m-%dT%H:%M:%SZ}"
    except (ValueError, OverflowError, OSError):
        return ""


def _number(text: str) -> str | float:
    try:
        return float(text)
    except ValueError:
        return text
