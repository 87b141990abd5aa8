"""Output-error estimation on whole records: the exact model against every sample in the band."""

from analysis.identify.candidates import Candidate
from analysis.identify.data import Measurement, MeasurementError
from analysis.identify.finding import Finding
from analysis.identify.fit import BAND_HZ, fit_record
from analysis.identify.headline import Headline, Quantity, Size, headline_json, of_fit
from analysis.identify.noise import Line
from analysis.identify.predictor import EXTRAS, SETTINGS, Extra, Plant, Setting
from analysis.identify.profile_likelihood import Profile
from analysis.identify.residual_tests import (
    Harmonic,
    InputRelation,
    Whiteness,
    cumulative_periodogram,
)
from analysis.identify.result import (
    DampingSize,
    ModeEstimate,
    RecordAnalysis,
    RecordFit,
    Ringing,
)
from analysis.identify.select import Selection, select
from analysis.identify.verdict import OrderVerdict, Row, Verdict

__all__ = [
    "BAND_HZ",
    "EXTRAS",
    "SETTINGS",
    "Candidate",
    "DampingSize",
    "Extra",
    "Finding",
    "Harmonic",
    "Headline",
    "InputRelation",
    "Line",
    "Measurement",
    "MeasurementError",
    "ModeEstimate",
    "OrderVerdict",
    "Plant",
    "Profile",
    "Quantity",
    "RecordAnalysis",
    "RecordFit",
    "Ringing",
    "Row",
    "Selection",
    "Setting",
    "Size",
    "Verdict",
    "Whiteness",
    "cumulative_periodogram",
    "fit_record",
    "headline_json",
    "of_fit",
    "select",
]
