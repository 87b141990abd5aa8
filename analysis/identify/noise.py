"""Noise spectrum of the torque, from the residual of a fit: smooth, and narrow-band lines.

The spectrum is smoothed by medians over blocks of bins. The residual of a wrong model at a mode, or
a hum at one frequency, does not raise a median. A line is a group of bins far above the smooth
spectrum that lasts through the whole record.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_BLOCK_COUNT: Final = 24
"""Number of blocks of the smooth spectrum, if all have at least `_MIN_BLOCK_BINS` bins."""

_MIN_BLOCK_BINS: Final = 40
"""Smallest number of bins in a block."""

_NARROW_BLOCK_BINS: Final = 60
"""Number of bins in a narrow block."""

_PEAK_BINS: Final = 12
"""Number of bins over which the power of a narrow peak is averaged."""

_PEAK_POWER_RATIO: Final = 2.4
"""Mean power over `_PEAK_BINS` bins, relative to the smooth power, that chance exceeds in one
record of a hundred."""

_MEDIAN_TO_MEAN_POWER_RATIO: Final = float(np.log(2.0))
"""Median over mean of an exponentially distributed power."""

_LINE_POWER_RATIO: Final = 20.0
"""Power over that of the noise from which a bin is significant. Chance exceeds it once in 5e8
bins."""

_LINE_SURROUNDING_BINS: Final = 16
"""Number of bins to either side of a line that resolve its duration: parts of 1/32 of the
record."""

_RECORD_PART_COUNT: Final = 8
"""Number of parts of the record in which the power of a line is compared."""

_MIN_PART_POWER_RATIO: Final = 0.3
"""Smallest power in any eighth of the record, relative to the mean, of a line that lasts."""

_MIN_LINE_TO_PREDICTION_RATIO: Final = 3.0
"""Minimum amplitude of a line relative to the predicted torque, at a frequency at which the motor
moves through the whole record, as with a multisine. The residual of a wrong model is smaller."""

_COMPARED_PREDICTION_RATIO: Final = 1.1
"""Largest ratio of a frequency whose predicted torque is compared with a line to that of the line.
At the frequency itself, a wrong model may predict no torque."""


@dataclass(frozen=True, slots=True)
class NoiseLine:
    """Sinusoidal disturbance of the torque, through the whole record, not caused by the motor."""

    frequency_hz: float
    """Frequency of the sinusoid in hertz."""
    amplitude_nm: float
    """Amplitude of the sinusoid in N·m."""


@dataclass(frozen=True, slots=True)
class Hum:
    """Narrow-band disturbance: a sinusoid in the torque.

    Attributes
    ----------
    frequency_hz : float
        Frequency of the sinusoid.
    phasor_nm : complex
        The torque is the real part of ``phasor_nm exp(2j pi frequency_hz t)``, with the time t
        since the first compared sample.
    """

    frequency_hz: float
    phasor_nm: complex

    @property
    def line(self) -> NoiseLine:
        """Return frequency in Hz and amplitude in N·m of the hum, as a line of the noise."""
        return NoiseLine(self.frequency_hz, float(abs(self.phasor_nm)))

    def torque(self, time_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the torque of the hum in N·m at given times since the first compared sample."""
        phase_rotation = np.exp(2j * np.pi * self.frequency_hz * time_s)
        torque_nm: NDArray[np.float64] = (self.phasor_nm * phase_rotation).real
        return torque_nm


@dataclass(frozen=True, slots=True)
class NoiseSpectrum:
    """Noise spectrum of the torque, as estimated from the residual of a fit.

    Attributes
    ----------
    power : ndarray, shape (K,)
        Expected ``|residual|²`` of each bin.
    is_compared : ndarray of bool, shape (K,)
        True for bins that are compared, False at the lines.
    lines : tuple of NoiseLine
        Narrow-band disturbances, which are not part of `power`.
    """

    power: NDArray[np.float64]
    is_compared: NDArray[np.bool_]
    lines: tuple[NoiseLine, ...]

    @property
    def weight(self) -> NDArray[np.float64]:
        """Return the factor of each bin that whitens the residual, 0 at the lines, shape (K,).

        Real and imaginary parts of the whitened noise have variance 1.
        """
        whitening_factor: NDArray[np.float64] = np.sqrt(2 / self.power) * self.is_compared
        return whitening_factor


