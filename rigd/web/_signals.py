"""Signals of a running session for the page: envelopes over time, and the frequency response.

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
from rigd.spectral import CurveDecimation
from rigd.sweep_response import (
    HIGHEST_SHOWN_HZ,
    SweepResponse,
    nominal_response,
    response_decimation,
)

Document = dict[str, Any]
RealArray = npt.NDArray[np.float64]

ENVELOPE_POINT_S: Final = 0.05
"""Duration in seconds of each point of an envelope."""
_STORED_DURATION_S: Final = 10.0
"""Seconds of the envelopes that are stored for new pages."""
_FREQUENCY_STEP_FACTOR: Final = 4
"""Factor by which the shown frequencies are farther apart than those of `analyze` (1/160 Hz).

There are still two frequencies per resolution of a segment."""
_ENVELOPE_DECIMALS: Final = 6
"""Number of decimals of the envelopes."""
_BLOCKS_PER_UPDATE: Final = 20
"""Number of blocks of signals that are passed to the frequency response together."""
_SIGNAL_NAMES: Final = ("angle_rad", "angle_reference_rad", "coupling_torque_nm")
"""Names of the signals in a block, in the order of its rows."""
_SAMPLE_TYPE: Final = np.dtype(  # Type of the samples that the frequency response is estimated from
    [
        ("tick", np.int64),
        ("angle_rad", np.float64),
        ("angle_reference_rad", np.float64),
        ("coupling_torque_nm", np.float64),
        ("status", np.uint32),
    ]
)


@dataclass(frozen=True, slots=True)
class PageSignalBlock:
    """Signals at consecutive ticks, as received from the daemon."""

    first_tick: int
    """Number of the block's first tick."""
    rate_hz: float
    """Loop rate in ticks per second."""
    signal_values: RealArray
    """Angle (rad), its reference (rad) and coupling torque (N·m), shape (3, n); NaN if unknown."""

    @classmethod
    def from_event(cls, event: Mapping[str, Any]) -> "PageSignalBlock":
        """Return the block of signals that an event ``signals`` of the daemon contains."""
        signal_bytes = b"".join(
            base64.b64decode(event[signal_name]) for signal_name in _SIGNAL_NAMES
        )
        signal_values = (
            np.frombuffer(signal_bytes, dtype="<f4")
            .reshape(len(_SIGNAL_NAMES), -1)
            .astype(np.float64)
        )
        return cls(event["first_tick"], event["rate_hz"], signal_values)


# Strips


class SignalEnvelopes:
    """Computes and stores the envelopes of angle, reference and torque over the last 10 s.

    Each point of an envelope has the extremes within 0.05 s.
    """

    def __init__(self) -> None:
        self._points: deque[tuple[float | None, ...]] = deque(
            maxlen=round(_STORED_DURATION_S / ENVELOPE_POINT_S)
        )
        self._next_point = 0
        """Index of the next point since the start of the session."""
        self._incomplete_point: list[RealArray] = []
        """Values of the next point so far."""
        self._next_tick = 0
        """Tick that is expected next."""

    def feed(self, signal_block: PageSignalBlock) -> Document | None:
        """Add a block of signals; return the message with new envelope points, or None."""
        ticks_per_point = max(1, round(ENVELOPE_POINT_S * signal_block.rate_hz))
        signal_values = signal_block.signal_values
        missing_ticks = signal_block.first_tick - self._next_tick
        if missing_ticks < 0 or missing_ticks > _STORED_DURATION_S * signal_block.rate_hz:
            self._points.clear()
            self._next_point = signal_block.first_tick // ticks_per_point
            self._incomplete_point = []
            missing_ticks = signal_block.first_tick - self._next_point * ticks_per_point
        if missing_ticks:
            self._incomplete_point.append(np.full((3, missing_ticks), np.nan))
        self._incomplete_point.append(signal_values)
        self._next_tick = signal_block.first_tick + signal_values.shape[1]
        pending_values = np.concatenate(self._incomplete_point, axis=1)
        point_count = pending_values.shape[1] // ticks_per_point
        self._incomplete_point = [pending_values[:, point_count * ticks_per_point :]]
        if point_count == 0:
            return None
        point_bins = pending_values[:, : point_count * ticks_per_point].reshape(
            3, point_count, ticks_per_point
        )
        # Unlike nanmin and nanmax, these do not warn of points without known values.
        smallest, largest = np.fmin.reduce(point_bins, axis=2), np.fmax.reduce(point_bins, axis=2)
        bin_extremes = (
            np.stack((smallest, largest), axis=1).reshape(6, point_count).round(_ENVELOPE_DECIMALS)
        )
        envelope_points = [tuple(_without_nan(point_values)) for point_values in bin_extremes.T]
        first_point, self._next_point = self._next_point, self._next_point + point_count
        self._points.extend(envelope_points)
        return _envelope_message(first_point, envelope_points)

    def stored_message(self) -> Document | None:
        """Return the message for a new page with all stored points, or None if there are none."""
        stored_points = list(self._points)
        return (
            _envelope_message(self._next_point - len(stored_points), stored_points)
            if stored_points
            else None
        )


