"""Many sessions together: statistics, nominal models, pooled estimate, validation."""

from analysis.campaigns._campaign import Campaign, campaign
from analysis.campaigns._estimates import RecordEstimate, WelchFit
from analysis.campaigns._experiment import CampaignError
from analysis.campaigns._homogeneity import Heterogeneity, Homogeneity
from analysis.campaigns._pooling import PooledEstimate, PooledParameter
from analysis.campaigns._session import SessionFailure, SessionResult
from analysis.campaigns._statistics import (
    MeanPeakDeviation,
    NominalModel,
    ParameterStatistics,
    RankedStructure,
)
from analysis.campaigns._validation import LeftOutError, LostTrial
from analysis.campaigns._verdict import CampaignVerdict

__all__ = [
    "Campaign",
    "CampaignError",
    "CampaignVerdict",
    "Heterogeneity",
    "Homogeneity",
    "LeftOutError",
    "LostTrial",
    "MeanPeakDeviation",
    "NominalModel",
    "ParameterStatistics",
    "PooledEstimate",
    "PooledParameter",
    "RankedStructure",
    "RecordEstimate",
    "SessionFailure",
    "SessionResult",
    "WelchFit",
    "campaign",
]
