"""Test of a uniform beam against the modal constants of a record, by chi-square."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from analysis.identify._modal_model import MODE_CONSTANT_NAMES
from analysis.identify.uniform_beam import PARAMETERS, UniformBeamProblem
from analysis.statistics import chi_square_p_value
from rigd.session import BeamUniformity

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.identify._modal_model import ModalEstimate
    from rigd.beam import Plant

TestStatus = Literal["passed", "refused", "not tested"]
"""Result of the uniform-beam test."""

MIN_P_VALUE_OF_UNIFORM_BEAM: Final = 0.01
"""p-value below which the test refuses a uniform beam."""


@dataclass(frozen=True, slots=True)
class UniformBeamTest:
    """Result of the test whether a uniform beam predicts the modal constants of a record.

    Attributes
    ----------
    status : str
        "passed", "refused", or "not tested" if there are no degrees of freedom or if the modes are
        not determined.
    chi_square : float
        Weighted sum of squared differences between measured and predicted constants.
    degrees_of_freedom : int
        Number of constants minus number of effective beam parameters.
    p_value : float or None
        Probability of at least this chi-square by chance. None without degrees of freedom.
    mode_numbers : tuple of int
        Numbers of the compared modes.
    measured_constants, predicted_constants, constant_stds : ndarray, shape (4 n,)
        Measured and predicted `MODE_CONSTANT_NAMES`, mode by mode, and the standard deviations of
        the measured ones.
    problem : UniformBeamProblem or None
        Fit of the uniform beam; None if not tested.
    best_fit_unknowns : ndarray, shape (7,)
        Unknowns of the fitted beam; NaN if not tested.
    """

    status: TestStatus
    chi_square: float
    degrees_of_freedom: int
    p_value: float | None
    mode_numbers: tuple[int, ...]
    measured_constants: NDArray[np.float64]
    predicted_constants: NDArray[np.float64]
    constant_stds: NDArray[np.float64]
    problem: UniformBeamProblem | None
    best_fit_unknowns: NDArray[np.float64]

    @classmethod
    def not_made(cls, modal_estimate: ModalEstimate) -> UniformBeamTest:
        """Return the result of a test that is not made, because the record cannot decide it."""
        mode_numbers = modal_estimate.visible_mode_numbers
        constant_indices = modal_estimate.constant_indices(mode_numbers)
        return cls(
            "not tested",
            math.nan,
            0,
            None,
            mode_numbers,
            modal_estimate.mode_constants[constant_indices],
            np.full(constant_indices.size, np.nan),
            np.sqrt(np.diag(modal_estimate.covariance)[constant_indices]),
            None,
            np.full(len(PARAMETERS), np.nan),
        )

    @property
    def summary(self) -> BeamUniformity:
        """Return status and p-value of the uniform-beam test."""
        return BeamUniformity(self.status, self.p_value)

    def as_json(self) -> dict[str, Any]:
        """Return the result of the test as a dict for JSON. Numbers may be NaN or infinite."""
        return {
            **self.summary.as_json(),
            "chi_square": self.chi_square,
            "degrees_of_freedom": self.degrees_of_freedom,
            "constants": [
                {
                    "mode": self.mode_numbers[constant_index // len(MODE_CONSTANT_NAMES)],
                    "name": MODE_CONSTANT_NAMES[constant_index % len(MODE_CONSTANT_NAMES)],
                    "measured": measured_value,
                    "std": std,
                    "predicted": predicted_value,
                }
                for constant_index, (measured_value, std, predicted_value) in enumerate(
                    zip(
                        self.measured_constants.tolist(),
                        self.constant_stds.tolist(),
                        self.predicted_constants.tolist(),
                        strict=True,
                    )
                )
            ],
        }


def uniform_beam_test(
    modal_estimate: ModalEstimate, nominal_plant: Plant, tilt_deg: float | None = None
) -> UniformBeamTest:
    """Test whether a uniform beam predicts the modal constants of the visible modes.

    Parameters
    ----------
    modal_estimate : ModalEstimate
        Fitted modal model with the covariance of its constants.
    nominal_plant : Plant
        Rig and specimen as the file states them, with the tip mass if the file states one.
    tilt_deg : float, optional
        Angle in degrees between the beam at rest and the horizontal, as the file states it;
        positive if the tip is lower than the root.
    """
    mode_numbers = modal_estimate.visible_mode_numbers
    constant_indices = modal_estimate.constant_indices(mode_numbers)
    measured_constants, std = (
        modal_estimate.mode_constants[constant_indices],
        np.sqrt(np.diag(modal_estimate.covariance)[constant_indices]),
    )
    degrees_of_freedom = len(constant_indices) - len(PARAMETERS)
    if degrees_of_freedom <= 0:
        return UniformBeamTest.not_made(modal_estimate)
    problem = UniformBeamProblem(modal_estimate, mode_numbers, nominal_plant, tilt_deg=tilt_deg)
    best_minimum = problem.minima()[0]
    degrees_of_freedom += problem.count_idle_unknowns(best_minimum)
    p_value = float(chi_square_p_value(best_minimum.cost, degrees_of_freedom))
    return UniformBeamTest(
        status="passed" if p_value >= MIN_P_VALUE_OF_UNIFORM_BEAM else "refused",
        chi_square=best_minimum.cost,
        degrees_of_freedom=degrees_of_freedom,
        p_value=p_value,
        mode_numbers=mode_numbers,
        measured_constants=measured_constants,
        predicted_constants=problem.constants(best_minimum.x),
        constant_stds=std,
        problem=problem,
        best_fit_unknowns=best_minimum.x,
    )