def estimate_noise(
    residual: NDArray[np.complex128],
    frequency_hz: NDArray[np.float64],
    sample_count: int,
    known_torque_fraction: float = 1.0,
    is_near_mode: NDArray[np.bool_] | None = None,
    driven_spectra: tuple[NDArray[np.complex128], NDArray[np.complex128]] | None = None,
) -> NoiseSpectrum:
    """Estimate the noise spectrum and its lines from the residual of a fit.

    Parameters
    ----------
    residual : ndarray of complex, shape (K,)
        Fourier transform of `sample_count` samples in N·m, on neighbouring bins.
    frequency_hz : ndarray, shape (K,)
        Frequencies of the bins.
    sample_count : int
        Number of samples of the residual.
    known_torque_fraction : float
        Fraction of the samples at which the residual is known. It is 0 at the others.
    is_near_mode : ndarray of bool, shape (K,), optional
        True for bins near a mode, which are never excluded: an excluded resonance is not fitted,
        and would therefore always appear as a line. Without this argument no line is searched for.
    driven_spectra : tuple of ndarray of complex, shape (K,), optional
        Fourier transforms of the motor's angle and of the torque that the model predicts. Where the
        motion lasts through the record, a line is excluded only if it is much larger than the
        predicted torque: otherwise it may be the error of the model.

    Returns
    -------
    NoiseSpectrum
        Smooth power and lines.
    """
    noise_power = smooth_power(residual) / known_torque_fraction
    is_compared = np.ones(noise_power.size, dtype=bool)
    noise_lines: list[NoiseLine] = []
    if is_near_mode is None:
        return NoiseSpectrum(noise_power, is_compared, ())
    for line_bins in _find_line_groups(residual, noise_power):
        line_power = np.abs(residual[line_bins]) ** 2
        if (
            is_near_mode[line_bins][np.argmax(line_power)]
            or not _lasts_through_record(residual, line_bins)
            or (
                driven_spectra is not None
                and _may_be_model_error(residual, *driven_spectra, frequency_hz, line_bins)
            )
        ):
            continue
        is_compared[line_bins] &= is_near_mode[line_bins]
        noise_lines.append(
            NoiseLine(
                frequency_hz=float(line_power @ frequency_hz[line_bins] / line_power.sum()),
                amplitude_nm=float(
                    2 * np.sqrt(line_power.sum()) / (sample_count * known_torque_fraction)
                ),
            )
        )
    return NoiseSpectrum(noise_power, is_compared, tuple(noise_lines))


def smooth_power(
    residual: NDArray[np.complex128], *, has_narrow_blocks: bool = False
) -> NDArray[np.float64]:
    """Return the smooth power ``|residual|²`` of a residual spectrum, shape (K,).

    The power of noise in one bin is exponentially distributed, so its mean is the median over ln 2.
    The median of a block ignores the residual of a wrong model at a mode, and a hum at one
    frequency, which are not noise. The logarithm is interpolated between block centres. Blocks are
    narrower at low frequency, where drift makes the spectrum steep.

    Parameters
    ----------
    residual : ndarray of complex, shape (K,)
        Spectrum of the residual on neighbouring bins.
    has_narrow_blocks : bool
        Whether all blocks are narrow. Narrow blocks follow a peak of the noise.
    """
    bin_power = residual.real**2 + residual.imag**2
    block_edges = (
        _narrow_block_borders(bin_power.size)
        if has_narrow_blocks
        else _block_borders(bin_power.size)
    )
    ln_power = np.array(
        [
            np.log(
                max(float(np.median(bin_power[a:b])), np.finfo(float).tiny)
                / _MEDIAN_TO_MEAN_POWER_RATIO
            )
            for a, b in itertools.pairwise(block_edges)
        ]
    )
    block_centres = (block_edges[:-1] + block_edges[1:] - 1) / 2
    smoothed_power: NDArray[np.float64] = np.exp(
        np.interp(np.arange(bin_power.size), block_centres, ln_power)
    )
    return smoothed_power


def noise_power_with_peaks(
    residual: NDArray[np.complex128],
    smooth_noise_power: NDArray[np.float64],
    is_peak_allowed: NDArray[np.bool_],
    may_peak_continue: NDArray[np.bool_] | None = None,
) -> NDArray[np.float64]:
    """Return the noise power of each bin, with peaks narrower than the smoothing blocks, (K,).

    Parameters
    ----------
    residual : ndarray of complex, shape (K,)
        Spectrum of the residual on neighbouring bins.
    smooth_noise_power : ndarray, shape (K,)
        Smooth power of the residual, as `smooth_power` returns it.
    is_peak_allowed : ndarray of bool, shape (K,)
        True for bins at which a peak is possible.
    may_peak_continue : ndarray of bool, shape (K,), optional
        True for bins to which a peak may continue from a neighbouring bin.
    """
    power_ratio = (residual.real**2 + residual.imag**2) / smooth_noise_power
    local_ratio = np.convolve(power_ratio, np.full(_PEAK_BINS, 1 / _PEAK_BINS), mode="same")
    # Include all bins within the averaging width around each significant one.
    is_peak = (
        np.convolve(local_ratio > _PEAK_POWER_RATIO, np.ones(2 * _PEAK_BINS + 1), mode="same") > 0
    )
    if may_peak_continue is not None:
        is_peak_allowed = is_peak_allowed | _connected_bins(
            is_peak & is_peak_allowed, is_peak & may_peak_continue
        )
    return np.where(
        is_peak & is_peak_allowed,
        smooth_noise_power * np.maximum(local_ratio, 1.0),
        smooth_noise_power,
    )