def _envelope_message(first_index: int, points: list[tuple[float | None, ...]]) -> Document:
    """Return the message with points of the envelopes; `first_index` numbers the first of them."""
    column_names = (
        *("angle_min", "angle_max", "reference_min", "reference_max"),
        *("torque_min", "torque_max"),
    )
    point_columns = zip(*points, strict=True)
    return {
        "type": "strip",
        "t0_s": round(first_index * ENVELOPE_POINT_S, 3),
        "dt_s": ENVELOPE_POINT_S,
        **{
            column_name: list(column_values)
            for column_name, column_values in zip(column_names, point_columns, strict=True)
        },
    }


def _without_nan(numbers_with_nan: RealArray) -> list[float | None]:
    """Return an array's numbers as a list, with None instead of NaN."""
    return [None if number != number else number for number in numbers_with_nan.tolist()]


# Frequency response


class SessionResponse:
    """Estimates the frequency response of a running session up to the sweep's present frequency.

    `sweep_ticks` has the first tick and the (exclusive) end of the sweep. Delays are the ages of
    angle and torque at their time stamps.
    """

    def __init__(
        self,
        sweep_ticks: tuple[int, int],
        rate_hz: float,
        *,
        angle_delay_s: float = 0.0,
        torque_delay_s: float = 0.0,
    ) -> None:
        self._delays_s = {"input_delay_s": angle_delay_s, "output_delay_s": torque_delay_s}
        self._sweep = SweepResponse(
            sweep_ticks, rate_hz, HIGHEST_SHOWN_HZ, resolution_divisor=_FREQUENCY_STEP_FACTOR
        )
        self._thinning: CurveDecimation | None = None
        self._queued_blocks: list[PageSignalBlock] = []
        self._has_new_data = False
        self._reached_hz = 0.0

    def feed(self, signal_block: PageSignalBlock) -> None:
        """Add a block of signals; its unknown values are ignored."""
        self._queued_blocks.append(signal_block)
        if len(self._queued_blocks) >= _BLOCKS_PER_UPDATE:
            self._feed_sweep()

    def _feed_sweep(self) -> None:
        """Pass the queued blocks to the estimate together, which costs about as much as one."""
        if not self._queued_blocks:
            return
        signal_values = np.concatenate(
            [queued_block.signal_values for queued_block in self._queued_blocks], axis=1
        )
        tick_numbers = np.concatenate(
            [
                queued_block.first_tick + np.arange(queued_block.signal_values.shape[1])
                for queued_block in self._queued_blocks
            ]
        )
        self._queued_blocks.clear()
        is_sample_known = np.isfinite(signal_values[0])
        if is_sample_known.any():
            known_samples = np.zeros(int(is_sample_known.sum()), dtype=_SAMPLE_TYPE)
            known_samples["tick"] = tick_numbers[is_sample_known]
            for field_name, signal in zip(_SIGNAL_NAMES, signal_values, strict=True):
                known_samples[field_name] = signal[is_sample_known]
            self._sweep.feed(known_samples)
            self._has_new_data = True

    def response_message(self) -> Document | None:
        """Return the message with the estimated response, or None if it has not changed."""
        self._feed_sweep()
        sweep_estimate = self._sweep.estimate() if self._has_new_data else None
        self._has_new_data = False
        if sweep_estimate is None or not sweep_estimate.is_excited.any():
            return None
        highest_reached_hz = float(
            sweep_estimate.response.frequency_hz[sweep_estimate.is_excited][-1]
        )
        if sweep_estimate.is_final and highest_reached_hz < self._reached_hz:
            return None  # the last complete segment ends before the sweep
        self._reached_hz = highest_reached_hz
        response = sweep_estimate.response.without_delays(**self._delays_s)
        grid_frequencies_hz = response.frequency_hz
        if self._thinning is None:
            self._thinning = response_decimation(grid_frequencies_hz)
        shown_response = np.where(sweep_estimate.is_excited, response.response, np.nan)
        # The unknown values at both ends of a gap interrupt the line.
        shown_magnitudes = np.abs(shown_response)
        shown_indices = np.union1d(
            self._thinning.extreme_indices(shown_magnitudes),
            self._thinning.gap_edge_indices(shown_magnitudes),
        )
        coherence = None
        if response.coherence is not None:
            coherence = _without_nan(np.round(response.coherence[shown_indices], 4))
        return _response_document(
            grid_frequencies_hz[shown_indices], shown_response[shown_indices]
        ) | {
            "type": "response",
            "coherence": coherence,
            "reached_hz": round(highest_reached_hz, 3),
        }


def nominal_document(beam: Beam, damping: Damping, tool_inertia_kg_m2: float) -> Document:
    """Return the message with the nominal frequency response from motor angle to sensor torque.

    `tool_inertia_kg_m2` is the inertia between sensor and beam.
    """
    grid_frequencies_hz, model_response = nominal_response(beam, damping, tool_inertia_kg_m2)
    shown_indices = response_decimation(grid_frequencies_hz).extreme_indices(np.abs(model_response))
    return {
        "type": "nominal",
        **_response_document(grid_frequencies_hz[shown_indices], model_response[shown_indices]),
    }


def _response_document(frequency_hz: RealArray, response: npt.NDArray[np.complex128]) -> Document:
    """Return frequencies, magnitudes and phases of a response as JSON lists."""
    return {
        "frequency_hz": np.round(frequency_hz, 4).tolist(),
        "magnitude": [
            None if complex_value is None else float(f"{complex_value:.4g}")
            for complex_value in _without_nan(np.abs(response))
        ],
        "phase_rad": _without_nan(np.round(np.angle(response), 4)),
    }
