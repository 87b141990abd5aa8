"""Output-error estimation on whole records: the exact model against every sample in the band."""

from analysis.whole_record.estimate import BAND_HZ, fit_record
from analysis.whole_record.measurement import Measurement, MeasurementError
from analysis.whole_record.noise import Line
from analysis.whole_record.plant import EXTRAS, SETTINGS, Extra, Plant, Setting
from analysis.whole_record.result import (
    DampingSize,
    ModeEstimate,
    RecordAnalysis,
    RecordFit,
    Ringing,
)

__all__ = [
    "BAND_HZ",
    "EXTRAS",
    "SETTINGS",
    "DampingSize",
    "Extra",
    "Line",
    "Measurement",
    "MeasurementError",
    "ModeEstimate",
    "Plant",
    "RecordAnalysis",
    "RecordFit",
    "Ringing",
    "Setting",
    "fit_record",
]
