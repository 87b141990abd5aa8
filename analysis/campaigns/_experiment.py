"""Comparison of the sessions of a campaign by specimen and excitation; errors of a campaign."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Final

from analysis.applicability import COMPLETE_SWEEP_FRACTION
from rigd.session.user_metadata import added_metadata
from rigd.units import unit_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from analysis.record import Record
    from analysis.record_part import RecordSource


class CampaignError(ValueError):
    """Error that prevents the analysis of a campaign, with a message that names the remedy."""


class SingleSessionError(CampaignError):
    """Error if only one file of a campaign can be used.

    Parameters
    ----------
    path : Path
        File of the session that can be used.
    failures : tuple of SessionFailure
        The other sessions, with the reasons why they cannot be used.

    Attributes
    ----------
    path : Path
        File of the session that can be used.
    failures : tuple of SessionFailure
        The other sessions, with the reasons why they cannot be used.
    """

    def __init__(self, path: Path, failures: tuple[SessionFailure, ...]) -> None:
        super().__init__(f"Of {len(failures) + 1} files only {path} can be used.")
        self.path = path
        self.failures = failures


def session_error_types() -> tuple[type[Exception], ...]:
    """Return the exceptions that make one session unusable and do not affect the others."""
    from analysis.identify import MeasurementError
    from analysis.paper import FrequencyResponseError
    from analysis.record import RecordError
    from rigd.session import SessionError

    return SessionError, RecordError, FrequencyResponseError, MeasurementError


_EXCITATION_KEYS: Final = ("excitation", "amplitude_rad", "start_hz", "stop_hz", "duration_s",
                           "taper_s", "there_and_back")  # fmt: skip
"""Keys of the excitation in a session file that must agree over a campaign."""
_SPECIMEN_LABEL_KEY: Final = "specimen"
"""Key of the operator's label of the specimen in a session file."""

_SPECIMEN_KEYS: Final = (_SPECIMEN_LABEL_KEY, "beam_length_m", "beam_density_kg_per_m",
                         "beam_bending_stiffness_n_m2", "tool_inertia_kg_m2")  # fmt: skip
"""Keys of the specimen in a session file that must agree over a campaign."""
_TILT_KEY: Final = "axis_tilt_deg"
"""Key of the tilt of the axis in a session file. Where it is stated it must agree over a campaign,
because it changes the modes."""
_SWEEP_FREQUENCY_KEYS: Final = ("start_hz", "stop_hz")
"""Keys of a sweep's start and stop frequency; sweeps that differ in their order count as equal."""

_SWEEP_EXCITATION: Final = "chirp"
"""Name of the excitation by a sweep."""
_SEARCH_EXCITATION: Final = "until"
"""Name of the excitation that is planned while it runs, and so differs in each session."""


