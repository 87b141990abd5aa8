"""Output-error estimation on the whole record: measured torque against predicted torque."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.levenberg_marquardt import Minimum, minimise
from analysis.structures import STRUCTURES
from analysis.whole_record.comparison import Comparison
from analysis.whole_record.noise import Noise, noise_of
from analysis.whole_record.objective import Objective
from analysis.whole_record.plant import SETTINGS, Plant
from analysis.whole_record.result import RecordAnalysis
from analysis.whole_record.rough import RoughResponse, rough_minima
from analysis.whole_record.summary import summary
from analysis.whole_record.unknowns import Unknowns
from rigd.beam import Damping

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from analysis.structures import Structure
    from analysis.whole_record.measurement import Measurement
    from analysis.whole_record.plant import Setting

BAND_HZ: Final = (0.0, 50.0)
_DESCENTS: Final = 3
_FIRST_TOLERANCE: Final = 1e-3
_TOLERANCE: Final = 1e-9
"""Of the sum of squares: less than a hundredth of a standard deviation."""

_BEFORE_LINES: Final = 1e-6
_RESONANCE: Final = 3.0
"""Half-widths of a resonance (damping ratio times frequency) within which no line is sought."""

_RESONANCE_BINS: Final = 20
"""The same for the sharpest of them, in bins."""

_FILLINGS: Final = 8
_SETTLED: Final = 1e-6


def fit_record(
    measurement: Measurement,
    structures: Iterable[Structure] = tuple(STRUCTURES.values()),
    *,
    fixed: Iterable[Setting] = (),
    band_hz: tuple[float, float] = BAND_HZ,
    uniform: bool = True,
) -> RecordAnalysis:
    """Fit structures to a whole record in the band.

    The torque is predicted from the measured angle (`Prediction`); the squares of what the
    measurement differs by, whitened with the spectrum of the noise found in it, are minimised over
    the damping and over density over stiffness, stiffness, delay and tool inertia. For noise in
    the torque alone that is the maximum-likelihood estimate, whatever the excitation.

    Parameters
    ----------
    measurement : Measurement
    structures : iterable of Structure
        They share one noise spectrum, that of the one closest to the rough response, so that
        their costs compare.
    fixed : iterable of str
        Settings (`SETTINGS`) that stay at the values the file states.
    band_hz : tuple of float
        First and last frequency compared.
    uniform : bool
        Whether the beam is taken to be uniform, as Eq. 25 has it; otherwise the stiffness of each
        mode in the band but the first is free as well.

    Raises
    ------
    MeasurementError
        The record cannot be used.
    ValueError
        There is no such setting.
    """
    fixed = tuple(fixed)
    unknown = sorted(set(fixed) - set(SETTINGS))
    if unknown:
        raise ValueError(f"{unknown} cannot be fixed: choose from {SETTINGS}.")
    free = tuple(name for name in SETTINGS if name not in fixed)
    comparison = Comparison.of(measurement, band_hz)
    nominal = Plant(
        measurement.beam, Damping(), measurement.delay_s, measurement.tool_inertia_kg_m2
    )
    rough = RoughResponse(comparison)
    starts = [
        _Starts(Objective(comparison, unknowns), rough_minima(rough, unknowns))
        for unknowns in (
            Unknowns.of(structure, nominal, free, 1 if uniform else comparison.visible_modes)
            for structure in structures
        )
    ]
    closest = min(starts, key=lambda start: start.minima[0].cost)
    noise = closest.lowest().noise()
    reference = closest.descent(noise)
    reference = reference.settled(reference.noise(), _BEFORE_LINES)
    # Lines are looked for once, in what a fit to every bin leaves.
    noise = reference.noise(with_lines=True)
    reference = reference.settled(noise, _TOLERANCE)
    descents = [
        reference if start is closest else start.descent(noise).settled(noise, _TOLERANCE)
        for start in starts
    ]
    return RecordAnalysis(
        fits=tuple(summary(descent.objective, descent.x, noise) for descent in descents),
        frequency_hz=comparison.frequency_hz,
        compared=noise.counts,
        noise_nm2_per_hz=2 * noise.power / (comparison.samples * comparison.decimation.rate_hz),
        lines=noise.lines,
    )


@dataclass(frozen=True, slots=True)
class _Descent:
    """Where one structure has come to."""

    objective: Objective
    x: NDArray[np.float64]

    def lower(self, noise: Noise, tolerance: float) -> _Descent:
        """Descend under a noise spectrum, unknown torques as predicted here."""
        objective = self.objective
        refilled = objective.comparison.filled(objective.unknowns.plant(self.x))
        if refilled is not objective.comparison:
            objective = Objective(refilled, objective.unknowns)
        weight = noise.weight
        minimum = minimise(
            lambda x: objective.normal_equations(x, weight),
            self.x,
            *objective.unknowns.bounds,
            relative_tolerance=tolerance,
        )
        return _Descent(objective, minimum.x)

    def settled(self, noise: Noise, tolerance: float) -> _Descent:
        """Descend to the minimum; again, while what is put for unknown torques moves it."""
        here = self.lower(noise, tolerance)
        if self.objective.comparison.measurement.torque_known.all():
            return here
        for _ in range(_FILLINGS):
            before, here = here, here.lower(noise, tolerance)
            if np.abs(here.x - before.x).max() < _SETTLED:
                break
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
                width = max(
                    _RESONANCE * abs(pole.at_rad_s.real) / (2 * np.pi),
                    _RESONANCE_BINS * (hz[1] - hz[0]),
                )
                near_mode |= np.abs(hz - abs(pole.at_rad_s.imag) / (2 * np.pi)) < width
        return noise_of(
            objective.project(at, 1.0).residual,
            comparison.frequency_hz,
            comparison.samples,
            comparison.measurement.torque_share,
            near_mode,
        )


@dataclass(frozen=True, slots=True)
class _Starts:
    """Where the descents of one structure start: its rough minima, the lowest first."""

    objective: Objective
    minima: list[Minimum]

    def lowest(self) -> _Descent:
        return _Descent(self.objective, self.minima[0].x)

    def descent(self, noise: Noise) -> _Descent:
        """Descend from the best few, and go where it is lowest."""
        ends = [
            _Descent(self.objective, minimum.x).lower(noise, _FIRST_TOLERANCE)
            for minimum in self.minima[:_DESCENTS]
        ]
        return min(ends, key=lambda end: end.objective.normal_equations(end.x, noise.weight).cost)
