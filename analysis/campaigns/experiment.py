"""What the sessions of one campaign have in common: one specimen, one experiment, no one twice."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from analysis.record import Record

_STATED: Final = ("excitation", "amplitude_rad", "start_hz", "stop_hz", "duration_s", "taper_s")
_UNITS: Final = {"beam_length_m": "m", "beam_density_kg_per_m": "kg/m",
                 "beam_bending_stiffness_n_m2": "N·m²", "tool_inertia_kg_m2": "kg·m²",
                 "amplitude_rad": "rad", "start_hz": "Hz", "stop_hz": "Hz", "duration_s": "s",
                 "taper_s": "s"}  # fmt: skip
_WHOLE: Final = 0.99
"""Share of the planned sweep from which it counts as complete: ticks may be missing at its end."""


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
    """

    facts: Mapping[str, str | float]
    sweep_s: float
    identity: tuple[str, ...]

    @classmethod
    def of(cls, record: Record) -> Experiment:
        """Collect what a record states."""
        beam, metadata = record.beam, record.metadata
        stated = {key: _number(metadata[key]) for key in _STATED if key in metadata}
        return cls(
            facts={
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
        )

    def unfinished(self, outcome: str) -> str:
        """Say that the sweep ended early, as the end of a sentence; empty if it did not."""
        planned_s = self.facts.get("duration_s")
        if not isinstance(planned_s, float) or self.sweep_s >= _WHOLE * planned_s:
            return ""
        return (
            f"its sweep ended after {self.sweep_s:.4g} s of {planned_s:g} s (outcome: {outcome}), "
            "and is not averaged with whole ones; analyse it by itself."
        )

    def difference(self, other: Experiment) -> str | None:
        """Name the first fact in which another one differs, None if it is the same experiment."""
        for key, mine in self.facts.items():
            theirs = other.facts.get(key, mine)
            if not _same(theirs, mine):
                return f"{key} is {_told(key, theirs)}, but {_told(key, mine)}"
        return None


def most_common(experiments: Sequence[Experiment]) -> int:
    """Return the place of the one with which most others agree, the first of several."""
    agree = [sum(one.difference(two) is None for two in experiments) for one in experiments]
    return agree.index(max(agree))


def _same(one: str | float, two: str | float) -> bool:
    if isinstance(one, str) or isinstance(two, str):
        return one == two
    return math.isclose(one, two, rel_tol=1e-9)


def _told(key: str, value: str | float) -> str:
    if isinstance(value, str):
        return value
    return f"{value:g} {_UNITS.get(key, '')}".rstrip()


def _number(text: str) -> str | float:
    try:
        return float(text)
    except ValueError:
        return text
