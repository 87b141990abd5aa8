"""Signals of a long record, decimated block by block while its file is read.

A fit to a band of 50 Hz needs 125 samples per second, and the signals of a long record at their
full rate would fill the memory. They therefore pass a linear-phase low-pass filter in blocks.
Each block overlaps its neighbours by the length of the filter, so that the result does not depend
on where a block ends. Reference, angle and torque pass the same filter, which leaves the response
from angle to torque unchanged.

Values in short gaps are interpolated before the filter. A decimated sample is marked as unknown if
its filter window contains a longer gap.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.decimation import (
    MAX_GAP_PERIODS,
    NEIGHBOUR_REACH_PERIODS,
    Decimation,
    interpolate_gaps,
    runs_of_true,
)
from analysis.models import MAX_FREQUENCY_TO_RATE_RATIO
from analysis.record_checks import RecordError, check_finite, check_sensor
from analysis.record_ticks import SIGNAL_FIELDS, ExtremeCount, RecordSignals, samples_on_grid

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.record_ticks import TickGrid

MAX_DECIMATED_SAMPLES: Final = 1_000_000
"""Maximum number of samples of a long record after decimation, with which an analysis takes 2 GB of
memory. An hour has 450 000 for a band of 50 Hz."""

_BLOCK_TICKS: Final = 1 << 16
"""Number of ticks after which a block is filtered."""

_LONGEST_FILLED_GAP_S: Final = 1.0
"""Longest gap in seconds whose interpolation does not depend on where a block begins."""


class SignalDecimation:
    """Decimation of the signals of a record that arrive in blocks.

    Parameters
    ----------
    grid : TickGrid
        Ticks of the record.
    highest_hz : float
        Highest frequency that is preserved.

    Raises
    ------
    RecordError
        The record has too many samples for the memory that an analysis may take.
    """

    def __init__(self, grid: TickGrid, highest_hz: float) -> None:
        self.grid, self.highest_hz = grid, highest_hz
        self._decimation = Decimation.to_band(
            grid.rate_hz, highest_hz, 1 / MAX_FREQUENCY_TO_RATE_RATIO
        )
        downsampling_factor, half_length_samples = (
            self._decimation.downsampling_factor,
            self._decimation.half_length_samples,
        )
        sample_count = (grid.tick_count - 1) // downsampling_factor + 1 - 2 * half_length_samples
        _check_length(grid, highest_hz, max(sample_count, 0))
        self._known_masks = (~grid.is_missing, ~grid.is_angle_unknown, grid.is_torque_measured)
        self._decimated_values = np.empty((len(SIGNAL_FIELDS), sample_count))
        self._decimated_count = 0  # number of results
        self._buffer = np.zeros((len(SIGNAL_FIELDS), _BLOCK_TICKS + 2 * self._margin_ticks))
        self._buffer_first_tick = self._end_tick = (
            0  # ticks of the buffer and after its last sample
        )
        self._torque_range_nm = (np.inf, -np.inf)
        self._extreme_counts = (ExtremeCount(1), ExtremeCount(-1))

    @property
    def downsampling_factor(self) -> int:
        """Number of ticks from one decimated sample to the next."""
        return self._decimation.downsampling_factor

    @property
    def _half_length_ticks(self) -> int:
        """Half length of the filter in ticks."""
        return self._decimation.half_length_samples * self._decimation.downsampling_factor

    @property
    def _margin_ticks(self) -> int:
        """Number of ticks before and after a sample that its value may depend on."""
        rate_hz = self.grid.rate_hz
        interpolation_reach_s = NEIGHBOUR_REACH_PERIODS / self.highest_hz + _LONGEST_FILLED_GAP_S
        return (
            self._half_length_ticks
            + int(np.ceil(interpolation_reach_s * rate_hz))
            + self._decimation.downsampling_factor
        )

    def add(self, samples: NDArray[np.void]) -> None:
        """Include the next samples of the record.

        Parameters
        ----------
        samples : ndarray of `rigd.session.layout.SAMPLE_DTYPE`, shape (n,)
            Samples in the order of their ticks. Samples outside the grid are ignored.

        Raises
        ------
        RecordError
            Values are not finite.
        """
        samples, ticks = samples_on_grid(self.grid, samples)
        for start in range(0, len(samples), _BLOCK_TICKS // 4):
            sample_range = slice(start, start + _BLOCK_TICKS // 4)
            self._add_block(samples[sample_range], ticks[sample_range])

    def _add_block(self, samples: NDArray[np.void], ticks: NDArray[np.int64]) -> None:
        """Include samples with the given ticks, at most a quarter of a block."""
        end_tick = int(ticks[-1]) + 1
        if end_tick - self._buffer_first_tick > self._buffer.shape[1]:
            self._filter_block()
        missing_columns = end_tick - self._buffer_first_tick - self._buffer.shape[1]
        if missing_columns > 0:  # after a long gap
            self._buffer = np.pad(self._buffer, ((0, 0), (0, missing_columns)))
        for row, field_name in enumerate(SIGNAL_FIELDS):
            check_finite(self.grid.session.path, field_name, samples[field_name], samples["tick"])
            self._buffer[row, ticks - self._buffer_first_tick] = samples[field_name]
        torque_nm = samples[SIGNAL_FIELDS[2]]
        self._torque_range_nm = (
            min(self._torque_range_nm[0], float(torque_nm.min())),
            max(self._torque_range_nm[1], float(torque_nm.max())),
        )
        measured_torque_nm = np.where(self._known_masks[2][ticks], torque_nm, np.nan)
        for extreme in self._extreme_counts:
            extreme.add(measured_torque_nm)
        self._end_tick = end_tick

    def _filter_block(self, *, is_last_block: bool = False) -> None:
        """Filter the ticks in the buffer, and retain those on which later samples depend."""
        downsampling_factor, half_length_ticks = (
            self._decimation.downsampling_factor,
            self._half_length_ticks,
        )
        end_tick = self._end_tick
        usable_end_tick = (
            end_tick if is_last_block else end_tick - (self._margin_ticks - half_length_ticks)
        )
        # Sample i is at the tick (i + half length) times the factor; its window ends
        # `half_length_ticks` later.
        end_sample = min(
            (usable_end_tick - 1 - 2 * half_length_ticks) // downsampling_factor + 1,
            self._decimated_values.shape[1],
        )
        if end_sample <= self._decimated_count:
            return
        ticks = slice(self._buffer_first_tick, end_tick)
        # The output for the tick of sample i has the index i + 2 half lengths, from tick 0.
        first_output_index = (
            self._decimated_count
            + 2 * self._decimation.half_length_samples
            - self._buffer_first_tick // downsampling_factor
        )
        for row, known_mask in enumerate(self._known_masks):
            filled_values = interpolate_gaps(
                self._buffer[row, : end_tick - self._buffer_first_tick],
                known_mask[ticks],
                self.highest_hz / self.grid.rate_hz,
            )
            self._decimated_values[row, self._decimated_count : end_sample] = (
                self._decimation.apply(filled_values)[
                    first_output_index : first_output_index + end_sample - self._decimated_count
                ]
            )
        self._decimated_count = end_sample
        next_tick = max(
            (self._decimated_count + self._decimation.half_length_samples) * downsampling_factor
            - self._margin_ticks,
            0,
        )
        next_tick -= next_tick % downsampling_factor
        remaining_values = self._buffer[
            :, next_tick - self._buffer_first_tick : end_tick - self._buffer_first_tick
        ]
        self._buffer[:, : remaining_values.shape[1]] = remaining_values.copy()
        self._buffer[:, remaining_values.shape[1] :] = 0.0
        self._buffer_first_tick = next_tick

    def finish(self) -> RecordSignals:
        """Return the decimated signals after the last sample was added.

        Raises
        ------
        RecordError
            The torque is constant, or the file was changed while it was read.
        """
        path = self.grid.session.path
        check_sensor(path, np.array(self._torque_range_nm))
        self._filter_block(is_last_block=True)
        if self._decimated_count < self._decimated_values.shape[1]:
            raise RecordError(f"{path} was changed while it was read; analyse it again.")
        angle_known, torque_known = self._known_samples()
        return RecordSignals(
            self._decimated_values,
            angle_known,
            torque_known,
            self._half_length_ticks,
            self._decimation.downsampling_factor,
            tuple(extreme.torque_extreme() for extreme in self._extreme_counts),
        )

    def _known_samples(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return whether angle and torque of each decimated sample are known."""
        downsampling_factor, half_length_ticks = (
            self._decimation.downsampling_factor,
            self._half_length_ticks,
        )
        angle_known, torque_known = np.ones((2, self._decimated_values.shape[1]), dtype=bool)
        longest_gap_ticks = MAX_GAP_PERIODS / self.highest_hz * self.grid.rate_hz
        for is_angle, known_mask in ((True, self._known_masks[1]), (False, self._known_masks[2])):
            for gap_start, gap_end in zip(*runs_of_true(~known_mask), strict=True):
                if gap_end - gap_start <= longest_gap_ticks:
                    continue
                # A wrong angle near the gap moves the beam: no torque is compared there.
                first_sample = max(-((2 * half_length_ticks - gap_start) // downsampling_factor), 0)
                torque_known[first_sample : (gap_end - 1) // downsampling_factor + 1] = False
                if is_angle:  # two samples or more count as a gap that is too long
                    first_sample = (
                        gap_start // downsampling_factor - half_length_ticks // downsampling_factor
                    )
                    gap_samples = max((gap_end - gap_start) // downsampling_factor, 2)
                    angle_known[max(first_sample, 0) : max(first_sample + gap_samples, 0)] = False
        return angle_known, torque_known


def _check_length(grid: TickGrid, highest_hz: float, sample_count: int) -> None:
    """Raise if a record has too many samples for the memory that an analysis may take.

    `sample_count` is the number of samples that the highest frequency of the analysis needs.
    """
    if sample_count <= MAX_DECIMATED_SAMPLES:
        return
    raise RecordError(
        f"{grid.session.path}: {grid.tick_count / grid.rate_hz:g} s with frequencies up to "
        f"{highest_hz:g} Hz take {sample_count} samples, and no more than {MAX_DECIMATED_SAMPLES} "
        "fit into the memory that an analysis may take. Analyse a part of the session (--from, "
        "--to) or lower --band."
    )
