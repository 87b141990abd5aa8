"""What is compared: a measured H1, and the model's torque for the same angle sent through H1."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify import Decimation, Prediction
from analysis.models import weights
from analysis.welch_aware.estimator import WelchAwareError, WelchEstimator, bins_of
from rigd.beam import undamped_frequencies_rad_s
from rigd.spectral import segment_count

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from analysis.identify import Plant
    from analysis.models import Weighting
    from rigd.beam import Beam
    from rigd.spectral import Segmentation

_MARGIN: Final = 1.1
"""Highest frequency predicted, relative to the highest compared: what lies just beyond the band
leaks into it through the window."""

_WIDEST_BAND: Final = 0.4
"""Highest frequency predicted, relative to the rate."""


_REST: Final = 0.5
"""Zeros after the angle, in parts of its length."""

_MODES: Final = 50
"""More than any band holds."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """One measured response, ready to be compared with any plant.

    Attributes
    ----------
    prediction : Prediction
        Of the band, at a lower rate.
    rate_hz : float
        Of the record.
    factor : int
        The record's rate over that rate.
    places : ndarray of int, shape (n,)
        The samples that were divided into segments, from the prediction's first one on.
    estimator : WelchEstimator
    measured : ndarray of complex, shape (K,)
    weights : ndarray, shape (K,)
        Of sum 1.
    """

    prediction: Prediction
    rate_hz: float
    factor: int
    places: NDArray[np.intp]
    estimator: WelchEstimator
    measured: NDArray[np.complex128]
    weights: NDArray[np.float64]

    @property
    def frequency_hz(self) -> NDArray[np.float64]:
        """Frequencies compared, shape (K,)."""
        step_hz = self.rate_hz / self.estimator.nfft
        return np.asarray(step_hz * self.estimator.bins, dtype=np.float64)

    def visible_modes(self, beam: Beam) -> int:
        """Modes of a beam up to the highest frequency compared."""
        natural = undamped_frequencies_rad_s(beam, _MODES)
        return int(np.sum(natural < 2 * np.pi * self.frequency_hz[-1]))

    def response(
        self, plant: Plant, wrt: Sequence[str] = ()
    ) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """H1 of the predicted torque, shape (K,), and its derivatives, shape (k, K)."""
        torque, gradient = self.prediction.torque_between(plant, self.factor, self.places, wrt)
        return self.estimator.response(torque), self.estimator.response(gradient)


@dataclass(frozen=True, slots=True)
class Measured:
    """A response with all that is known of how it was estimated; see `fit_welch_aware`."""

    angle_rad: NDArray[np.float64]
    rate_hz: float
    frequency_hz: NDArray[np.float64]
    response: NDArray[np.complex128]
    segmentation: Segmentation
    window: str
    estimated_from: slice
    reference_rad: NDArray[np.float64] | None = None

    def check(self) -> None:
        """Refuse what cannot be used.

        Raises
        ------
        WelchAwareError
            Saying what, and what to do.
        """
        if self.frequency_hz.ndim != 1 or self.frequency_hz.shape != self.response.shape:
            raise WelchAwareError(
                "Give one value of the response for each frequency; their shapes are "
                f"{self.response.shape} and {self.frequency_hz.shape}."
            )
        if not self.frequency_hz.size or not np.isfinite(self.response).all():
            raise WelchAwareError(
                "The response is empty or not finite; leave out frequencies without a value."
            )
        highest_hz = _WIDEST_BAND * self.rate_hz
        if self.frequency_hz[-1] > highest_hz:
            raise WelchAwareError(
                f"The response reaches {self.frequency_hz[-1]:g} Hz, but of an angle sampled at "
                f"{self.rate_hz:g} Hz only what is below {highest_hz:g} Hz is predicted; "
                "leave out the frequencies above."
            )
        if not np.isfinite(self.angle_rad).all() or np.ptp(self.angle_rad) == 0:
            raise WelchAwareError(
                "The angle must be finite at every sample, and move; fill gaps before."
            )
        if self.reference_rad is not None and self.reference_rad.shape != self.angle_rad.shape:
            raise WelchAwareError(
                "Give one value of the reference for each of the angle; their shapes are "
                f"{self.reference_rad.shape} and {self.angle_rad.shape}."
            )
        samples = len(range(self.angle_rad.size)[self.estimated_from])
        length, overlap = self.segmentation.segment_length, self.segmentation.overlap
        if segment_count(samples, length, overlap) == 0:
            raise WelchAwareError(
                f"The angle has {samples} samples where the response was estimated, fewer than "
                f"one Welch segment of {length}; give the angle and the segments of the estimate."
            )

    def comparison(self, weighting: Weighting) -> Comparison:
        """Prepare the comparison at as many bins as the segments' length tells apart.

        Zero padding puts the bins closer than that; the ones between repeat what their neighbours
        say, and cost as much.
        """
        bins = bins_of(self.frequency_hz, self.rate_hz, self.segmentation)
        stride = _stride(bins, self.segmentation)
        kept = bins % stride == 0
        every = weights(2 * np.pi * self.frequency_hz, weighting)[kept]
        decimation = Decimation.to_band(
            self.rate_hz, min(_MARGIN * self.frequency_hz[-1], _WIDEST_BAND * self.rate_hz)
        )
        return Comparison(
            prediction=Prediction(self._followed_by_rest(decimation), decimation.rate_hz, slice(0)),
            rate_hz=self.rate_hz,
            factor=decimation.factor,
            places=np.arange(self.angle_rad.size)[self.estimated_from]
            + decimation.reach * decimation.factor,
            estimator=WelchEstimator(
                self.angle_rad[self.estimated_from],
                replace(self.segmentation, nfft=self.segmentation.nfft // stride),
                bins[kept] // stride,
                self.window,
                self._instrument,
            ),
            measured=self.response[kept],
            weights=every / every.sum(),
        )

    @property
    def _instrument(self) -> NDArray[np.float64] | None:
        """Reference where the response was estimated, if with it."""
        return None if self.reference_rad is None else self.reference_rad[self.estimated_from]

    def _followed_by_rest(self, decimation: Decimation) -> NDArray[np.float64]:
        """Angle at the lower rate with zeros after it, in which the beam's ringing dies.

        The whole record's estimator takes out every free decay, and with them what a finite
        transform wraps round; here that would count.
        """
        angle = decimation.apply(self.angle_rad)
        return np.pad(angle, (0, round(_REST * angle.size)))

    def whole(self, comparison: Comparison, weights: NDArray[np.float64]) -> Comparison:
        """Compare at every frequency."""
        bins = bins_of(self.frequency_hz, self.rate_hz, self.segmentation)
        return replace(
            comparison,
            estimator=WelchEstimator(
                self.angle_rad[self.estimated_from],
                self.segmentation,
                bins,
                self.window,
                self._instrument,
            ),
            measured=self.response,
            weights=weights,
        )


def _stride(bins: NDArray[np.intp], segmentation: Segmentation) -> int:
    """Largest stride over the grid that keeps enough bins, and whose transform holds a segment."""
    length, nfft = segmentation.segment_length, segmentation.nfft
    independent = int(bins[-1] - bins[0]) * length / nfft
    for stride in range(nfft // length, 1, -1):
        enough = np.count_nonzero(bins % stride == 0) >= min(independent, bins.size)
        if nfft % stride == 0 and enough:
            return stride
    return 1