def _connected_bins(
    is_start: NDArray[np.bool_], may_continue: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return a mask of the start bins and all bins connected to them by `may_continue`, (K,)."""
    is_connected = is_start | may_continue
    run_numbers = np.cumsum(np.diff(is_connected, prepend=False) & is_connected)
    has_start = np.bincount(run_numbers[is_start], minlength=run_numbers[-1] + 1) > 0
    is_connected_to_start: NDArray[np.bool_] = is_connected & has_start[run_numbers]
    return is_connected_to_start


def _block_borders(bin_count: int) -> NDArray[np.intp]:
    """Return the borders of the smoothing blocks, as indices of bins.

    Their widths increase with frequency from `_MIN_BLOCK_BINS`.
    """
    ideal_positions = bin_count * np.linspace(0, 1, _BLOCK_COUNT + 1) ** 2
    block_edges = [0]
    for ideal_position in ideal_positions[1:-1]:
        if (
            ideal_position - block_edges[-1] >= _MIN_BLOCK_BINS
            and bin_count - ideal_position >= _MIN_BLOCK_BINS
        ):
            block_edges.append(round(float(ideal_position)))
    return np.array([*block_edges, bin_count])


def _narrow_block_borders(bin_count: int) -> NDArray[np.intp]:
    """Return the borders of equal smoothing blocks, as indices of bins.

    A block has `_NARROW_BLOCK_BINS` bins or a little more.
    """
    return (
        np.linspace(0, bin_count, max(bin_count // _NARROW_BLOCK_BINS, 1) + 1)
        .round()
        .astype(np.intp)
    )


def _find_line_groups(
    residual: NDArray[np.complex128], noise_power: NDArray[np.float64]
) -> list[slice]:
    """Return the ranges of bins whose power is far above the noise, with neighbouring bins.

    A line leaks into its neighbours as 1 / distance: at three times the distance at which it is
    significant the leakage is below the noise.
    """
    bins_above_noise = np.flatnonzero(np.abs(residual) ** 2 > _LINE_POWER_RATIO * noise_power)
    if bins_above_noise.size == 0:
        return []
    bin_groups = np.split(
        bins_above_noise,
        np.flatnonzero(np.diff(bins_above_noise) > _LINE_SURROUNDING_BINS // 2) + 1,
    )
    groups_with_skirts = []
    for bin_group in bin_groups:
        first_bin, last_bin = int(bin_group[0]), int(bin_group[-1])
        skirt_bins = max(last_bin - first_bin, 2)
        groups_with_skirts.append(slice(max(first_bin - skirt_bins, 0), last_bin + skirt_bins + 1))
    return groups_with_skirts


def _lasts_through_record(spectrum: NDArray[np.complex128], line_bins: slice) -> bool:
    """Return whether the part of a spectrum in `line_bins` lasts through the whole record.

    The residual of a wrong model at a mode does not: it begins when the sweep passes the mode, and
    decays.
    """
    bins_around = spectrum[
        max(line_bins.start - _LINE_SURROUNDING_BINS, 0) : line_bins.stop + _LINE_SURROUNDING_BINS
    ]
    padded_length = _RECORD_PART_COUNT * (-(-4 * bins_around.size // _RECORD_PART_COUNT))
    power_envelope = np.abs(np.fft.ifft(bins_around, padded_length)) ** 2
    mean_power_of_eighths = power_envelope.reshape(_RECORD_PART_COUNT, -1).mean(axis=1)
    return bool(mean_power_of_eighths.min() > _MIN_PART_POWER_RATIO * mean_power_of_eighths.mean())


def _may_be_model_error(
    residual: NDArray[np.complex128],
    angle: NDArray[np.complex128],
    predicted_torque: NDArray[np.complex128],
    frequency_hz: NDArray[np.float64],
    line_bins: slice,
) -> bool:
    """Return whether a wrong model of a beam that is driven steadily may cause a line."""
    if not _lasts_through_record(angle, line_bins):
        return False
    compared_range_hz = (
        frequency_hz[line_bins.start] / _COMPARED_PREDICTION_RATIO,
        frequency_hz[line_bins][-1] * _COMPARED_PREDICTION_RATIO,
    )
    compared_bins = slice(*np.searchsorted(frequency_hz, compared_range_hz))
    return bool(
        np.abs(residual[line_bins]).max()
        < _MIN_LINE_TO_PREDICTION_RATIO * np.abs(predicted_torque[compared_bins]).max()
    )
