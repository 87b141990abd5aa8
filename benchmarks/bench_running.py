"""Cost of the running frequency response and spectrogram during a sweep of 120 s.

Peers: Welch's estimate of the record so far, recomputed each time; scipy.signal.spectrogram.
"""

import argparse
import time

import numpy as np
import scipy.signal
from gate import Gate, Row
from timing import least_s

from rigd.excitation import chirp
from rigd.spectral import RunningResponse, RunningSpectrogram, welch_response

RATE_HZ = 1000.0
LAST_HZ = 60.0
BLOCK = 50
"""Samples of a block: 20 blocks a second."""
BETWEEN_ESTIMATES = 500
REPEATS = 15
ROWS = (
    # Measured 0.13 to 0.17, and 4.5 to 5.6: scipy transforms the whole record at once.
    Row("running response, an estimate", most=0.3, unit="times welch_response of the whole record"),
    Row("running spectrogram, whole", most=9, unit="times scipy's, not cut at 60 Hz"),
    # Measured 1.5 with other programs running.
    Row("all of it", most=3, unit="% of a core"),
)


def main() -> None:
    """Print times and ratios, and check the limits."""
    gate = Gate(ROWS, argparse.ArgumentParser(description=__doc__))
    excitation = chirp(rate_hz=RATE_HZ)
    reference = excitation.reference_rad[slice(*excitation.segments["sweep"])]
    rng = np.random.default_rng(1)
    angle = reference + 2e-5 * rng.normal(size=reference.size)
    torque = np.gradient(np.gradient(angle)) + 1e-6 * rng.normal(size=reference.size)
    ticks = np.arange(reference.size)

    running = RunningResponse(RATE_HZ, ticks.size, last_hz=LAST_HZ)
    spectrogram = RunningSpectrogram(RATE_HZ, last_hz=LAST_HZ)
    fed, estimated, shown = [], [], []
    for first in range(0, ticks.size, BLOCK):
        part = slice(first, first + BLOCK)
        start = time.perf_counter()
        running.feed(ticks[part], reference[part], angle[part], torque[part])
        fed.append(time.perf_counter() - start)
        start = time.perf_counter()
        spectrogram.feed(ticks[part], torque[part])
        shown.append(time.perf_counter() - start)
        if first % BETWEEN_ESTIMATES == 0:
            start = time.perf_counter()
            running.estimate()
            estimated.append(time.perf_counter() - start)
    sweep_s = ticks.size / RATE_HZ

    estimate = np.median(estimated)
    recomputed = least_s(lambda: welch_response(angle, torque, RATE_HZ), REPEATS)
    options = {"fs": RATE_HZ, "nperseg": 1000, "noverlap": 750, "nfft": 4000, "detrend": False}
    peer = least_s(lambda: scipy.signal.spectrogram(torque, **options), 3)
    print(f"A sweep of {sweep_s:g} s in blocks of {BLOCK}, an estimate every {BETWEEN_ESTIMATES}")
    print(
        f"feeding {1e6 * np.median(fed):.1f} µs (median), {1e3 * max(fed):.1f} ms with a segment "
        f"complete; an estimate {1e3 * estimate:.1f} ms; "
        f"spectrogram {1e6 * np.median(shown):.1f} µs"
    )
    gate.measured("running response, an estimate", estimate / recomputed)
    gate.measured("running spectrogram, whole", sum(shown) / peer)
    gate.measured("all of it", 100 * (sum(fed) + sum(estimated) + sum(shown)) / sweep_s)
    gate.finish()


if __name__ == "__main__":
    main()
