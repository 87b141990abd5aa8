"""Kinds of rig against each other: what is said alone, what beside another, and what is open."""

import math
from dataclasses import dataclass, field
from types import SimpleNamespace

import pytest

from analysis.identify._candidates import CandidateSet
from analysis.identify._headline import structures
from analysis.identify._profile_likelihood import Profile
from analysis.identify._verdict import order_verdict
from analysis.models import STRUCTURES

CLAMP = ("root_compliance_rad_per_nm",)
FILTER = ("filter_time_constant_s",)
SECOND = "second_order_filter_time_constant_s"
CONSTANT_S = {hz: 1 / (2 * math.pi * hz) for hz in (98.0, 98.7, 99.5, 120.0)}
ALPHA = Profile(
    "alpha", "VI", (0.8, 0.9, 1.0), (9.0, 0.0, 12.0), 0.9, (0.9,), (0.85, 0.95), False, False, 0.0
)


@dataclass(frozen=True)
class Fitted:
    """What is asked of a candidate here."""

    structure: object
    bic: float
    deviance: float
    extras: tuple = ()
    uniform: bool = True
    parameters: int = 8
    alpha: float = 0.9
    fit: object = field(init=False)

    def __post_init__(self):
        parameters = {"alpha": self.alpha, CLAMP[0]: 0.01, FILTER[0]: CONSTANT_S[98.7]}
        corner = CONSTANT_S[99.5], CONSTANT_S[98.0]
        interval = {CLAMP[0]: (0.008, 0.0125), FILTER[0]: corner}
        fit = SimpleNamespace(parameters=parameters, interval=interval)
        object.__setattr__(self, "fit", fit)

    @property
    def kind(self):
        return self.uniform, self.extras

    @property
    def name(self):
        return self.structure.name


def field_of(*fitted, first_s=0.0, second_s=0.0):
    measurement = SimpleNamespace(**{FILTER[0]: first_s, SECOND: second_s})
    ranked = tuple(sorted(fitted, key=lambda each: each.bic))
    return CandidateSet(
        comparison=SimpleNamespace(measurement=measurement), noise=None, free=(),
        candidates=ranked, columns=(),
    )  # fmt: skip


def fitted(name, bic, deviance, **more):
    return Fitted(STRUCTURES[name], bic, deviance, **more)


def test_no_chance_beside_a_clamp_that_is_far_better_with_the_same_orders():
    """Type III without it saves two parameters, and is as good by its BIC alone."""
    rig = field_of(
        fitted("VI", 0.0, -80.0, extras=CLAMP), fitted("III", 0.7, -52.0), fitted("VI", 19.7, -52.0)
    )
    assert rig.freest.extras == CLAMP
    assert rig.other_kinds(10.0) == ()


def test_a_clamp_that_is_no_better_with_the_orders_free_is_named_beside_the_beam():
    rig = field_of(fitted("VI", 9.0, -71.0), fitted("III", 0.0, -71.0, extras=CLAMP))
    assert rig.freest.extras == ()


@pytest.mark.parametrize(
    ("rival", "status"),
    [
        (fitted("VI", 5.0, -60.0, extras=CLAMP, alpha=0.92), "fractional"),
        (fitted("VI", 5.0, -60.0, extras=CLAMP, alpha=0.7), "open"),
        (fitted("VII", -5.0, -60.0, extras=CLAMP, alpha=1.0), "open"),
        (fitted("VI", 15.0, -60.0, extras=CLAMP, alpha=0.7), "fractional"),
        (fitted("V", 5.0, -60.0, extras=CLAMP, alpha=0.0), "fractional"),
    ],
)
def test_an_order_stays_open_where_another_rig_has_it_elsewhere(rival, status):
    rig = field_of(fitted("VI", 0.0, -71.0), rival)
    assert order_verdict(rig, ALPHA, (1, 2, 3), doubt=None).status == status


def test_a_doubt_leaves_an_order_open():
    rig = field_of(fitted("VI", 0.0, -71.0))
    found = order_verdict(rig, ALPHA, (1, 2, 3), doubt="it rains")
    assert (found.status, found.reason) == ("open", "it rains")


def test_what_fixes_an_order_that_is_excluded_is_excluded_with_it():
    """By all that it lacks, type III would still do: two orders at once may cost more than one."""
    rig = field_of(fitted("VI", 0.0, -71.0), fitted("III", -1.0, -58.0, parameters=6))
    assert dict(structures(rig, frozenset()))["III"] == "compatible"
    assert dict(structures(rig, frozenset({"alpha"})))["III"] == "excluded"
