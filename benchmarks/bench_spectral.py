"""Welch's estimate with the paper's settings against scipy.signal, on the same record."""

import argparse

import numpy as np
import scipy.signal
from gate import Gate, Row
from timing import least_in_turn_s

from rigd.spectral import (
    Segmentation,
    fft_response,
    welch_response,
)

RATE_HZ = 1000.0
PAPER = Segmentation()
REPEATS = 15
ROWS = (
    # Measured 0.22 to 0.37, and 0.01 to 0.02.
    Row("Welch's estimate", most=0.7, unit="times scipy's csd and 2 welch"),
    Row("estimate without averaging", most=0.06, unit="times scipy's csd and 2 welch"),
    # Measured 3e-15.
    Row("difference of H1 from scipy's", most=1e-12, unit="relative"),
)


def main() -> None:
    """Print times, ratios and the largest difference, and check the limits."""
    gate = Gate(ROWS, argparse.ArgumentParser(description=__doc__))
    rng = np.random.default_rng(1)
    x = rng.normal(size=120_000)
    y = np.convolve(x, [0.1, 0.4, -0.3])[: x.size] + 0.1 * rng.normal(size=x.size)
    options = {
        "fs": RATE_HZ,
        "window": scipy.signal.windows.hamming(PAPER.segment_length, sym=True),
        "nperseg": PAPER.segment_length,
        "noverlap": PAPER.overlap,
        "nfft": PAPER.nfft,
        "detrend": False,
    }

    def peer() -> tuple[np.ndarray, np.ndarray]:
        """Return H1 and coherence by scipy."""
        sxy = scipy.signal.csd(x, y, **options)[1]
        sxx = scipy.signal.welch(x, **options)[1]
        syy = scipy.signal.welch(y, **options)[1]
        return sxy / sxx, np.abs(sxy) ** 2 / (sxx * syy)

    ours, theirs, whole = least_in_turn_s(
        REPEATS,
        lambda: welch_response(x, y, RATE_HZ),
        peer,
        lambda: fft_response(x, y, RATE_HZ, PAPER.nfft),
    )
    difference = np.abs(welch_response(x, y, RATE_HZ).response / peer()[0] - 1)[1:-1].max()
    print(f"Best of {REPEATS}, 120 000 samples, 8 segments of 17 266 padded to 160 000")
    print(f"welch_response {ours * 1e3:.1f} ms, scipy {theirs * 1e3:.1f} ms")
    gate.measured("Welch's estimate", ours / theirs)
    gate.measured("estimate without averaging", whole / theirs)
    gate.measured("difference of H1 from scipy's", difference)
    gate.finish()


if __name__ == "__main__":
    main()
