"""Read a session file: metadata, samples as a numpy array, segments and log.

Usage: python read_session.py SESSION.mcap
"""

import sys

import numpy as np

from rigd.session import read_session
from rigd.session.layout import Status


def main(path: str) -> None:
    """Print the contents of a session file."""
    session = read_session(path)
    rate_hz = session.number("rate_hz")
    print(f"{session.metadata['specimen']}: {session.metadata['excitation']} at {rate_hz:g} Hz")

    samples = session.samples  # one row per tick, fields with their units in the names
    print(f"{len(samples)} samples of {', '.join(samples.dtype.names or ())}")
    for name, (first, end) in session.segments.items():
        part = samples[(samples["tick"] >= first) & (samples["tick"] < end)]
        torque_nm = part["coupling_torque_nm"]
        print(
            f"{name}: {(end - first) / rate_hz:g} s, angle {np.ptp(part['angle_rad']):.4f} rad "
            f"peak to peak, torque {np.sqrt(np.mean(torque_nm**2)):.4f} N·m rms"
        )

    stale = np.count_nonzero(samples["status"] & (Status.ANGLE_STALE | Status.WRENCH_STALE))
    print(f"samples with an old angle or wrench: {stale}")
    print("outcome:", (session.outcome or {}).get("outcome", "not stated"))
    for event in session.events:
        print(f"{event.t_ns / 1e9:8.3f} s  {event.name}: {event.message}")


if __name__ == "__main__":
    main(sys.argv[1])
