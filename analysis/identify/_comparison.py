"""Data of one record in one band, ready to be compared with the torque that a plant predicts.

`analysis.identify._instrument` selects the part of the motor angle that is used as input.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from analysis.decimation import Decimation, fast_fft_length_below
from analysis.identify._data import MeasurementError
from analysis.identify._drag_expansion import DragExpansion
from analysis.identify._encoder import encoder_step_rad
from analysis.identify._instrument import reference_coherent_angle
from analysis.identify._predictor import TorquePredictor
from analysis.identify.drag_torque import DragResponse
from analysis.identify.free_decay import DecaySpectra, LaterDecaySpectra, count_decay_spectra
from analysis.models import MAX_FREQUENCY_TO_RATE_RATIO
from analysis.optimizer import RecentValues
from rigd.beam import Plant, ResponseGrid, undamped_frequencies_rad_s

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from analysis.identify._data import Measurement
    from analysis.identify._modal_model import ModalEstimate, ModalModel
    from analysis.identify.drag_torque import DragLaw
    from analysis.identify.noise import Hum, NoiseSpectrum
    from rigd.beam import Pole

_MAX_FILTER_TO_REST_RATIO: Final = 0.5
"""Largest half length of the decimation filter relative to the rest before a sudden motion."""

_MIN_FREQUENCY_BINS: Final = 50
"""Minimum number of frequency bins in the compared band."""

_MAX_REMOVED_TORQUE_CHANGE: Final = 0.1
"""Change of the torque caused by the part of the angle that is incoherent with the reference, as a
sum of whitened squares, up to which this torque is not recomputed."""

_ANGLE_FEEDBACK_ITERATIONS: Final = 3
"""Number of iterations between the torque of the ringing beam and the part of the angle that
follows the reference."""

_MAX_INCOHERENT_SPEED_FRACTION: Final = 0.3
"""Largest fraction of the power of the motor's speed that may be incoherent with the reference. If
it is larger, the motor followed another reference, and the whole angle is used."""

MAX_BINS_OF_STORED_RESULTS: Final = 65_536
"""Maximum number of bins with which every objective caches its results: the results of all
structures of a record of 30 minutes take 0.3 GB."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """Torque and angle of a record in a frequency band, compared with a plant's prediction.

    Attributes
    ----------
    measurement : Measurement
        Record at its full rate.
    angle_rad, torque_nm : ndarray, shape (m,)
        Both channels in the band at the decimated rate; unknown torque is filled by the prediction.
    decimation : Decimation
        Low-pass filter and downsampling from the full rate.
    retained_samples : slice
        Samples that are compared.
    torque_predictor : TorquePredictor
        Prediction of the torque from `angle_rad`.
    band_bins : slice
        Bins of the residual's transform that lie in the band.
    frequency_hz : ndarray, shape (K,)
        Frequencies of these bins.
    visible_mode_count : int
        Number of modes of the nominal beam in the band; their free decay is projected out.
    encoder_step_rad : float
        Step of the encoder; 0 if the angle has no steps.
    decay_spectra : DecaySpectra
        Spectra of the free decay at the beginning.
    later_decay_spectra : tuple of LaterDecaySpectra
        Spectra of the free decay after each gap of the angle that is too long to interpolate.
    removed_torque_nm : ndarray, shape (samples,)
        Torque by impacts, drag, hum and the incoherent angle that was removed, at the retained
        samples.
    removed_torque_in_gaps_nm : ndarray, shape (u,)
        The same torque at the ticks with unknown torque.
    hum : tuple of Hum
        Hum that was removed, as estimated; its remainder is projected out.
    incoherent_angle_rad : ndarray, shape (m,), or float
        Part of the angle that is incoherent with the reference; 0 if the whole angle is used.
    incoherent_torque_nm, incoherent_torque_in_gaps_nm : ndarray or float
        Torque caused by `incoherent_angle_rad`, which was removed: at the retained samples, and at
        the ticks with unknown torque.
    drag : DragExpansion, optional
        Removed torque by drag, and its derivatives with respect to the beam.
    impact_spectra : ndarray of complex, shape (k, K), or None
        Spectra of the torque by impacts with unknown amplitudes, in addition to the removed torque.
    last_poles_rad_s : list of complex
        Poles of the last plant, from which the search for the poles of the next plant starts.
    shared_result_cache : RecentValues
        Cache of one result, common to all objectives of a long record: one result for each
        objective would take too much memory.
    """

    measurement: Measurement
    angle_rad: NDArray[np.float64]
    torque_nm: NDArray[np.float64]
    decimation: Decimation
    retained_samples: slice
    torque_predictor: TorquePredictor
    band_bins: slice
    frequency_hz: NDArray[np.float64]
    visible_mode_count: int
    encoder_step_rad: float
    decay_spectra: DecaySpectra
    later_decay_spectra: tuple[LaterDecaySpectra, ...] = ()
    removed_torque_nm: NDArray[np.float64] | float = 0.0
    removed_torque_in_gaps_nm: NDArray[np.float64] | float = 0.0
    hum: tuple[Hum, ...] = ()
    incoherent_angle_rad: NDArray[np.float64] | float = 0.0
    incoherent_torque_nm: NDArray[np.float64] | float = 0.0
    incoherent_torque_in_gaps_nm: NDArray[np.float64] | float = 0.0
    drag: DragExpansion | None = None
    impact_spectra: NDArray[np.complex128] | None = None
    last_poles_rad_s: list[complex] = field(default_factory=list)
    shared_result_cache: RecentValues[Any] = field(default_factory=lambda: RecentValues(1))

    @classmethod
    def from_measurement(cls, measurement: Measurement, band_hz: tuple[float, float]) -> Comparison:
        """Return a measurement filtered to a frequency band, ready for comparison.

        The mean of the residual is never compared, since it contains the zero offset of the torque
        sensor.

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
        band_limit_hz = MAX_FREQUENCY_TO_RATE_RATIO * measurement.rate_hz
        if not 0 <= lowest_hz < highest_hz <= band_limit_hz:
            raise MeasurementError(
                f"{measurement.name}: the band {lowest_hz:g}-{highest_hz:g} Hz is empty, negative "
                f"or beyond {MAX_FREQUENCY_TO_RATE_RATIO:g} of the sampling rate "
                f"({band_limit_hz:g} Hz); choose another --band."
            )
        measurement.check_channels(highest_hz)
        # The rest before a step shows whether the beam was ringing: the filter may take a part of
        # it only.
        decimation = Decimation.with_half_length(
            measurement.rate_hz,
            highest_hz,
            _MAX_FILTER_TO_REST_RATIO * measurement.sudden_motion_s(),
        )
        angle_rad = decimation.apply(measurement.angle_from_rest_rad(highest_hz))
        usable_samples = decimation.samples_inside_record(measurement.angle_rad.size)
        sample_count = usable_samples.stop - usable_samples.start
        if sample_count > 0:
            sample_count = fast_fft_length_below(sample_count)
        all_frequencies_hz = np.arange(sample_count // 2 + 1) * (
            decimation.rate_hz / max(sample_count, 1)
        )
        first_bin = max(int(np.searchsorted(all_frequencies_hz, lowest_hz)), 1)
        band_bins = slice(
            first_bin, int(np.searchsorted(all_frequencies_hz, highest_hz, side="right"))
        )
        if band_bins.stop - band_bins.start < _MIN_FREQUENCY_BINS:
            raise MeasurementError(
                f"{measurement.name}: {measurement.angle_rad.size / measurement.rate_hz:.3g} s of "
                f"record are too short for the band {lowest_hz:g}-{highest_hz:g} Hz: "
                f"{max(band_bins.stop - band_bins.start, 0)} frequencies, at least "
                f"{_MIN_FREQUENCY_BINS} are needed; record longer or widen the band."
            )
        retained_samples = slice(usable_samples.start, usable_samples.start + sample_count)
        frequency_hz = all_frequencies_hz[band_bins]
        nominal_beam = measurement.beam
        angle_gaps = measurement.long_gaps(highest_hz)
        if angle_gaps:
            measurement = measurement.without_torque_in(angle_gaps)
        torque_is_known, torque_nm = measurement.torque_known, measurement.torque_nm
        ticks = np.arange(torque_nm.size)
        interpolated_torque_nm = (
            torque_nm
            if torque_is_known.all()
            else np.interp(ticks, ticks[torque_is_known], torque_nm[torque_is_known])
        )
        omega_rad_s = 2 * np.pi * frequency_hz
        comparison = cls(
            measurement=measurement,
            angle_rad=angle_rad,
            torque_nm=decimation.apply(interpolated_torque_nm),
            decimation=decimation,
            retained_samples=retained_samples,
            torque_predictor=TorquePredictor(angle_rad, decimation.rate_hz, retained_samples),
            band_bins=band_bins,
            frequency_hz=frequency_hz,
            visible_mode_count=int(
                np.sum(undamped_frequencies_rad_s(nominal_beam, 50) < 2 * np.pi * highest_hz)
            ),
            encoder_step_rad=encoder_step_rad(measurement.angle_rad),
            decay_spectra=DecaySpectra(sample_count, decimation.rate_hz, omega_rad_s),
        )
        gap_ends_s = [
            gap_end / measurement.rate_hz - comparison.first_sample_s for _, gap_end in angle_gaps
        ]
        later_decay_spectra = tuple(
            LaterDecaySpectra(
                sample_count,
                decimation.rate_hz,
                omega_rad_s,
                decay_start_s,
                1 / measurement.rate_hz,
            )
            for decay_start_s in gap_ends_s
            if 0 < decay_start_s < (sample_count - 1) / decimation.rate_hz
        )
        comparison = replace(comparison, later_decay_spectra=later_decay_spectra)
        return comparison._remove_impacts() if measurement.impacts else comparison

    def _remove_impacts(self) -> Comparison:
        """Return the comparison without the estimated torque of the known impacts on the beam.

        Errors of this estimate are projected out with `impact_spectra`.
        """
        rate_hz, impacts = self.decimation.rate_hz, self.measurement.impacts
        sample_times_s = self.times_s()
        unknown_torque_indices = self._decimated_indices(~self.measurement.torque_known)
        filter_reach_s = self.decimation.half_length_samples / rate_hz
        unknown_torque_times_s = unknown_torque_indices / self.measurement.rate_hz - filter_reach_s
        impact_torque_nm, impact_torque_in_gaps_nm = (
            np.sum([impact.torque(time_s, sample_times_s, rate_hz) for impact in impacts], axis=0)
            for time_s in (sample_times_s, unknown_torque_times_s)
        )
        impact_torques = np.concatenate(
            [impact.unit_torques(sample_times_s, rate_hz) for impact in impacts]
        )
        return replace(self, impact_spectra=self.spectrum(impact_torques))._remove_torque(
            impact_torque_nm, impact_torque_in_gaps_nm
        )

    def _remove_torque(
        self, torque_nm: NDArray[np.float64] | float, torque_in_gaps_nm: NDArray[np.float64] | float
    ) -> Comparison:
        """Return the comparison with a torque in N·m subtracted from the measured torque.

        `torque_nm` is that at the retained samples, and `torque_in_gaps_nm` that at the ticks at
        which the torque was not measured.
        """
        remaining_torque_nm = self.torque_nm.copy()
        remaining_torque_nm[self.retained_samples] -= torque_nm
        return replace(
            self,
            torque_nm=remaining_torque_nm,
            removed_torque_nm=self.removed_torque_nm + torque_nm,
            removed_torque_in_gaps_nm=self.removed_torque_in_gaps_nm + torque_in_gaps_nm,
        )

    def times_s(self) -> NDArray[np.float64]:
        """Return the times of the compared samples since the record's first tick, (samples,)."""
        return self.first_sample_s + np.arange(self.sample_count) / self.decimation.rate_hz

    @property
    def first_sample_s(self) -> float:
        """Return the time in seconds from the record's first tick to the first compared sample."""
        return (
            float(self.retained_samples.start - self.decimation.half_length_samples)
            / self.decimation.rate_hz
        )

    @property
    def is_long(self) -> bool:
        """Return whether the record has so many bins that few results of them may be stored."""
        return self.frequency_hz.size > MAX_BINS_OF_STORED_RESULTS

    @property
    def sample_count(self) -> int:
        """Return the number of compared time samples, at the decimated rate."""
        return int(self.retained_samples.stop - self.retained_samples.start)

    def poles(self, plant: Plant, gradient_parameters: Sequence[str] = ()) -> tuple[Pole, ...]:
        """Return the poles of a plant's visible modes, whose free decay is projected out.

        Parameters
        ----------
        plant : Plant
            Plant with the poles.
        gradient_parameters : sequence of str
            Parameters with respect to which the poles are differentiated, as for `mode_poles`.
        """
        poles = plant.mode_poles(
            self.visible_mode_count, gradient_parameters, self.last_poles_rad_s
        )
        self.last_poles_rad_s[:] = [pole.at_rad_s for pole in poles]
        return poles

    def spectrum(self, time_series: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Transform time series of the retained samples to spectra in the band.

        The shape changes from (..., samples) to (..., K).
        """
        return np.fft.rfft(time_series)[..., self.band_bins]

    def band_spectrum(self, time_series: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Transform time series of all samples to spectra in the band, as `spectrum` does."""
        return self.spectrum(time_series[..., self.retained_samples])

    def encoder_noise_power(self, plant: Plant | ModalModel) -> NDArray[np.float64]:
        """Return the power of the torque that the rounding of the angle adds to the residual, (K,).

        At a sharp resonance it exceeds the noise of the torque, in a band narrower than the blocks
        in which that is estimated. The rounding of a moving encoder is white noise with a variance
        of a twelfth of the squared step (B. Widrow, IRE Trans. Circuit Theory 3 (1956) 266-276).

        Parameters
        ----------
        plant : Plant or ModalModel
            Current estimate.
        """
        if not self.encoder_step_rad:
            return np.zeros(self.frequency_hz.size)
        s = 2j * np.pi * self.frequency_hz
        response = (
            ResponseGrid(s).evaluate(plant)[0] if isinstance(plant, Plant) else plant.response(s)
        )
        angle_variance_rad2 = self.encoder_step_rad**2 / 12
        decimated_fraction = self.decimation.rate_hz / self.measurement.rate_hz
        return np.abs(response) ** 2 * angle_variance_rad2 * self.sample_count * decimated_fraction

    def to_time_series(self, spectrum: NDArray[np.complex128]) -> NDArray[np.float64]:
        """Transform a spectrum in the band, shape (K,), to the time series of retained samples.

        The result has the shape (samples,).
        """
        full_spectrum = np.zeros(self.sample_count // 2 + 1, dtype=np.complex128)
        full_spectrum[self.band_bins] = spectrum
        return np.fft.irfft(full_spectrum, self.sample_count)

    def reference_coherent_angle_rad(self) -> NDArray[np.float64]:
        """Return the part of the motor angle in rad that is coherent with the reference, (m,).

        The reference is the angle that the motor's controller was to follow. The whole angle is
        returned if there is no reference, or if the reference does not explain the angle.
        """
        if self.measurement.reference_rad is None:
            return self.angle_rad
        coherent_angle_rad = self._coherent_angle_rad(self.angle_rad)
        # The speeds are compared, since a slow drift of the angle does not disturb the estimate.
        angle_power, incoherent_power = (
            np.sum(np.diff(angle_rad[self.retained_samples]) ** 2)
            for angle_rad in (self.angle_rad, self.angle_rad - coherent_angle_rad)
        )
        return (
            coherent_angle_rad
            if incoherent_power < _MAX_INCOHERENT_SPEED_FRACTION * angle_power
            else self.angle_rad
        )

    def _coherent_angle_rad(
        self, angle_rad: NDArray[np.float64], torque_nm: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Return the part of an angle in rad coherent with the controller's reference, shape (m,).

        With a torque, the part of the angle that follows the torque is included.
        """
        reference_rad = self.measurement.reference_rad
        assert reference_rad is not None
        # The samples after the record are the filter's response to its end; none is compared.
        recorded_samples = self._recorded_samples
        reference_rad = self.decimation.apply(reference_rad - reference_rad[0])[:recorded_samples]
        coherent_angle_rad = angle_rad.copy()
        coherent_angle_rad[:recorded_samples] = reference_coherent_angle(
            angle_rad[:recorded_samples], reference_rad, self.decimation.rate_hz, torque_nm
        )
        return coherent_angle_rad

    @property
    def _recorded_samples(self) -> int:
        """Return the number of decimated samples up to the end of the record."""
        return int(self.decimation.samples_inside_record(self.measurement.angle_rad.size).stop)

    def use_reference_coherent_angle(self, plant: Plant | ModalModel) -> Comparison:
        """Return a comparison whose input is the part of the angle coherent with the reference.

        The reference of the motor's controller thus is an instrumental variable. The torque caused
        by the incoherent part of the angle is removed.

        Parameters
        ----------
        plant : Plant
            Current estimate. Its error increases the noise and causes no bias.

        Returns
        -------
        Comparison
            `self` if the whole angle is coherent: see `reference_coherent_angle_rad`.
        """
        coherent_angle_rad = self.reference_coherent_angle_rad()
        if coherent_angle_rad is self.angle_rad:
            return self
        return self._use_coherent_angle(self.angle_rad, coherent_angle_rad, plant)

    def use_whole_angle(self) -> Comparison:
        """Return a comparison whose input is the whole angle.

        The torque of the part that is incoherent with the reference is added again.
        """
        if not isinstance(self.incoherent_angle_rad, np.ndarray):
            return self
        angle_rad = self.angle_rad + self.incoherent_angle_rad
        return replace(
            self,
            angle_rad=angle_rad,
            torque_predictor=self.torque_predictor.with_angle(angle_rad),
            incoherent_angle_rad=0.0,
            incoherent_torque_nm=0.0,
            incoherent_torque_in_gaps_nm=0.0,
        )._remove_torque(-self.incoherent_torque_nm, -self.incoherent_torque_in_gaps_nm)

    def _use_coherent_angle(
        self,
        angle_rad: NDArray[np.float64],
        coherent_angle_rad: NDArray[np.float64],
        plant: Plant | ModalModel,
    ) -> Comparison:
        """Return a comparison whose input is the reference-coherent part of the angle.

        The torque that a plant predicts from the remaining part is subtracted.
        """
        return replace(
            self,
            angle_rad=coherent_angle_rad,
            torque_predictor=self.torque_predictor.with_angle(coherent_angle_rad),
            incoherent_angle_rad=angle_rad - coherent_angle_rad,
        ).recompute_incoherent_torque(plant)

    def recompute_incoherent_torque(self, plant: Plant | ModalModel) -> Comparison:
        """Return the comparison with the torque of the incoherent angle predicted by `plant`.

        This torque is subtracted from the measured torque, instead of an earlier prediction. The
        incoherent angle is the part that does not follow the reference of the motor's controller.
        Return `self` if the whole angle is coherent with the reference.
        """
        if not isinstance(self.incoherent_angle_rad, np.ndarray):
            return self
        incoherent_torque_predictor = self.torque_predictor.with_angle(self.incoherent_angle_rad)
        incoherent_torque_nm = incoherent_torque_predictor.torque(plant)[0]
        incoherent_torque_in_gaps_nm = incoherent_torque_predictor.torque_at_fine_samples(
            plant,
            self.decimation.downsampling_factor,
            self._decimated_indices(~self.measurement.torque_known),
        )[0]
        updated_comparison = replace(
            self,
            incoherent_torque_nm=incoherent_torque_nm,
            incoherent_torque_in_gaps_nm=incoherent_torque_in_gaps_nm,
        )
        return updated_comparison._remove_torque(
            incoherent_torque_nm - self.incoherent_torque_nm,
            incoherent_torque_in_gaps_nm - self.incoherent_torque_in_gaps_nm,
        )

    def with_reestimated_angle(self, plant: Plant | ModalModel, noise: NoiseSpectrum) -> Comparison:
        """Return the comparison with the reference-coherent angle estimated with a better plant.

        Parameters
        ----------
        plant : Plant
            Plant fitted to this comparison.
        noise : NoiseSpectrum
            Noise under which the plant was fitted.

        Returns
        -------
        Comparison
            `self` if the new torque of the incoherent part would move no parameter by more than a
            third of its standard deviation.
        """
        updated_comparison = self.recompute_incoherent_torque(plant)
        if updated_comparison is self:
            return self
        whitened_torque_change = (
            self.spectrum(
                updated_comparison.incoherent_torque_nm - np.asarray(self.incoherent_torque_nm)
            )
            * noise.weight
        )
        if (
            np.vdot(whitened_torque_change, whitened_torque_change).real
            <= _MAX_REMOVED_TORQUE_CHANGE
        ):
            return self
        whole_angle_rad, coherent_angle_rad = (
            self.angle_rad + self.incoherent_angle_rad,
            self.angle_rad,
        )
        coherent_torque_predictor = TorquePredictor(
            coherent_angle_rad, self.decimation.rate_hz, slice(0, self._recorded_samples)
        )
        # The torque of a ringing beam moves the motor, and that motion changes the ringing.
        for _ in range(_ANGLE_FEEDBACK_ITERATIONS):
            torque_nm = coherent_torque_predictor.with_angle(coherent_angle_rad).torque(plant)[0]
            coherent_angle_rad = self._coherent_angle_rad(whole_angle_rad, torque_nm)
        return self._use_coherent_angle(whole_angle_rad, coherent_angle_rad, plant)

    @property
    def hum_nm(self) -> NDArray[np.float64] | float:
        """Return the removed hum torque in N·m at the retained samples; 0 if there is no hum."""
        return self._hum_torque_at(np.arange(self.sample_count) / self.decimation.rate_hz)

    def remove_hum(self, hum: tuple[Hum, ...]) -> Comparison:
        """Return the comparison with only the given hum subtracted from the torque.

        Hum that was subtracted before is added again.
        """
        comparison_with_new_hum = replace(self, hum=hum)
        unknown_torque_indices = self._decimated_indices(~self.measurement.torque_known)
        first_sample_s = self.retained_samples.start / self.decimation.rate_hz
        unknown_torque_times_s = unknown_torque_indices / self.measurement.rate_hz - first_sample_s
        return comparison_with_new_hum._remove_torque(
            comparison_with_new_hum.hum_nm - self.hum_nm,
            comparison_with_new_hum._hum_torque_at(unknown_torque_times_s)
            - self._hum_torque_at(unknown_torque_times_s),
        )

    def drag_response(
        self, plant: Plant, measured_modes: ModalEstimate | None = None
    ) -> DragResponse:
        """Return the response of a beam in air to the motion of the record.

        Parameters
        ----------
        plant : Plant
            Beam on which the drag acts.
        measured_modes : ModalEstimate, optional
            Modes whose poles and phases replace those of the plant, as for `DragResponse`.
        """
        # Drag acts on the whole motion, whether or not it follows the reference.
        angle_rad = self.angle_rad + self.incoherent_angle_rad
        return DragResponse(angle_rad, self.decimation.rate_hz, plant, measured_modes)

    def remove_drag_torque(
        self, plant: Plant, law: DragLaw, measured_modes: ModalEstimate | None = None
    ) -> Comparison:
        """Return the comparison without the torque by air drag, with that torque's derivatives.

        Parameters
        ----------
        plant : Plant
            Beam on which the drag acts.
        law : DragLaw
            Drag coefficient as a function of the speed.
        measured_modes : ModalEstimate, optional
            Modes whose poles and phases replace those of the plant, as for `DragResponse`.

        Raises
        ------
        DragError
            The drag is too large for the time steps.
        """
        drag_response = self.drag_response(plant, measured_modes)
        drag_torque = drag_response.torque(law, range(1, self.visible_mode_count + 1))
        unknown_torque_indices = self._decimated_indices(~self.measurement.torque_known)
        full_rate_drag_torque_nm = np.fft.irfft(
            self.decimation.downsampling_factor * np.fft.rfft(drag_torque.torque_nm),
            self.decimation.downsampling_factor * drag_torque.torque_nm.size,
        )
        return replace(
            self,
            torque_nm=self.torque_nm - drag_torque.torque_nm,
            removed_torque_nm=self.removed_torque_nm + drag_torque.torque_nm[self.retained_samples],
            removed_torque_in_gaps_nm=self.removed_torque_in_gaps_nm
            + full_rate_drag_torque_nm[unknown_torque_indices],
            drag=DragExpansion(
                plant=plant,
                law=law,
                response=drag_response,
                band_spectrum=self.band_spectrum,
                pole_derivatives={
                    mode_number: self.band_spectrum(derivative_rows)
                    for mode_number, derivative_rows in drag_torque.pole_derivatives.items()
                },
                external_damping_derivatives=self.band_spectrum(
                    drag_torque.external_damping_derivatives
                ),
                ln_density_derivative=self.band_spectrum(drag_torque.ln_density_derivative),
                delay_derivative=self.band_spectrum(drag_torque.delay_derivative),
                law_derivatives=self.band_spectrum(drag_torque.law_derivatives),
                mean_speed_m_s=drag_torque.mean_speed_m_s,
                top_speed_m_s=drag_torque.top_speed_m_s,
            ),
        )

    def _hum_torque_at(self, time_s: NDArray[np.float64]) -> NDArray[np.float64] | float:
        """Return the torque of the removed hum in N·m at times since the first compared sample."""
        return sum((hum.torque(time_s) for hum in self.hum), start=0.0)

    def nuisance_spectra(
        self, poles: Sequence[Pole], effect_spectra: NDArray[np.complex128]
    ) -> NDArray[np.complex128]:
        """Return the spectra of disturbing torques with unknown amplitudes, shape (m, K).

        They are, in this order, the free decays from the beginning and from each long gap, hum,
        impacts, a linear drift of the torque sensor's zero, and the given effects. Without the
        drift, the step from the end of the record to its beginning would leak into all bins.

        Parameters
        ----------
        poles : sequence of Pole
            Poles of the free decays.
        effect_spectra : ndarray of complex, shape (c, K)
            Torque spectra of effects of unknown size.
        """
        hum_spectra = self.decay_spectra.hum([hum_spectra.frequency_hz for hum_spectra in self.hum])
        drift_spectrum = _drift_spectrum(self.sample_count)[None, self.band_bins]
        impact_spectra = drift_spectrum[:0] if self.impact_spectra is None else self.impact_spectra
        decay_columns = [
            decay_group.spectra(poles)
            for decay_group in (self.decay_spectra, *self.later_decay_spectra)
        ]
        return np.concatenate(
            [*decay_columns, hum_spectra, impact_spectra, drift_spectrum, effect_spectra]
        )

    def decay_gradient(
        self, poles: Sequence[Pole], amplitudes: NDArray[np.float64]
    ) -> NDArray[np.complex128]:
        """Return the derivatives of the free decays' spectrum by the parameters of the poles.

        The spectrum is the part of ``amplitudes @ nuisance_spectra(poles)`` that belongs to free
        decays. The amplitudes are held constant.

        Parameters
        ----------
        poles : sequence of Pole
            Poles with their derivatives by k parameters.
        amplitudes : ndarray, shape (m,)
            Amplitudes of the spectra that `nuisance_spectra` returns.

        Returns
        -------
        ndarray of complex, shape (k, K)
        """
        (first_decays, first_amplitudes), *later_groups = self._decay_groups(poles, amplitudes)
        total_gradient = first_decays.gradient(poles, first_amplitudes)
        for later_decays, later_amplitudes in later_groups:
            total_gradient += later_decays.gradient(poles, later_amplitudes)
        return total_gradient

    def _decay_groups(
        self, poles: Sequence[Pole], amplitudes: NDArray[np.float64]
    ) -> Iterator[tuple[DecaySpectra, NDArray[np.float64]]]:
        """Yield the decays from the beginning and from each long gap, with their amplitudes.

        `amplitudes`, shape (m,), are those of the spectra that `nuisance_spectra` returns.
        """
        group_size = count_decay_spectra(poles)
        for group_number, decays in enumerate((self.decay_spectra, *self.later_decay_spectra)):
            first_amplitude = group_number * group_size
            yield decays, amplitudes[first_amplitude : first_amplitude + group_size]

    def fill_unknown_torque(
        self,
        plant: Plant | ModalModel,
        poles: Sequence[Pole],
        amplitudes: NDArray[np.float64],
    ) -> Comparison:
        """Return the comparison with unmeasured torque filled by a plant's prediction.

        The residual at the filled ticks then is 0. After convergence of the fit, the cost has the
        same minimum as the cost of the known samples alone.

        Parameters
        ----------
        plant : Plant or ModalModel
            Current estimate.
        poles : sequence of Pole
            Poles of the free decays, which continue in a gap.
        amplitudes : ndarray, shape (m,)
            Amplitudes of the spectra that `nuisance_spectra` returns.
        """
        is_torque_known = self.measurement.torque_known
        if is_torque_known.all():
            return self
        unknown_ticks = np.flatnonzero(~is_torque_known)
        unknown_times_s = unknown_ticks / self.measurement.rate_hz - self.first_sample_s
        decay_torque_nm = np.zeros(unknown_ticks.size)
        for decays, decay_amplitudes in self._decay_groups(poles, amplitudes):
            decay_torque_nm += decays.torque_at(unknown_times_s, poles, decay_amplitudes)
        filled_torque_nm = self.measurement.torque_nm.copy()
        filled_torque_nm[unknown_ticks] = (
            self.removed_torque_in_gaps_nm
            + decay_torque_nm
            + self.torque_predictor.torque_at_fine_samples(
                plant,
                self.decimation.downsampling_factor,
                self._decimated_indices(~is_torque_known),
            )[0]
        )
        decimated_torque_nm = self.decimation.apply(filled_torque_nm)
        decimated_torque_nm[self.retained_samples] -= self.removed_torque_nm
        return replace(self, torque_nm=decimated_torque_nm)

    def gradient_at_unknown_torque(
        self, plant: Plant, gradient_parameters: tuple[str, ...]
    ) -> NDArray[np.complex128]:
        """Return the spectra of the predicted torque's derivatives at unmeasured ticks, (k, K).

        All other ticks, those with a measured torque, contribute 0.

        Parameters
        ----------
        plant : Plant
            Beam and rig.
        gradient_parameters : tuple of str
            Names of the k parameters with respect to which the torque is differentiated.
        """
        is_torque_unknown = ~self.measurement.torque_known
        unknown_gradient = np.zeros(
            (len(gradient_parameters), self.frequency_hz.size), dtype=np.complex128
        )
        if is_torque_unknown.any():
            _, gradient = self.torque_predictor.torque_at_fine_samples(
                plant,
                self.decimation.downsampling_factor,
                self._decimated_indices(is_torque_unknown),
                gradient_parameters,
            )
            for spectrum_row, derivative_nm in zip(unknown_gradient, gradient, strict=True):
                derivative_at_ticks_nm = np.zeros(is_torque_unknown.size)
                derivative_at_ticks_nm[is_torque_unknown] = derivative_nm
                spectrum_row[:] = self.spectrum(
                    self.decimation.apply(derivative_at_ticks_nm)[self.retained_samples]
                )
        return unknown_gradient

    def _decimated_indices(self, is_selected_tick: NDArray[np.bool_]) -> NDArray[np.intp]:
        """Return the full-rate indices of marked ticks, counted from the first decimated sample.

        `is_selected_tick` is a mask over the ticks of the record.
        """
        return (
            np.flatnonzero(is_selected_tick)
            + self.decimation.half_length_samples * self.decimation.downsampling_factor
        )


@lru_cache(maxsize=2)
def _drift_spectrum(sample_count: int) -> NDArray[np.complex128]:
    """Return the spectrum of a linear drift from -0.5 to 0.5 over all samples.

    The array is cached and read-only.
    """
    spectrum: NDArray[np.complex128] = np.fft.rfft(np.linspace(-0.5, 0.5, sample_count))
    spectrum.flags.writeable = False
    return spectrum
