"""Frequency response within a control loop, with the loop's reference as instrument.

A controller that feeds a measured output back lets the sensor's noise move the input. Noise and
input are correlated then, and the estimates that average products of the two take that for
response: H1 by the share that such motion has in the input's power. The reference owes nothing to
the noise, so the cross-spectra with it have it averaged out: P. E. Wellstead, "Non-parametric
methods of system identification", Automatica 17 (1981) 55-69.
"""

import numpy as np
from numpy.typing import ArrayLike

from rigd.spectral.records import checked_records
from rigd.spectral.response import FrequencyResponse, SpectralError
from rigd.spectral.segmentation import PAPER_NFFT, PAPER_OVERLAP, PAPER_SEGMENT_LENGTH
from rigd.spectral.welch import welch_response


def instrumental_response(
    reference: ArrayLike,
    input_: ArrayLike,
    output: ArrayLike,
    rate_hz: float,
    *,
    segment_length: int = PAPER_SEGMENT_LENGTH,
    overlap: int = PAPER_OVERLAP,
    nfft: int = PAPER_NFFT,
    window: str = "hamming",
) -> FrequencyResponse:
    """Frequency response ``Hiv = Sry / Srx`` from input to output.

    Parameters
    ----------
    reference : array_like, shape (n,)
        What the loop was asked for, in any unit and with any delay: both cancel.
    input_, output : array_like, shape (n,)
    rate_hz, segment_length, overlap, nfft, window
        See `rigd.spectral.welch_response`.

    Returns
    -------
    FrequencyResponse
        The coherence is that of reference and output.

    Raises
    ------
    SpectralError
        As `rigd.spectral.welch_response`, and if the reference is 0 throughout.
    """
    checked_records(input_, output, rate_hz)
    if not np.any(reference):
        raise SpectralError(
            "The reference is zero throughout, so nothing followed it; choose another estimator."
        )
    of_input, of_output = (
        welch_response(
            reference, values, rate_hz,
            segment_length=segment_length, overlap=overlap, nfft=nfft, window=window,
        )
        for values in (input_, output)
    )  # fmt: skip
    with np.errstate(divide="ignore", invalid="ignore"):
        response = of_output.response / of_input.response
    return FrequencyResponse(
        frequency_hz=of_output.frequency_hz,
        response=response,
        coherence=of_output.coherence,
        segments=of_output.segments,
        estimator="iv",
    )