@dataclass(frozen=True, slots=True)
class Experiment:
    """Specimen and excitation of one session, as its file states them.

    Attributes
    ----------
    facts : mapping of str to (str or float)
        Values by their keys in the session file. Optional values that are not stated are absent.
    sweep_s : float
        Duration of the recorded sweep in seconds.
    session_identifiers : tuple of str
        Identifiers of the session, equal in copies of its file; the path of a file without them.
    start_utc : str
        Start of the recording in UTC, to the second; empty if the file does not state it.
    middle_utc_s : float or None
        Middle of the record in seconds since 1970; if the file does not state its start, that of a
        part since the session's start, and None for a whole session.
    operator, note : str
        Operator and note stated in the file; empty if not stated.
    added_metadata : mapping of str to (float or str)
        Metadata that the user added, by its names, such as ``temperature_c``.
    """

    facts: Mapping[str, str | float]
    sweep_s: float
    session_identifiers: tuple[str, ...]
    start_utc: str = ""
    middle_utc_s: float | None = None
    operator: str = ""
    note: str = ""
    added_metadata: Mapping[str, float | str] = field(default_factory=dict)

    @classmethod
    def from_record(cls, record: Record) -> Experiment:
        """Return the specimen and the excitation that a record states."""
        beam, metadata = record.beam, record.metadata
        excitation_facts = {
            key: _parse_number(metadata[key]) for key in _EXCITATION_KEYS if key in metadata
        }
        specimen_label = metadata.get(_SPECIMEN_LABEL_KEY, "").strip()
        return cls(
            facts={
                **({_SPECIMEN_LABEL_KEY: specimen_label} if specimen_label else {}),
                "beam_length_m": beam.length_m,
                "beam_density_kg_per_m": beam.density_kg_per_m,
                "beam_bending_stiffness_n_m2": beam.bending_stiffness_n_m2,
                "tool_inertia_kg_m2": record.tool_inertia_kg_m2,
                **({} if record.axis_tilt_deg is None else {_TILT_KEY: record.axis_tilt_deg}),
                **excitation_facts,
            },
            sweep_s=record.sweep_samples / record.rate_hz,
            session_identifiers=(
                *(
                    (metadata["id"], metadata["start_utc_ns"])
                    if {"id", "start_utc_ns"} <= metadata.keys()
                    else (str(record.path.resolve()),)
                ),
                *(() if record.part_text is None else (record.part_text,)),
            ),
            start_utc=_utc_text(metadata.get("start_utc_ns", ""), record.part_s),
            middle_utc_s=_middle_utc_s(record),
            operator=metadata.get("operator", "").strip(),
            note=metadata.get("note", "").strip(),
            added_metadata=added_metadata(metadata),
        )

    @property
    def specimen_label(self) -> str:
        """Label of the specimen stated in the file; empty if the file states none."""
        return str(self.facts.get(_SPECIMEN_LABEL_KEY, ""))

    @property
    def axis_tilt_deg(self) -> float | None:
        """Tilt of the axis in degrees stated in the file; None if the file states none."""
        tilt_deg = self.facts.get(_TILT_KEY)
        return tilt_deg if isinstance(tilt_deg, float) else None

    @property
    def is_planned_during_session(self) -> bool:
        """Whether the excitation was planned during the session.

        In comparisons of experiments, such an excitation counts as equal to any other.
        """
        return self.facts.get("excitation") == _SEARCH_EXCITATION

    def unfinished_sweep_reason(self, session_outcome: str) -> str:
        """Return why a sweep that ended early is not used; an empty text if it was complete."""
        planned_duration_s = self.facts.get("duration_s")
        if not isinstance(planned_duration_s, float):
            return ""
        if self.facts.get("there_and_back") == 1.0:
            planned_duration_s *= 2
        if self.sweep_s >= COMPLETE_SWEEP_FRACTION * planned_duration_s:
            return ""
        return (
            f"its sweep ended after {self.sweep_s:.4g} s of {planned_duration_s:g} s (outcome: "
            f"{session_outcome}), "
            "and is not averaged with whole ones; analyse it by itself."
        )

    def difference(self, other_experiment: Experiment) -> str | None:
        """Describe the first difference from another experiment; None if there is no difference."""
        ignores_excitation = (
            self.is_planned_during_session or other_experiment.is_planned_during_session
        )
        other_facts = dict(other_experiment.facts)
        if {self.is_rising, other_experiment.is_rising} == {True, False}:
            start_key, stop_key = _SWEEP_FREQUENCY_KEYS
            other_facts[start_key], other_facts[stop_key] = (
                other_facts[stop_key],
                other_facts[start_key],
            )
        for key, own_value in self.facts.items():
            other_value = (
                own_value
                if ignores_excitation and key in _EXCITATION_KEYS
                else other_facts.get(key, own_value)
            )
            if not _are_values_equal(other_value, own_value):
                return f"{key} is {fact_text(key, other_value)}, but {fact_text(key, own_value)}"
        return None

    @property
    def is_rising(self) -> bool | None:
        """Whether the frequency of the sweep rises; None if it also falls, or without a sweep."""
        if self.facts.get("excitation") != _SWEEP_EXCITATION or "there_and_back" in self.facts:
            return None
        start_hz, stop_hz = (self.facts.get(key) for key in _SWEEP_FREQUENCY_KEYS)
        if not isinstance(start_hz, float) or not isinstance(stop_hz, float) or start_hz == stop_hz:
            return None
        return start_hz < stop_hz

    def has_same_specimen(self, other_experiment: Experiment) -> bool:
        """Return whether another experiment states the same beam and the same tool inertia."""
        return not any(
            key in self.facts
            and not _are_values_equal(
                other_experiment.facts.get(key, self.facts[key]), self.facts[key]
            )
            for key in _SPECIMEN_KEYS
        )


