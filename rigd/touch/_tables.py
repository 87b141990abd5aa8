"""Precomputed quantities for the estimation of touches, which depend on beam and rate only."""

from typing import Final

import numpy as np

from rigd.touch._any_force import AnyForceEstimator
from rigd.touch._free_motion import FreeBeam
from rigd.touch._kernels import beam_positions, contact_kernels, cross_kernels
from rigd.touch._model import TouchModel
from rigd.touch._obstacle_contact import CandidateGrid
from rigd.touch.samples import FINAL_ESTIMATE_S, FIRST_ESTIMATE_S, RECORD_BEFORE_DETECTION_S

DETECTION_DELAYS_S: Final = (0.013, 0.04, 0.12)
"""Assumed upper limits in s of the time from a touch to its detection; the next one is tried if the
estimate with a shorter one fails."""
GRID_COMPARISON_S: Final = 0.022
"""Time in s after the detection up to which samples are compared with the grid of candidates."""
_POSITION_SPACING_M = 0.007
"""Largest distance in m between neighbouring positions of the contact kernels."""


class TouchTables:
    """Precomputed quantities for the estimation of touches with one beam model and sample rate."""

    def __init__(self, model: TouchModel, rate_hz: float) -> None:
        self.model, self.rate_hz = model, rate_hz
        self.x_m = beam_positions(model.plant.beam.length_m, _POSITION_SPACING_M)
        steps_per_sample = 4 * max(1, round(4000 / rate_hz))
        step_count = round(
            (FINAL_ESTIMATE_S + DETECTION_DELAYS_S[-1] + 0.01) * rate_hz * steps_per_sample
        )
        self.fine_kernels = contact_kernels(
            model.plant.beam,
            model.plant.damping,
            self.x_m,
            1 / (steps_per_sample * rate_hz),
            step_count,
            model.sensor_filter,
        )
        self.middle_kernels = self.fine_kernels.with_wider_pulses(2, step_count // 2)
        self.coarse_kernels = self.fine_kernels.with_wider_pulses(
            steps_per_sample // 4, step_count // (steps_per_sample // 4)
        )
        half_sample_kernels = self.fine_kernels.with_wider_pulses(
            steps_per_sample // 2, step_count // (steps_per_sample // 2)
        )
        self.cross_kernels = cross_kernels(
            model.plant.beam,
            model.plant.damping,
            self.x_m,
            self.coarse_kernels.step_s,
            self.coarse_kernels.step_count,
        )
        self.any_force_estimator = AnyForceEstimator(
            half_sample_kernels, 2, round((FIRST_ESTIMATE_S + DETECTION_DELAYS_S[-1]) * rate_hz) + 1
        )
        self.max_samples = round((RECORD_BEFORE_DETECTION_S + FINAL_ESTIMATE_S) * rate_hz) + 1
        self.free_beam = FreeBeam(model, self.x_m, rate_hz, self.max_samples)
        self._grids: dict[int, CandidateGrid] = {}
        self.candidate_grid(
            round(DETECTION_DELAYS_S[0] * rate_hz) + round(GRID_COMPARISON_S * rate_hz)
        )
        empty_positions = np.empty(0)
        self.changed_beams = [
            FreeBeam(
                model.with_changed_parameter(parameter_name, std),
                empty_positions,
                rate_hz,
                self.max_samples,
            )
            for parameter_name, std in model.std_by_parameter.items()
            if std > 0
        ]
        """Free beams in each of which one uncertain parameter is one standard deviation larger."""

    def candidate_grid(self, sample_count: int) -> CandidateGrid:
        """Return the grid of candidate obstacles for comparison with `sample_count` samples."""
        if sample_count not in self._grids:
            self._grids[sample_count] = CandidateGrid(
                self.coarse_kernels, 2, self.rate_hz, sample_count
            )
        return self._grids[sample_count]
