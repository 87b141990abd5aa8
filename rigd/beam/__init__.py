"""Exact model of the slewing beam with fractional damping (Section 4 of the paper)."""

from rigd.beam.air_drag import DragGrid
from rigd.beam.deflection import DeflectionFilter
from rigd.beam.model import PARAMETERS, Beam, Damping, TransferGrid, transfer, transfer_and_gradient
from rigd.beam.modes import (
    Mode,
    clamped_free_eigenvalues,
    mode_shape,
    modes,
    participation,
    poles,
    undamped_frequencies_rad_s,
)
from rigd.beam.realisation import (
    CoupledModel,
    Realisation,
    RealisationError,
    couple,
    held_inputs,
    propagator,
    realise,
    with_filter,
)
from rigd.beam.tip import SMALL_SLOPE_RAD, TipMotion, tip_motion, tip_response
from rigd.beam.tip_mass import LoadedBeam, LoadedResponse, loaded_response

__all__ = [
    "PARAMETERS",
    "SMALL_SLOPE_RAD",
    "Beam",
    "CoupledModel",
    "Damping",
    "DeflectionFilter",
    "DragGrid",
    "LoadedBeam",
    "LoadedResponse",
    "Mode",
    "Realisation",
    "RealisationError",
    "TipMotion",
    "TransferGrid",
    "clamped_free_eigenvalues",
    "couple",
    "held_inputs",
    "loaded_response",
    "mode_shape",
    "modes",
    "participation",
    "poles",
    "propagator",
    "realise",
    "tip_motion",
    "tip_response",
    "transfer",
    "transfer_and_gradient",
    "undamped_frequencies_rad_s",
    "with_filter",
]
