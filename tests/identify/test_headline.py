"""Flags of numbers, status of orders and structures: from fits of given likelihoods."""

from dataclasses import dataclass, field
from types import SimpleNamespace

import pytest

from analysis.identify.headline import structures
from analysis.identify.profile_likelihood import LikelihoodProfile
from analysis.identify.verdict import ORDER_NOT_DETERMINED_REASON, order_verdict
from analysis.models import STRUCTURES
from rigd.estimates import Estimate

ALPHA = LikelihoodProfile(
    "alpha", "VI", (0.8, 0.9, 1.0), (9.0, 0.0, 12.0), 0.9, (0.9,), (0.85, 0.95), False, False, 0.0
)


@dataclass(frozen=True)
class Fitted:
    """The properties of a candidate that are used here."""

    name: str
    bic: float
    deviance: float
    parameter_count: int = 8
    structure: object = field(init=False)
    fit: object = field(default_factory=lambda: SimpleNamespace(parameters={"alpha": 0.9}))

    def __post_init__(self):
        object.__setattr__(self, "structure", STRUCTURES[self.name])


def test_first_flag_is_retained():
    number = Estimate(0.98, 0.01, (0.96, 1.0))
    assert number.with_flag(None) is number
    flagged = number.with_flag(ORDER_NOT_DETERMINED_REASON).with_flag(
        "part of the record is unexplained"
    )
    assert flagged.flag == ORDER_NOT_DETERMINED_REASON
    assert (flagged.value, flagged.std, flagged.interval_95) == (0.98, 0.01, (0.96, 1.0))


@pytest.mark.fit
@pytest.mark.parametrize(("doubt", "status"), [(None, "fractional"), ("it rains", "open")])
def test_doubtful_order_is_undecided(candidates, doubt, status):
    found = order_verdict(
        candidates(Fitted("VI", 0.0, -71.0)), ALPHA, (1, 2, 3), doubt_reason=doubt
    )
    assert (found.status, found.reason) == (status, doubt)


@pytest.mark.fit
def test_structures_with_an_excluded_order_are_excluded(candidates):
    """By all that it lacks, type III would still do: two orders at once may cost more than one."""
    rig = candidates(Fitted("VI", 0.0, -71.0), Fitted("III", -1.0, -58.0, parameter_count=6))
    assert dict(structures(rig, frozenset()))["III"] == "compatible"
    assert dict(structures(rig, frozenset({"alpha"})))["III"] == "excluded"
