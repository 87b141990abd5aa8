"""Signals of a running record for the page: strips of the last seconds, and the growing response.

Both are computed from the daemon's blocks of signals, which may have gaps.
"""

import base64
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from rigd.beam import Beam, Damping
from rigd.view import Subject
from rigd.view.chart import Thinning
from rigd.view.frequency_charts import LAST_HZ, SweepResponse, nominal_response, response_thinning

Document = dict[str, Any]
Real = npt.NDArray[np.float64]

STRIP_S: Final = 0.05
"""Duration of a point of a strip."""
_STORED_S: Final = 10.0
_EVERY: Final = 4
"""Every fourth bin of `analyze` (1/160 Hz) is shown: still two per resolution of a segment."""
_DIGITS: Final = 6
_FED_AT_ONCE: Final = 20
_NAMES: Final = ("angle_rad", "angle_reference_rad", "coupling_torque_nm")
_SAMPLE: Final = np.dtype(
    [
        ("tick", np.int64),
        ("angle_rad", np.float64),
        ("angle_reference_rad", np.float64),
        ("coupling_torque_nm", np.float64),
        ("status", np.uint32),
    ]
)


@dataclass(frozen=True, slots=True)
class Block:
    """Signals of consecutive ticks; unknown values are NaN."""

    first_tick: int
    rate_hz: float
    values: Real
    """Angle (rad), its reference (rad) and coupling torque (N·m), shape (3, n)."""

    @classmethod
    def of_event(cls, event: Mapping[str, Any]) -> "Block":
        """Return the block in the daemon's event ``signals``."""
        data = b"".join(base64.b64decode(event[name]) for name in _NAMES)
        values = np.frombuffer(data, dtype="<f4").reshape(len(_NAMES), -1).astype(np.float64)
        return cls(event["first_tick"], event["rate_hz"], values)


# Strips


class Strips:
    """Envelopes of the last 10 s of angle and torque, in points of 0.05 s."""

    def __init__(self) -> None:
        self._points: deque[tuple[float | None, ...]] = deque(maxlen=round(_STORED_S / STRIP_S))
        self._next = 0
        """Number of the next point, since the start of the session."""
        self._rest: list[Real] = []
        self._end = 0
        """Next expected tick."""

    def feed(self, block: Block) -> Document | None:
        """Add a block; return the message with the points that it completes; None without any."""
        ticks = max(1, round(STRIP_S * block.rate_hz))
        values = block.values
        missing = block.first_tick - self._end
        if missing < 0 or missing > _STORED_S * block.rate_hz:
            self._points.clear()
            self._next = block.first_tick // ticks
            self._rest = []
            missing = block.first_tick - self._next * ticks
        if missing:
            self._rest.append(np.full((3, missing), np.nan))
        self._rest.append(values)
        self._end = block.first_tick + values.shape[1]
        waiting = np.concatenate(self._rest, axis=1)
        count = waiting.shape[1] // ticks
        self._rest = [waiting[:, count * ticks :]]
        if count == 0:
            return None
        bins = waiting[:, : count * ticks].reshape(3, count, ticks)
        # Unlike nanmin and nanmax, these do not warn of points without known values.
        least, greatest = np.fmin.reduce(bins, axis=2), np.fmax.reduce(bins, axis=2)
        extremes = np.stack((least, greatest), axis=1).reshape(6, count).round(_DIGITS)
        points = [tuple(_known(column)) for column in extremes.T]
        first, self._next = self._next, self._next + count
        self._points.extend(points)
        return _strip(first, points)

    def last(self) -> Document | None:
        """Return the message with all stored points, for a new page."""
        points = list(self._points)
        return _strip(self._next - len(points), points) if points else None


