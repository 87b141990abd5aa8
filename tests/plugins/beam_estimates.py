"""Estimate of the paper's beam, with all parameters of a uniform beam free."""

import numpy as np

from rigd.beam import Beam, Damping, Plant
from rigd.excitation import BeamEstimate

UNIFORM = (
    "zeta", "alpha", "gamma", "lambda", "density_over_stiffness", "bending_stiffness_n_m2",
    "delay_s", "tool_inertia_kg_m2",
)  # fmt: skip
ESTIMATE = BeamEstimate(
    plant=Plant(
        Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.090275),
        Damping(zeta=7.1e-5, alpha=0.996, gamma=5.5e-2, lambda_=0.594),
    ),
    free_parameters=UNIFORM,
    noise_frequency_hz=np.array([1.0]),
    noise_nm2_per_hz=np.array([5e-8]),
)


def covariance_of(information):
    """Return the inverse of an information matrix whose units differ by many orders."""
    size = np.sqrt(np.diag(information))
    return np.linalg.inv(information / np.outer(size, size)) / np.outer(size, size)
