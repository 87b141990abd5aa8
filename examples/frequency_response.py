"""Estimate the frequency response from motor angle to coupling torque, and find its peaks.

Usage: python frequency_response.py SESSION.mcap

Welch's estimate has the paper's settings, which suit sweeps of two minutes. In a short sweep,
leakage dominates the end of the band, so peaks are searched for up to 40 Hz. The empirical transfer
function estimate of the whole record has no window that would broaden peaks: compare the heights.
"""

import sys

import numpy as np

from analysis import frf, load
from analysis.models import WelchSettings
from analysis.paper.welch_analysis import resonant_peaks
from rigd.beam import undamped_frequencies_rad_s

ETFE = WelchSettings(estimator="fft")


def main(path: str) -> None:
    """Print the peaks of two estimates and the undamped frequencies of the stated beam."""
    record = load(path)
    expected_hz = undamped_frequencies_rad_s(record.beam, 2) / (2 * np.pi)
    print("undamped:", *(f"{each:.2f} Hz" for each in expected_hz))
    for name, settings in (("Welch", WelchSettings()), ("whole record", ETFE)):
        response = frf(record, settings).band(1.0, 40.0)
        print(f"{name}: {response.frequency_hz.size} bins")
        for peak in resonant_peaks(response.frequency_hz, response.response, expected_hz):
            if peak is not None:
                print(f"  {peak.frequency_hz:.2f} Hz, {peak.magnitude_db:.1f} dB re 1 N·m/rad")


if __name__ == "__main__":
    main(sys.argv[1])
