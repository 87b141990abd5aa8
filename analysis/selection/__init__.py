"""Which structure a record supports, what it says of the orders, and what else is in it."""

from analysis.selection.candidate import Candidate
from analysis.selection.finding import Finding
from analysis.selection.harmonics import Harmonic
from analysis.selection.headline import Headline, Quantity, Size, headline_json, of_fit
from analysis.selection.orders import OrderVerdict
from analysis.selection.profile import Profile
from analysis.selection.select import Selection, select
from analysis.selection.verdict import Row, Verdict
from analysis.selection.whiteness import InputRelation, Whiteness, cumulative_periodogram

__all__ = [
    "Candidate",
    "Finding",
    "Harmonic",
    "Headline",
    "InputRelation",
    "OrderVerdict",
    "Profile",
    "Quantity",
    "Row",
    "Selection",
    "Size",
    "Verdict",
    "Whiteness",
    "cumulative_periodogram",
    "headline_json",
    "of_fit",
    "select",
]