def _strip(first: int, points: list[tuple[float | None, ...]]) -> Document:
    names = (
        *("angle_min", "angle_max", "reference_min", "reference_max"),
        *("torque_min", "torque_max"),
    )
    columns = zip(*points, strict=True)
    return {
        "type": "strip",
        "t0_s": round(first * STRIP_S, 3),
        "dt_s": STRIP_S,
        **{name: list(column) for name, column in zip(names, columns, strict=True)},
    }


def _known(values: Real) -> list[float | None]:
    return [None if value != value else value for value in values.tolist()]


# Frequency response


class SessionResponse:
    """Frequency response of the running session, up to the present frequency of the sweep.

    Parameters
    ----------
    subject
        The session.
    """

    def __init__(self, subject: Subject) -> None:
        self._subject = subject
        self._sweep = SweepResponse(subject, LAST_HZ, every=_EVERY)
        self._thinning: Thinning | None = None
        self._waiting: list[Block] = []
        self._fresh = False
        self._reached_hz = 0.0

    def feed(self, block: Block) -> None:
        """Add a block; its unknown values are ignored."""
        self._waiting.append(block)
        if len(self._waiting) >= _FED_AT_ONCE:
            self._feed_sweep()

    def _feed_sweep(self) -> None:
        """Process the waiting blocks: a call costs about the same for many blocks as for one."""
        if not self._waiting:
            return
        values = np.concatenate([block.values for block in self._waiting], axis=1)
        ticks = np.concatenate(
            [block.first_tick + np.arange(block.values.shape[1]) for block in self._waiting]
        )
        self._waiting.clear()
        known = np.isfinite(values[0])
        if known.any():
            samples = np.zeros(int(known.sum()), dtype=_SAMPLE)
            samples["tick"] = ticks[known]
            for name, signal in zip(_NAMES, values, strict=True):
                samples[name] = signal[known]
            self._sweep.feed(samples)
            self._fresh = True

    def document(self) -> Document | None:
        """Return the message with the response; None if there is nothing new."""
        self._feed_sweep()
        estimate = self._sweep.estimate() if self._fresh else None
        self._fresh = False
        if estimate is None or not estimate.excited.any():
            return None
        reached_hz = float(estimate.response.frequency_hz[estimate.excited][-1])
        if estimate.final and reached_hz < self._reached_hz:
            return None  # the last complete segment ends before the sweep
        self._reached_hz = reached_hz
        response = estimate.response.without_delays(
            input_delay_s=self._subject.angle_delay_s, output_delay_s=self._subject.torque_delay_s
        )
        grid = response.frequency_hz
        if self._thinning is None:
            self._thinning = response_thinning(grid)
        shown = np.where(estimate.excited, response.response, np.nan)
        # The unknown values at both ends of a gap interrupt the line.
        size = np.abs(shown)
        shown_points = np.union1d(self._thinning.extremes(size), self._thinning.gaps(size))
        coherence = None
        if response.coherence is not None:
            coherence = _known(np.round(response.coherence[shown_points], 4))
        return _curve(grid[shown_points], shown[shown_points]) | {
            "type": "response",
            "coherence": coherence,
            "reached_hz": round(reached_hz, 3),
        }


def nominal_document(beam: Beam, damping: Damping, tool_inertia_kg_m2: float) -> Document:
    """Return the message with the nominal beam's response at the sensor.

    Parameters
    ----------
    beam, damping
        Specimen of the profile.
    tool_inertia_kg_m2
        Inertia between sensor and beam.
    """
    grid, model = nominal_response(beam, damping, tool_inertia_kg_m2)
    shown_points = response_thinning(grid).extremes(np.abs(model))
    return {"type": "nominal", **_curve(grid[shown_points], model[shown_points])}


def _curve(frequency_hz: Real, response: npt.NDArray[np.complex128]) -> Document:
    return {
        "frequency_hz": np.round(frequency_hz, 4).tolist(),
        "magnitude": [
            None if value is None else float(f"{value:.4g}") for value in _known(np.abs(response))
        ],
        "phase_rad": _known(np.round(np.angle(response), 4)),
    }
