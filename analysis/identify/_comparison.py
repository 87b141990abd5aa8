"""Comparison of one record in one band with any plant: compared samples and removed parts.

`analysis.identify._instrument` selects the part of the motor angle that is used as input.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._data import Decimation, MeasurementError, fast_length_below
from analysis.identify._instrument import following
from analysis.identify._predictor import TorquePredictor
from analysis.identify.drag_torque import DragExpansion, DragResponse
from analysis.identify.free_decay import (
    DecaySpectra,
    LaterDecaySpectra,
    decay_columns,
    mode_poles,
)
from analysis.models import LARGEST_FRACTION_OF_RATE
from rigd.beam import undamped_frequencies_rad_s

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from analysis.identify._data import Measurement
    from analysis.identify._hum import Hum
    from analysis.identify._modal_model import ModalModel
    from analysis.identify._plant import Plant
    from analysis.identify.drag_torque import DragLaw
    from analysis.identify.free_decay import Pole
    from analysis.identify.noise import NoiseSpectrum

_FEWEST_BINS: Final = 50
_LARGEST_CHANGE: Final = 0.1
"""Whitened squares that a change of the removed torque may add before it is computed again."""

_FEEDBACKS: Final = 3
"""Iterations between the ringing torque and the part of the angle that follows the reference."""

_LARGEST_REST: Final = 0.3
"""Largest fraction of the angle's power that may be incoherent with the reference. With more the
motor followed another reference."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """Data of one record in one band, to be compared with any plant.

    Attributes
    ----------
    measurement : Measurement
        Record at its full rate.
    angle_rad, torque_nm : ndarray, shape (m,)
        Both channels in the band at the decimated rate; unknown torque is filled by the prediction.
    decimation : Decimation
    retained : slice
        Samples that are compared.
    prediction : TorquePredictor
    bins : slice
        Bins of the residual's transform that lie in the band.
    frequency_hz : ndarray, shape (K,)
    visible_modes : int
        Number of modes of the nominal beam in the band; their free decay is projected out.
    decays : DecaySpectra
        Spectra of the free decay at the beginning.
    later_decays : tuple of LaterDecaySpectra
        Spectra of the free decay after each gap of the angle that is too long to interpolate.
    removed_nm : ndarray, shape (samples,)
        Torque by impacts and drag that was removed, at the retained samples.
    removed_at_unknown_nm : ndarray, shape (u,)
        The same at the ticks with unknown torque.
    hum : tuple of Hum
        Hum that was removed, as estimated; its remainder is projected out.
    incoherent_rad : ndarray, shape (m,), or float
        Part of the angle that is incoherent with the reference; 0 if all of the angle is used.
    incoherent_nm, incoherent_at_unknown_nm : ndarray or float
        Torque that was removed for it, at the retained samples and at the ticks without torque.
    drag : DragExpansion, optional
        Removed torque by drag, and its derivatives with respect to the beam.
    impact_spectra : ndarray of complex, shape (k, K), or None
        Spectra of the torque by impacts, of unknown sizes, in addition to the removed torque.
    last_poles_rad_s : list of complex
        Poles of the last plant; other plants that explain the record have similar ones.
    """

    measurement: Measurement
    angle_rad: NDArray[np.float64]
    torque_nm: NDArray[np.float64]
    decimation: Decimation
    retained: slice
    prediction: TorquePredictor
    bins: slice
    frequency_hz: NDArray[np.float64]
    visible_modes: int
    decays: DecaySpectra
    later_decays: tuple[LaterDecaySpectra, ...] = ()
    removed_nm: NDArray[np.float64] | float = 0.0
    removed_at_unknown_nm: NDArray[np.float64] | float = 0.0
    hum: tuple[Hum, ...] = ()
    incoherent_rad: NDArray[np.float64] | float = 0.0
    incoherent_nm: NDArray[np.float64] | float = 0.0
    incoherent_at_unknown_nm: NDArray[np.float64] | float = 0.0
    drag: DragExpansion | None = None
    impact_spectra: NDArray[np.complex128] | None = None
    last_poles_rad_s: list[complex] = field(default_factory=list)

    @classmethod
    def of(cls, measurement: Measurement, band_hz: tuple[float, float]) -> Comparison:
        """Return a measurement reduced to a band.

        The mean of the residual is never compared: it is the zero of the torque sensor.

        Parameters
        ----------
        measurement : Measurement
            Record at its full rate.
        band_hz : tuple of float
            First and last frequency.

        Raises
        ------
        MeasurementError
            The record cannot be used, or is too short for the band.
        """
        lowest_hz, highest_hz = band_hz
        limit_hz = LARGEST_FRACTION_OF_RATE * measurement.rate_hz
        if not 0 <= lowest_hz < highest_hz <= limit_hz:
            raise MeasurementError(
                f"{measurement.name}: the band {lowest_hz:g}-{highest_hz:g} Hz is empty, negative "
                f"or beyond {LARGEST_FRACTION_OF_RATE:g} of the sampling rate ({limit_hz:g} Hz); "
                "choose another --band."
            )
        measurement.check(highest_hz)
        decimation = Decimation.to_band(measurement.rate_hz, highest_hz)
        angle_rad = decimation.apply(measurement.angle_from_rest(highest_hz))
        inside = decimation.inside(measurement.angle_rad.size)
        samples = inside.stop - inside.start
        if samples > 0:
            samples = fast_length_below(samples)
        all_hz = np.arange(samples // 2 + 1) * (decimation.rate_hz / max(samples, 1))
        first = max(int(np.searchsorted(all_hz, lowest_hz)), 1)
        bins = slice(first, int(np.searchsorted(all_hz, highest_hz, side="right")))
        if bins.stop - bins.start < _FEWEST_BINS:
            raise MeasurementError(
                f"{measurement.name}: {measurement.angle_rad.size / measurement.rate_hz:.3g} s of "
                f"record are too short for the band {lowest_hz:g}-{highest_hz:g} Hz: "
                f"{max(bins.stop - bins.start, 0)} frequencies, at least {_FEWEST_BINS} are "
                "needed; record longer or widen the band."
            )
        retained = slice(inside.start, inside.start + samples)
        frequency_hz = all_hz[bins]
        beam = measurement.beam
        gaps = measurement.long_gaps(highest_hz)
        if gaps:
            measurement = measurement.without_torque_in(gaps)
        known, torque = measurement.torque_known, measurement.torque_nm
        ticks = np.arange(torque.size)
        interpolated = torque if known.all() else np.interp(ticks, ticks[known], torque[known])
        omega_rad_s = 2 * np.pi * frequency_hz
        comparison = cls(
            measurement=measurement,
            angle_rad=angle_rad,
            torque_nm=decimation.apply(interpolated),
            decimation=decimation,
            retained=retained,
            prediction=TorquePredictor(angle_rad, decimation.rate_hz, retained),
            bins=bins,
            frequency_hz=frequency_hz,
            visible_modes=int(
                np.sum(undamped_frequencies_rad_s(beam, 50) < 2 * np.pi * highest_hz)
            ),
            decays=DecaySpectra(samples, decimation.rate_hz, omega_rad_s),
        )
        begin_s = [end / measurement.rate_hz - comparison.first_s for _, end in gaps]
        later = tuple(
            LaterDecaySpectra(
                samples, decimation.rate_hz, omega_rad_s, first_s, 1 / measurement.rate_hz
            )
            for first_s in begin_s
            if 0 < first_s < (samples - 1) / decimation.rate_hz
        )
        comparison = replace(comparison, later_decays=later)
        return comparison._without_impacts() if measurement.knocks else comparison

    def _without_impacts(self) -> Comparison:
        """Remove the impacts as estimated; their remainder is projected out."""
        rate_hz, knocks = self.decimation.rate_hz, self.measurement.knocks
        grid_s = self.times_s()
        ticks = self._decimated_indices(~self.measurement.torque_known)
        reach_s = self.decimation.reach / rate_hz
        unknown_s = ticks / self.measurement.rate_hz - reach_s
        taken_nm, at_unknown_nm = (
            np.sum([each.torque(time_s, grid_s, rate_hz) for each in knocks], axis=0)
            for time_s in (grid_s, unknown_s)
        )
        columns = np.concatenate([each.columns(grid_s, rate_hz) for each in knocks])
        return replace(self, impact_spectra=self.spectrum(columns))._without(
            taken_nm, at_unknown_nm
        )

    def _without(
        self, torque_nm: NDArray[np.float64] | float, at_unknown_nm: NDArray[np.float64] | float
    ) -> Comparison:
        """Remove torque at the retained samples and at the ticks with unknown torque."""
        left_nm = self.torque_nm.copy()
        left_nm[self.retained] -= torque_nm
        return replace(
            self,
            torque_nm=left_nm,
            removed_nm=self.removed_nm + torque_nm,
            removed_at_unknown_nm=self.removed_at_unknown_nm + at_unknown_nm,
        )

    def times_s(self) -> NDArray[np.float64]:
        """Return the times of the compared samples since the first tick, (samples,)."""
        return self.first_s + np.arange(self.samples) / self.decimation.rate_hz

    @property
    def first_s(self) -> float:
        """Return the time of the first compared sample."""
        return float(self.retained.start - self.decimation.reach) / self.decimation.rate_hz

    @property
    def samples(self) -> int:
        """Return the number of compared samples."""
        return int(self.retained.stop - self.retained.start)

    def poles(self, plant: Plant, wrt: Sequence[str] = ()) -> tuple[Pole, ...]:
        """Return the poles of a plant whose free decay is projected out, as `mode_poles` does.

        Parameters
        ----------
        plant : Plant
        wrt : sequence of str
            Parameters to differentiate by.
        """
        found = mode_poles(plant, self.visible_modes, wrt, self.last_poles_rad_s)
        self.last_poles_rad_s[:] = [pole.at_rad_s for pole in found]
        return found

    def spectrum(self, values: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Transform retained samples, shape (..., samples), to the band: (..., K)."""
        return np.fft.rfft(values)[..., self.bins]

    def in_time(self, spectrum: NDArray[np.complex128]) -> NDArray[np.float64]:
        """Transform a spectrum in the band, shape (K,), to the retained samples."""
        every = np.zeros(self.samples // 2 + 1, dtype=np.complex128)
        every[self.bins] = spectrum
        return np.fft.irfft(every, self.samples)

    def coherent_rad(self) -> NDArray[np.float64]:
        """Return the part of the angle that is coherent with the reference, shape (m,).

        This is the whole angle if there is no reference, or if the reference does not explain it.
        """
        if self.measurement.reference_rad is None:
            return self.angle_rad
        followed = self._followed(self.angle_rad)
        # By its speed: an angle that drifts follows no reference, and disturbs nothing.
        own, apart = (
            np.sum(np.diff(angle_rad[self.retained]) ** 2)
            for angle_rad in (self.angle_rad, self.angle_rad - followed)
        )
        return followed if apart < _LARGEST_REST * own else self.angle_rad

    def _followed(
        self, moved_rad: NDArray[np.float64], torque_nm: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Return the part of an angle that follows the reference and, optionally, a torque."""
        reference_rad = self.measurement.reference_rad
        assert reference_rad is not None
        # Later samples fall to 0 with the filter's end, behind everything that is compared.
        end = self._recorded
        reference_rad = self.decimation.apply(reference_rad - reference_rad[0])[:end]
        followed = moved_rad.copy()
        followed[:end] = following(
            moved_rad[:end], reference_rad, self.decimation.rate_hz, torque_nm
        )
        return followed

    @property
    def _recorded(self) -> int:
        """Return the slice of decimated samples up to the end of the record."""
        return int(self.decimation.inside(self.measurement.angle_rad.size).stop)

    def following_reference(self, plant: Plant | ModalModel) -> Comparison:
        """Use the part of the angle coherent with the reference as input (instrumental variable).

        The torque by the remaining part of the angle is removed.

        Parameters
        ----------
        plant : Plant
            Current estimate. Its error increases the noise and causes no bias.

        Returns
        -------
        Comparison
            `self` if all of the angle is coherent: see `coherent_rad`.
        """
        followed = self.coherent_rad()
        if followed is self.angle_rad:
            return self
        return self._split(self.angle_rad, followed, plant)

    def _split(
        self,
        moved_rad: NDArray[np.float64],
        followed: NDArray[np.float64],
        plant: Plant | ModalModel,
    ) -> Comparison:
        """Use a part of the angle as input, and remove the torque of a plant by the other part."""
        return replace(
            self,
            angle_rad=followed,
            prediction=self.prediction.of_other(followed),
            incoherent_rad=moved_rad - followed,
        ).with_incoherent_part_of(plant)

    def with_incoherent_part_of(self, plant: Plant | ModalModel) -> Comparison:
        """Replace the removed torque of the incoherent angle by the prediction of a plant."""
        if not isinstance(self.incoherent_rad, np.ndarray):
            return self
        rest = self.prediction.of_other(self.incoherent_rad)
        incoherent_nm = rest.torque(plant)[0]
        at_unknown_nm = rest.torque_between(
            plant, self.decimation.factor, self._decimated_indices(~self.measurement.torque_known)
        )[0]
        updated = replace(self, incoherent_nm=incoherent_nm, incoherent_at_unknown_nm=at_unknown_nm)
        return updated._without(
            incoherent_nm - self.incoherent_nm, at_unknown_nm - self.incoherent_at_unknown_nm
        )

    def renewed(self, plant: Plant | ModalModel, noise: NoiseSpectrum) -> Comparison:
        """Re-estimate the part of the angle that follows the reference, with a better plant.

        Parameters
        ----------
        plant : Plant
            Plant fitted to this comparison.
        noise : Noise

        Returns
        -------
        Comparison
            `self` if the new torque of the incoherent part would move no parameter by more than
            a third of its standard deviation.
        """
        other = self.with_incoherent_part_of(plant)
        if other is self:
            return self
        change = self.spectrum(other.incoherent_nm - np.asarray(self.incoherent_nm)) * noise.weight
        if np.vdot(change, change).real <= _LARGEST_CHANGE:
            return self
        moved_rad, followed = self.angle_rad + self.incoherent_rad, self.angle_rad
        felt = TorquePredictor(followed, self.decimation.rate_hz, slice(0, self._recorded))
        # What rings moves the motor, which makes it ring otherwise.
        for _ in range(_FEEDBACKS):
            followed = self._followed(moved_rad, felt.of_other(followed).torque(plant)[0])
        return self._split(moved_rad, followed, plant)

    @property
    def hum_nm(self) -> NDArray[np.float64] | float:
        """Return the removed hum at the retained samples."""
        return self._hum_at(np.arange(self.samples) / self.decimation.rate_hz)

    def without_hum(self, hum: tuple[Hum, ...]) -> Comparison:
        """Remove hum, and restore the hum that was removed before."""
        other = replace(self, hum=hum)
        ticks = self._decimated_indices(~self.measurement.torque_known)
        first_s = self.retained.start / self.decimation.rate_hz
        time_s = ticks / self.measurement.rate_hz - first_s
        return other._without(
            other.hum_nm - self.hum_nm, other._hum_at(time_s) - self._hum_at(time_s)
        )

    def with_drag(self, plant: Plant, law: DragLaw) -> Comparison:
        """Remove the torque by drag, and store its derivatives.

        Parameters
        ----------
        plant : Plant
            Beam on which the drag acts.
        law : DragLaw

        Raises
        ------
        DragError
            The drag is too large for the time steps.
        """
        # All that moves is braked, whether or not it followed a reference.
        moved_rad = self.angle_rad + self.incoherent_rad
        response = DragResponse(moved_rad, self.decimation.rate_hz, plant)
        found = response.torque(law, range(1, self.visible_modes + 1))

        def band(values: NDArray[np.float64]) -> NDArray[np.complex128]:
            return self.spectrum(values[..., self.retained])

        unknown = self._decimated_indices(~self.measurement.torque_known)
        between = np.fft.irfft(
            self.decimation.factor * np.fft.rfft(found.torque_nm),
            self.decimation.factor * found.torque_nm.size,
        )
        return replace(
            self,
            torque_nm=self.torque_nm - found.torque_nm,
            removed_nm=self.removed_nm + found.torque_nm[self.retained],
            removed_at_unknown_nm=self.removed_at_unknown_nm + between[unknown],
            drag=DragExpansion(
                plant=plant,
                law=law,
                response=response,
                band=band,
                by_pole={mode: band(rows) for mode, rows in found.by_pole.items()},
                by_external=band(found.by_external),
                by_ln_density=band(found.by_ln_density),
                by_delay=band(found.by_delay),
                by_law=band(found.by_law),
                speed_m_s=found.speed_m_s,
                top_speed_m_s=found.top_speed_m_s,
            ),
        )

    def _hum_at(self, time_s: NDArray[np.float64]) -> NDArray[np.float64] | float:
        return sum((hum.torque(time_s) for hum in self.hum), start=0.0)

    def nuisance(self, poles: Sequence[Pole]) -> NDArray[np.complex128]:
        """Return spectra of terms of unknown amplitude, shape (m, K).

        These are the free decays from the beginning and from each long gap, hum, impacts, and last
        a linear drift of the torque sensor's zero. Without it the jump from the end of the record
        to its beginning would leak into all bins.
        """
        hum = self.decays.hum([hum.frequency_hz for hum in self.hum])
        drift = _drift(self.samples)[None, self.bins]
        impact_spectra = drift[:0] if self.impact_spectra is None else self.impact_spectra
        decays = [each.columns(poles) for each in (self.decays, *self.later_decays)]
        return np.concatenate([*decays, hum, impact_spectra, drift])

    def decay_gradient(
        self, poles: Sequence[Pole], amplitudes: NDArray[np.float64]
    ) -> NDArray[np.complex128]:
        """Differentiate the free decays among ``amplitudes @ nuisance(poles)`` through the poles.

        Parameters
        ----------
        poles : sequence of Pole
        amplitudes : ndarray, shape (m,)

        Returns
        -------
        ndarray of complex, shape (k, K)
        """
        total = self.decays.gradient(poles, amplitudes)
        each = decay_columns(poles)
        for number, later in enumerate(self.later_decays, start=1):
            total += later.gradient(poles, amplitudes[number * each :])
        return total

    def filled(self, plant: Plant | ModalModel) -> Comparison:
        """Fill unknown torque with the prediction of `plant`, so that it adds no residual.

        After convergence the remaining squares have the same minimum as those of the known samples.
        """
        known = self.measurement.torque_known
        if known.all():
            return self
        torque = self.measurement.torque_nm.copy()
        torque[~known] = (
            self.removed_at_unknown_nm
            + self.prediction.torque_between(
                plant, self.decimation.factor, self._decimated_indices(~known)
            )[0]
        )
        torque_nm = self.decimation.apply(torque)
        torque_nm[self.retained] -= self.removed_nm
        return replace(self, torque_nm=torque_nm)

    def lost_gradient(self, plant: Plant, wrt: tuple[str, ...]) -> NDArray[np.complex128]:
        """Return the contribution of the unknown torques to the gradient's spectra, (k, K).

        Parameters
        ----------
        plant : Plant
            Beam and rig.
        wrt : tuple of str
            Names of the derivatives, k of them.
        """
        unknown = ~self.measurement.torque_known
        lost = np.zeros((len(wrt), self.frequency_hz.size), dtype=np.complex128)
        if unknown.any():
            _, gradient = self.prediction.torque_between(
                plant, self.decimation.factor, self._decimated_indices(unknown), wrt
            )
            for row, values in zip(lost, gradient, strict=True):
                only = np.zeros(unknown.size)
                only[unknown] = values
                row[:] = self.spectrum(self.decimation.apply(only)[self.retained])
        return lost

    def _decimated_indices(self, ticks: NDArray[np.bool_]) -> NDArray[np.intp]:
        """Return the indices of ticks at full rate, counted from the first decimated sample."""
        return np.flatnonzero(ticks) + self.decimation.reach * self.decimation.factor


@lru_cache(maxsize=2)
def _drift(samples: int) -> NDArray[np.complex128]:
    """Return the transform of a drift of 1 over all samples; it is cached and read-only."""
    drift: NDArray[np.complex128] = np.fft.rfft(np.linspace(-0.5, 0.5, samples))
    drift.flags.writeable = False
    return drift
