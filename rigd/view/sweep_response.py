"""The frequency response of a session's sweep, estimated while its samples come."""

from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from rigd.session.format import Status
from rigd.spectral import RunningEstimate, RunningResponse

if TYPE_CHECKING:
    from rigd.view.subject import Subject

_HELD: Final = Status.ANGLE_STALE | Status.WRENCH_STALE


class SweepResponse:
    """Estimate of torque over angle: Welch's, with the segments that `analyze` takes by default.

    Parameters
    ----------
    subject
        The session.
    last_hz
        Up to where the response is wanted.
    """

    def __init__(self, subject: "Subject", last_hz: float) -> None:
        self._first, end = subject.sweep
        self._running = RunningResponse(subject.rate_hz, end - self._first, last_hz=last_hz)
        self._at_rest: list[npt.NDArray[np.float64]] = []
        self._rest_rad: float | None = None

    def feed(self, samples: npt.NDArray[Any]) -> None:
        """Take samples (n,) of ``SAMPLE_DTYPE``, in order; there may be gaps."""
        ticks = samples["tick"].astype(np.int64) - self._first
        before = int(np.searchsorted(ticks, 0))
        if before:
            self._at_rest.append(samples["angle_rad"][:before].copy())
        if before == len(samples):
            return
        # A constant angle asks no torque of the beam, but would leak into the lowest bins.
        if self._rest_rad is None:
            self._rest_rad = float(np.median(np.concatenate(self._at_rest or [np.zeros(1)])))
            self._at_rest = []
        swept = samples[before:]
        # What is held from an earlier tick is no measurement: the gap is filled like any other.
        known = np.where(swept["status"] & _HELD, np.nan, 1.0)
        self._running.feed(
            ticks[before:],
            swept["angle_reference_rad"] - self._rest_rad,
            (swept["angle_rad"] - self._rest_rad) * known,
            swept["coupling_torque_nm"],
        )

    def estimate(self) -> RunningEstimate | None:
        """Return what is known so far, None as long as that is too little."""
        return self._running.estimate()
