"""The one structure by which all sessions are compared and pooled: the freest that they support.

What a session selects by itself depends on its noise. Sessions compared by what each of them
selected differ by the difference between structures, and forty sessions of one beam then seem to
be of two. Intervals of the freest structure hold whichever simpler one is true.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from analysis.campaigns.pooled import by_structure
from analysis.models import STRUCTURES

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.campaigns.estimates import RecordEstimate
    from analysis.campaigns.pooled import PooledEstimate
    from analysis.campaigns.session import SessionResult

_NEARLY_ALL: Final = 0.9
"""Share of the sessions that determine the selected structure that must determine a freer one."""


def freest_estimate(pooled: Sequence[PooledEstimate]) -> PooledEstimate | None:
    """Return the freest pooled structure on the beam that all sessions together support.

    The beam is that of the lowest BIC; a structure that far fewer sessions determine does not
    stand for all. None without any.

    Parameters
    ----------
    pooled : sequence of PooledEstimate
        The lowest BIC first.
    """
    if not pooled:
        return None
    best = pooled[0]
    return max(
        (
            each
            for each in pooled
            if each.beam == best.beam and each.sessions >= _NEARLY_ALL * best.sessions
        ),
        key=lambda each: len(STRUCTURES[each.structure].free),
    )


def common_structure(
    sessions: Sequence[SessionResult], pooled: Sequence[PooledEstimate]
) -> str | None:
    """Name the structure by which the modes of all sessions are compared.

    Parameters
    ----------
    sessions : sequence of SessionResult
    pooled : sequence of PooledEstimate
        The lowest BIC first.

    Returns
    -------
    str or None
        Of those fitted to every session, the freest: on the beam of what is pooled, or with nothing
        pooled on the one that most sessions select. None without whole-record fits.
    """
    fitted = by_structure(sessions)
    tried = max(map(len, fitted.values()), default=0)
    found = [each[0] for each in fitted.values() if len(each) == tried]
    if not found:
        return None
    beam = pooled[0].beam if pooled else _usual_beam(sessions)
    on_beam = [each for each in found if each.beam == beam] or found
    return max(on_beam, key=_freedom).name


def _usual_beam(sessions: Sequence[SessionResult]) -> str:
    """Beam of the structure that most sessions select by themselves."""
    beams = [
        min(session.record_estimates, key=lambda each: each.bic).beam
        for session in sessions
        if session.record_estimates
    ]
    return max(beams, key=beams.count)


def _freedom(estimate: RecordEstimate) -> int:
    return len(STRUCTURES[estimate.structure].free)