@dataclass(frozen=True, slots=True)
class SessionFailure:
    """A session that a campaign does not use, and the reason."""

    source: RecordSource
    """Session file, and the part of it that is not used."""
    message: str
    """Sentence that states for the operator why the session is not used."""
    experiment: Experiment | None = None
    """Specimen and excitation stated in the file; None if the file could not be read."""
    name: str = ""
    """Name in tables (see `distinct_names`); the name of the file by default."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", self.name or self.source.name)

    @classmethod
    def from_error(
        cls, source: RecordSource, error: Exception, experiment: Experiment | None
    ) -> SessionFailure:
        """Return the failure of a session or a part of it by an error, which names the file.

        Parameters
        ----------
        source : RecordSource
            Session file, or a part of it.
        error : Exception
            Error of its analysis.
        experiment : Experiment or None
            Specimen and excitation stated in the file.
        """
        part_text = f"{source.part_name}: " if source.part_s else ""
        return cls(source, f"{part_text}{error}", experiment)

    @property
    def path(self) -> Path:
        """Path of the session file."""
        return self.source.path


def distinct_names(sources: Sequence[RecordSource]) -> list[str]:
    """Return the part of each source, or the shortest end of its path that no other one has."""
    if any(source.part_s for source in sources):
        return [source.part_name for source in sources]
    paths = [source.path for source in sources]
    short_names = [path.name for path in paths]
    for part_count in range(2, max((len(path.parts) for path in paths), default=0) + 1):
        name_counts = Counter(short_names)
        short_names = [
            str(Path(*path.parts[-part_count:])) if name_counts[short_name] > 1 else short_name
            for path, short_name in zip(paths, short_names, strict=True)
        ]
    return short_names


@dataclass(frozen=True, slots=True)
class StatedSpecimen:
    """One specimen as stated in session files.

    Attributes
    ----------
    facts : mapping of str to (str or float)
        Properties of beam and tool by their keys in the session files.
    file_names : tuple of str
        Names of the files that state this specimen, whether they can be used or not.
    """

    facts: Mapping[str, str | float]
    file_names: tuple[str, ...]


def stated_specimens(
    stated_experiments: Iterable[tuple[str, Experiment | None]], campaign_experiment: Experiment
) -> tuple[StatedSpecimen, ...]:
    """Group files by the specimen named in them; the specimen of the campaign comes first.

    Each file has a name and an experiment, None for a file that could not be read.
    `campaign_experiment` is that of the sessions that are pooled.
    """
    files_by_specimen: list[tuple[Experiment, list[str]]] = [(campaign_experiment, [])]
    for file_name, experiment in stated_experiments:
        if experiment is None:
            continue
        for specimen, file_names in files_by_specimen:
            if specimen.has_same_specimen(experiment):
                file_names.append(file_name)
                break
        else:
            files_by_specimen.append((experiment, [file_name]))
    return tuple(
        StatedSpecimen(
            {key: specimen.facts[key] for key in _SPECIMEN_KEYS if key in specimen.facts},
            tuple(file_names),
        )
        for specimen, file_names in files_by_specimen
    )


def add_missing_facts(experiments: Sequence[Experiment]) -> list[Experiment]:
    """Return the experiments; if their labels or tilts differ, add an empty one to those without.

    The specimen of an experiment without a label is then unknown, and the empty label differs from
    every other. If all stated labels are equal, it is taken to be the same specimen. The same holds
    of the tilt of the axis.
    """
    missing_fact_keys = [
        key
        for key in (_SPECIMEN_LABEL_KEY, _TILT_KEY)
        if len({experiment.facts[key] for experiment in experiments if key in experiment.facts}) > 1
    ]
    if not missing_fact_keys:
        return list(experiments)
    return [
        replace(experiment, facts={**dict.fromkeys(missing_fact_keys, ""), **experiment.facts})
        for experiment in experiments
    ]


def differing_fact_keys(specimens: Sequence[StatedSpecimen]) -> tuple[str, ...]:
    """Return the keys of the stated properties, such as the length, in which specimens differ."""
    first_specimen_facts = specimens[0].facts
    return tuple(
        key
        for key, fact_value in first_specimen_facts.items()
        if not all(
            _are_values_equal(specimen.facts.get(key, fact_value), fact_value)
            for specimen in specimens
        )
    )


def most_common_index(experiments: Sequence[Experiment]) -> int:
    """Return the index of the experiment that agrees with most others; the first of several.

    An experiment planned during its session agrees with any other, so it is no candidate.
    """
    candidate_indices = [
        i for i, experiment in enumerate(experiments) if not experiment.is_planned_during_session
    ]
    return max(
        candidate_indices or range(len(experiments)),
        key=lambda i: sum(
            experiments[i].difference(other_experiment) is None for other_experiment in experiments
        ),
    )


def _are_values_equal(first_value: str | float, second_value: str | float) -> bool:
    """Return whether two stated values are equal, numbers up to rounding."""
    if isinstance(first_value, str) or isinstance(second_value, str):
        return first_value == second_value
    return math.isclose(first_value, second_value, rel_tol=1e-9)


def fact_text(fact_key: str, fact_value: str | float) -> str:
    """Format a value of a session file with its unit.

    Parameters
    ----------
    fact_key : str
        Key of the value, with the unit as a suffix.
    fact_value : str or float
        The value.
    """
    if isinstance(fact_value, str):
        if not fact_value:
            return "not stated"
        return f"“{fact_value}”" if fact_key == _SPECIMEN_LABEL_KEY else fact_value
    return f"{fact_value:g} {unit_of(fact_key)}".rstrip()


def _utc_text(utc_ns: str, part_s: tuple[float, float] | None) -> str:
    """Format the start of a session or a part in UTC as ISO 8601, to the second.

    The text is empty if the start of the session (nanoseconds since 1970) is not a number.
    """
    try:
        start_s = int(utc_ns) // 10**9 + int(part_s[0] if part_s else 0)
        return f"{datetime.fromtimestamp(start_s, UTC):%Y-%m-%dT%H:%M:%SZ}"
    except (ValueError, OverflowError, OSError):
        return ""


def _middle_utc_s(record: Record) -> float | None:
    """Return the middle of a record in seconds since 1970, or of a part since the start.

    None if the start of a whole session is not stated.
    """
    middle_s = float(record.time_s[0] + record.time_s[-1]) / 2
    start_utc_ns = record.metadata.get("start_utc_ns", "")
    if start_utc_ns.isascii() and start_utc_ns.isdigit() and len(start_utc_ns) < 20:
        return int(start_utc_ns) / 1e9 + middle_s
    return None if record.part_s is None else middle_s


def _parse_number(number_text: str) -> str | float:
    """Return a text as a number, or unchanged if it is not one."""
    try:
        return float(number_text)
    except ValueError:
        return number_text
