"""All structures fitted to one record under one noise, and what the information criteria say."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.selection.hum import without_leakage
from analysis.selection.refit import Refit, adapted, vector
from analysis.structures import STRUCTURES
from analysis.whole_record import SETTINGS, Plant, fit_record
from analysis.whole_record.comparison import Comparison
from analysis.whole_record.noise import Noise
from analysis.whole_record.unknowns import Unknowns
from rigd.beam import Damping

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from analysis.structures import Structure
    from analysis.whole_record import Measurement, RecordAnalysis, RecordFit, Setting

FREE_STIFFNESS: Final = (STRUCTURES["III"], STRUCTURES["VII"])
"""Structures also tried on a beam that is not uniform: those of a material of integer order. With
a free order as well, the order would be read off what the stiffness leaves over."""

_CROSS_CHECKS: Final = 3
_FEW: Final = 8
"""Evaluations that settle a fit under slightly other noise, or show that a start leads nowhere."""

_MANY: Final = 40
_NEARLY: Final = 1e-3
_VISIBLE: Final = 20.0
"""Power over that of the noise, at the peak of a mode that shows."""

_NEAR: Final = 0.05


@dataclass(frozen=True, slots=True)
class Candidate:
    """One structure on one kind of beam, fitted.

    Attributes
    ----------
    structure : Structure
    uniform : bool
        Whether all modes follow from one stiffness.
    fit : RecordFit
    columns : int
        Parameters of what is not linear, beside those of the fit.
    """

    structure: Structure
    uniform: bool
    fit: RecordFit
    columns: int = 0

    @property
    def parameters(self) -> int:
        """Number of free parameters; the free decay's amplitudes, common to all, do not count."""
        return len(self.fit.interval) + self.columns

    @property
    def values(self) -> int:
        """Number of real values compared."""
        fit = self.fit
        decays = fit.ringing.degrees_of_freedom
        return fit.degrees_of_freedom + len(fit.interval) + decays + self.columns

    @property
    def deviance(self) -> float:
        """``-2 ln`` likelihood but for a constant: noise of known shape and free level."""
        return self.values * math.log(self.fit.cost / self.values)

    @property
    def bic(self) -> float:
        """Schwarz, Annals of Statistics 6 (1978) 461-464."""
        return self.deviance + self.parameters * math.log(self.values)

    @property
    def aic(self) -> float:
        """Akaike, IEEE Trans. Automatic Control 19 (1974) 716-723."""
        return self.deviance + 2 * self.parameters

    @property
    def name(self) -> str:
        """As tables call it."""
        return self.structure.name if self.uniform else f"{self.structure.name}, modes free"


