"""The paper's indices, Eqs. (28) to (30), of any fit against either measured response.

A fit on the whole record was never made to suit Welch's estimate, and the truth does not suit it
either: that estimate is biased at the resonances. So each fit is held against the whole record's
ratio of transforms too, which is noisy but not biased.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import TYPE_CHECKING

import numpy as np

from analysis.identify import ResponseGrid
from analysis.models import FrequencyResponseModel
from analysis.paper import fit_indices

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.identify import RecordFit
    from analysis.paper import WelchAnalysis
    from rigd.spectral import FrequencyResponse

    IndexValues = dict[str, float | None]

NOT_COMPARED: dict[str, float | None] = {"mse": None, "wmse": None, "md": None}
"""Indices of a fit without a measured response beside it."""


def indices_of_record_fit(fit: RecordFit, welch: WelchAnalysis) -> tuple[IndexValues, IndexValues]:
    """Compute the indices of a whole-record fit in the band of the paper's route.

    Parameters
    ----------
    fit : RecordFit
    welch : WelchAnalysis
        Of the same record.

    Returns
    -------
    welch, whole_record : dict
        ``mse`` and ``wmse`` in (N·m/rad)², ``md`` in N·m/rad: against Welch's estimate, on the
        bins of the paper's fits, and against the ratio of the whole record's transforms.
    """
    record = welch.record
    # Of the responses the delay that the file states has been taken out.
    stated_s = record.torque_delay_s - record.angle_delay_s
    plant = replace(fit.plant, delay_s=fit.plant.delay_s - stated_s)

    def against(measured: FrequencyResponse) -> IndexValues:
        (model,) = ResponseGrid(2j * np.pi * measured.frequency_hz).evaluate(plant, ())
        return _indices(measured, model)

    return against(welch.response), against(welch.whole_record)


def whole_record_indices(welch: WelchAnalysis) -> list[IndexValues]:
    """Compute the paper's fits' against the whole record's ratio, in their order."""
    measured, record = welch.whole_record, welch.record
    grid = FrequencyResponseModel(measured.frequency_hz, record.beam, record.tool_inertia_kg_m2)
    return [_indices(measured, grid.evaluate(model.fit.damping)) for model in welch.models]


def _indices(measured: FrequencyResponse, model: NDArray[np.complex128]) -> IndexValues:
    known = np.isfinite(measured.response)
    if not known.any():
        return NOT_COMPARED
    omega = 2 * np.pi * measured.frequency_hz[known]
    return asdict(fit_indices(omega, measured.response[known], model[known]))
