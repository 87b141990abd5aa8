"""Exact model of the slewing beam with fractional damping (Section 4 of the paper)."""

from rigd.beam.coupled import CoupledModel, couple, propagator, with_filter
from rigd.beam.deflection import DeflectionFilter
from rigd.beam.modes import (
    Mode,
    clamped_free_eigenvalues,
    mode_shape,
    modes,
    participation,
    poles,
    undamped_frequencies_rad_s,
)
from rigd.beam.parameters import Beam, Damping
from rigd.beam.realisation import RealisationError, realise
from rigd.beam.state_space import Realisation
from rigd.beam.tip_mass import LoadedBeam, LoadedResponse, loaded_response
from rigd.beam.transfer_function import PARAMETERS, TransferGrid, transfer, transfer_and_gradient

__all__ = [
    "PARAMETERS",
    "Beam",
    "CoupledModel",
    "Damping",
    "DeflectionFilter",
    "LoadedBeam",
    "LoadedResponse",
    "Mode",
    "Realisation",
    "RealisationError",
    "TransferGrid",
    "clamped_free_eigenvalues",
    "couple",
    "loaded_response",
    "mode_shape",
    "modes",
    "participation",
    "poles",
    "propagator",
    "realise",
    "transfer",
    "transfer_and_gradient",
    "undamped_frequencies_rad_s",
    "with_filter",
]
