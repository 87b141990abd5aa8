"""The way to the lowest minimum of one structure: rough response first, then the whole record."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.descent import descend
from analysis.whole_record.noise import Noise, noise_of
from analysis.whole_record.objective import Objective
from analysis.whole_record.rough import RoughResponse, rough_minima, rough_starts
from analysis.whole_record.steady_hum import hum_beside_modes, resonance_reach_hz
from analysis.whole_record.steps import Steps

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.descent import Minimum
    from analysis.whole_record.comparison import Comparison
    from analysis.whole_record.plant import Plant
    from analysis.whole_record.steady_hum import Hum
    from analysis.whole_record.unknowns import Unknowns

_BETWEEN_RIVALS: Final = 1e-2
"""Relative tolerance that tells which of several minima is lower."""

_RIVALS: Final = 2
_NO_RIVAL: Final = 1.5
"""A rough minimum whose cost is larger than the lowest one's by this factor is not gone after."""

_CLEARLY: Final = 0.9
"""Cost, relative to where a descent has ended, that makes another rough minimum worth a look."""

_MOST_MINIMA: Final = 4
_LOOKS: Final = 3
"""As often hum is looked for: the first fit took part of it for the beam's doing."""

_FILLINGS: Final = 8
_SETTLED: Final = 1e-6


@dataclass(frozen=True, slots=True)
class Descent:
    """Where one structure has come to."""

    objective: Objective
    x: NDArray[np.float64]

    @property
    def plant(self) -> Plant:
        """The plant there."""
        return self.objective.unknowns.plant(self.x)

    def lower(self, noise: Noise, tolerance: float) -> Descent:
        """Descend under a noise spectrum, unknown torques as predicted here."""
        objective = self.objective
        refilled = objective.comparison.filled(objective.unknowns.plant(self.x))
        if refilled is not objective.comparison:
            objective = Objective(refilled, objective.unknowns)
        weight = noise.weight
        minimum = descend(
            lambda x: objective.normal_equations(x, weight),
            self.x,
            Steps.of(objective.unknowns),
            relative_tolerance=tolerance,
        )
        return Descent(objective, minimum.x)

    def settled(self, noise: Noise, tolerance: float) -> Descent:
        """Descend to the minimum; again, while what is put for unknown torques moves it."""
        here = self.lower(noise, tolerance)
        if self.objective.comparison.measurement.torque_known.all():
            return here
        for _ in range(_FILLINGS):
            before, here = here, here.lower(noise, tolerance)
            if np.abs(here.x - before.x).max() < _SETTLED:
                break
        return here

    def hum(self) -> tuple[Hum, ...]:
        """Look for what hums beside a mode, with the beam found so far."""
        comparison = self.objective.comparison
        at, noise = self.objective.linearise(self.x), self.noise()
        amplitudes = self.objective.project(at, noise.weight).amplitudes
        decays = sum(1 + pole.oscillates for pole in at.poles)
        decaying_nm = comparison.in_time(amplitudes[:decays] @ at.columns[:decays])
        return hum_beside_modes(comparison, self.plant, at.poles, noise, decaying_nm)

    def without_hum(self, tolerance: float) -> Descent:
        """Take out what hums beside a mode, and settle again; `self` if nothing does."""
        here = self
        for _ in range(_LOOKS):
            hum = here.hum()
            if not hum:
                return self
            objective = Objective(
                here.objective.comparison.without_hum(hum), here.objective.unknowns
            )
            here = Descent(objective, here.x)
            here = here.settled(here.noise(), tolerance)
        return here

    def noise(self, *, with_lines: bool = False) -> Noise:
        """Take for noise what remains here and is no free decay."""
        objective, comparison = self.objective, self.objective.comparison
        at = objective.linearise(self.x)
        near_mode = None
        if with_lines:
            hz = comparison.frequency_hz
            near_mode = np.zeros(hz.size, dtype=bool)
            for pole in at.poles:
                width = resonance_reach_hz(pole, float(hz[1] - hz[0]))
                near_mode |= np.abs(hz - abs(pole.at_rad_s.imag) / (2 * np.pi)) < width
        return noise_of(
            objective.project(at, 1.0).residual,
            comparison.frequency_hz,
            comparison.samples,
            comparison.measurement.torque_share,
            near_mode,
        )


@dataclass(frozen=True, slots=True)
class Search:
    """One structure on one record: where its minima may lie.

    Attributes
    ----------
    objective : Objective
    rough : RoughResponse
    first : ndarray, shape (k,)
        Where the orders are 1.
    minima : list of Minimum
        Of the rough response, noise taken for white; the lowest first.
    """

    objective: Objective
    rough: RoughResponse
    first: NDArray[np.float64]
    minima: list[Minimum]

    @classmethod
    def of(cls, objective: Objective, rough: RoughResponse) -> Search:
        """Look over the whole range of the unknowns."""
        starts = rough_starts(rough, objective.unknowns)
        return cls(objective, rough, starts[0], rough_minima(rough, objective.unknowns, starts))

    @property
    def unknowns(self) -> Unknowns:
        """What is searched for."""
        return self.objective.unknowns

    def on(self, comparison: Comparison) -> Search:
        """Compare with something else, from the same starts."""
        return replace(self, objective=Objective(comparison, self.unknowns))

    def lowest(self) -> Descent:
        """Where the rough response is lowest."""
        return Descent(self.objective, self.minima[0].x)

    def under(self, noise: Noise, near: Descent | None = None) -> Descent:
        """Go next to the lowest minimum of the whole record.

        Under another noise another minimum may be the lowest: all are looked at again on the rough
        response, which costs little, and the best few descended to.

        Parameters
        ----------
        noise : Noise
        near : Descent, optional
            Where one of the minima is known already.
        """
        rough = self.rough.whitened(noise, self.objective.comparison.frequency_hz)
        points = [minimum.x for minimum in self.minima[:_MOST_MINIMA]]
        found = rough_minima(rough, self.unknowns, [*points, self.first])
        rivals = [
            Descent(self.objective, minimum.x)
            for minimum in found[:_RIVALS]
            if minimum.cost < _NO_RIVAL * found[0].cost
        ]
        if near is not None:
            plant = self.unknowns.plant(near.x)
            rivals = [near] + [
                rival
                for rival in rivals
                if not rough.alike(plant, self.unknowns.plant(rival.x))
                and rough.cost(self.unknowns.plant(rival.x)) < _CLEARLY * rough.cost(plant)
            ]
        if len(rivals) == 1:
            return rivals[0]
        ends = [rival.lower(noise, _BETWEEN_RIVALS) for rival in rivals]
        return min(ends, key=lambda end: end.objective.normal_equations(end.x, noise.weight).cost)
