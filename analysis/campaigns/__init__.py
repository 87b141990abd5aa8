"""Many sessions together: statistics, nominal models, pooled estimate, validation."""

from analysis.campaigns.campaign import Campaign, campaign
from analysis.campaigns.errors import CampaignError
from analysis.campaigns.estimates import RecordEstimate, WelchFit
from analysis.campaigns.homogeneity import Heterogeneity, Homogeneity
from analysis.campaigns.nominal import MeanPeakDeviation, NominalModel
from analysis.campaigns.parameter_statistics import ParameterStatistics
from analysis.campaigns.pooled import PooledEstimate, PooledParameter
from analysis.campaigns.ranking import RankedStructure
from analysis.campaigns.session import SessionFailure, SessionResult
from analysis.campaigns.validation import LeftOutError, LostTrial
from analysis.campaigns.verdict import CampaignVerdict

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