@dataclass(frozen=True, slots=True)
class Field:
    """All candidates on one record, and what it takes to fit again.

    Attributes
    ----------
    comparison : Comparison
    noise : Noise
        The one under which all were fitted.
    free : tuple of str
        Settings that are free.
    candidates : tuple of Candidate
        The lowest BIC first.
    columns : ndarray of complex, shape (c, K)
        What all were allowed beside the linear beam.
    """

    comparison: Comparison
    noise: Noise
    free: tuple[Setting, ...]
    candidates: tuple[Candidate, ...]
    columns: NDArray[np.complex128]

    @classmethod
    def of(
        cls,
        measurement: Measurement,
        fixed: tuple[Setting, ...],
        band_hz: tuple[float, float],
    ) -> Field:
        """Fit every structure.

        Raises
        ------
        MeasurementError
            The record cannot be used.
        """
        uniform = fit_record(measurement, fixed=fixed, band_hz=band_hz)
        comparison = Comparison.of(measurement, band_hz)
        found = [(fit, True) for fit in uniform.fits]
        analyses = [uniform]
        likeliest = min(uniform.fits, key=lambda fit: fit.cost)
        if len(visible_modes(comparison, _noise(uniform, comparison), likeliest)) > 1:
            loose = fit_record(
                measurement, FREE_STIFFNESS, fixed=fixed, band_hz=band_hz, uniform=False
            )
            found += [(fit, False) for fit in loose.fits]
            analyses.append(loose)
        reference = _closest(analyses)
        estimated = _noise(reference, comparison)
        closest = min(reference.fits, key=lambda fit: fit.cost)
        noise = without_leakage(estimated, comparison, closest)
        field = cls(
            comparison=comparison,
            noise=noise,
            free=tuple(name for name in SETTINGS if name not in fixed),
            candidates=(),
            columns=np.zeros((0, comparison.frequency_hz.size), dtype=np.complex128),
        )
        as_estimated = np.array_equal(noise.counts, estimated.counts)
        own = {id(fit) for fit in reference.fits} if as_estimated else set()
        field = replace(
            field,
            candidates=_ranked(
                Candidate(fit.structure, is_uniform, fit)
                if id(fit) in own
                else field.candidate(fit.structure, is_uniform, fit.plant, _FEW)
                for fit, is_uniform in found
            ),
        )
        return field.cross_checked()

    @property
    def best(self) -> Candidate:
        """The lowest BIC."""
        return self.candidates[0]

    @property
    def bic(self) -> float:
        """The lowest, comparable between fields whose noise has been estimated anew."""
        return self.best.bic + 2 * float(np.sum(np.log(self.noise.power[self.noise.counts])))

    def unknowns(self, structure: Structure, uniform: bool) -> Unknowns:
        """Search space of a structure on this record."""
        measurement = self.comparison.measurement
        nominal = Plant(
            measurement.beam, Damping(), measurement.delay_s, measurement.tool_inertia_kg_m2
        )
        modes = 1 if uniform else self.comparison.visible_modes
        return Unknowns.of(structure, nominal, self.free, modes)

    def refit(
        self, structure: Structure, uniform: bool, start: Plant, max_evaluations: int = _MANY
    ) -> Refit:
        """Descend with one structure from a plant that has its damping."""
        unknowns = self.unknowns(structure, uniform)
        at = vector(unknowns, start)
        return Refit.descend(
            self.comparison, unknowns, at, self.noise, self.columns, max_evaluations
        )

    def candidate(
        self, structure: Structure, uniform: bool, start: Plant, max_evaluations: int = _MANY
    ) -> Candidate:
        """Fit one structure from a plant."""
        refit = self.refit(structure, uniform, start, max_evaluations)
        return Candidate(structure, uniform, refit.fit(), len(self.columns))

    def cross_checked(self) -> Field:
        """Start each from where the best is: over a flat valley a search may miss what is there."""
        field = self
        for _ in range(_CROSS_CHECKS):
            best = field.best
            checked = _ranked(
                c if c is best else field._from_other(c, best) for c in field.candidates
            )
            field = replace(field, candidates=checked)
            if field.best is best:
                break
        return field

    def _from_other(self, candidate: Candidate, other: Candidate) -> Candidate:
        """Fit a candidate from another's plant, where that has the same kinds of damping."""
        structure = candidate.structure
        if (other.structure.internal and not structure.internal) or (
            other.structure.external and not structure.external
        ):
            return candidate
        unknowns = self.unknowns(structure, candidate.uniform)
        start = adapted(unknowns, other.fit.plant, other.structure)
        given = (self.noise, self.columns)
        first = Refit.descend(self.comparison, unknowns, start, *given, _FEW)
        if first.cost > candidate.fit.cost * (1 + _NEARLY):
            return candidate
        found = Refit.descend(self.comparison, unknowns, first.x, *given, _MANY)
        if found.cost > candidate.fit.cost * (1 - 1e-7):
            return candidate
        return Candidate(structure, candidate.uniform, found.fit(), len(self.columns))

    def with_columns(self, columns: NDArray[np.complex128], noise: Noise) -> Field:
        """Fit all again, with what is not linear beside the beam."""
        other = replace(self, columns=columns, noise=noise)
        again = _ranked(
            other.candidate(c.structure, c.uniform, c.fit.plant) for c in self.candidates
        )
        return replace(other, candidates=again).cross_checked()


def visible_modes(comparison: Comparison, noise: Noise, fit: RecordFit) -> tuple[int, ...]:
    """Modes at which the torque stands out of the noise."""
    torque = comparison.spectrum(comparison.torque_nm[comparison.kept])
    over = np.abs(torque) ** 2 / noise.power
    found = []
    for mode in fit.modes:
        near = np.abs(comparison.frequency_hz - mode.frequency_hz) < _NEAR * mode.frequency_hz
        near &= noise.counts
        if near.any() and float(np.median(over[near])) > _VISIBLE:
            found.append(mode.number)
    return tuple(found)


def _ranked(candidates: Iterable[Candidate]) -> tuple[Candidate, ...]:
    return tuple(sorted(candidates, key=lambda candidate: candidate.bic))


def _closest(analyses: list[RecordAnalysis]) -> RecordAnalysis:
    """Find the analysis under whose noise the record is likeliest."""
    common = np.logical_and.reduce([analysis.compared for analysis in analyses])

    def deviance(analysis: RecordAnalysis) -> float:
        best: RecordFit = min(analysis.fits, key=lambda fit: fit.cost)
        squares = float(np.sum(np.abs(best.residual[common]) ** 2))
        return squares + 2 * float(np.sum(np.log(analysis.noise_nm2_per_hz[common])))

    return min(analyses, key=deviance)


def _noise(analysis: RecordAnalysis, comparison: Comparison) -> Noise:
    """Noise as the estimator had it: the power of each bin."""
    scale = comparison.samples * comparison.decimation.rate_hz / 2
    return Noise(analysis.noise_nm2_per_hz * scale, analysis.compared, analysis.lines)
