"""Checks on paper, in one table: `rigd check` shows their rows, and every session asks for them.

What fails here refuses a session, wherever it is started, unless the operator accepts that row by
its name. A new check is a function that yields rows, and an entry of `PAPER_CHECKS`.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from rigd.checks import on_paper as paper
from rigd.checks.rows import CheckResult, CheckRow
from rigd.devices import unknown_values
from rigd.errors import FailureError, UserError
from rigd.profile import Profile


class CheckFailedError(FailureError):
    """The checks on paper fail; the message names the rows, and how to accept them.

    Parameters
    ----------
    message
        A sentence or two for each row, for the operator.
    wrong_use
        No session can be run with this profile, whatever the operator accepts.
    """

    def __init__(self, message: str, *, wrong_use: bool = False) -> None:
        super().__init__(message)
        self.wrong_use = wrong_use


class UnknownRowError(UserError):
    """A row is to be accepted that no check on paper has; the message lists those there are."""


@dataclass(frozen=True, slots=True)
class PaperCheck:
    """One check that needs no device."""

    rows: Callable[[Profile], Iterator[CheckRow]]
    """Function that makes its rows; those that can fail have a name."""
    names: tuple[str, ...] = ()
    """Names of the rows that can fail; none: it gives advice only and refuses no session."""
    not_acceptable: str = ""
    """Why a failure cannot be accepted for a session; empty if it can."""
    needs_values: bool = True
    """It computes with values of the profile, so that it is left out while any is unknown."""


PAPER_CHECKS: Final = (
    PaperCheck(paper.drive_file_rows, (paper.EDS,), needs_values=False),
    PaperCheck(paper.profile_rows, needs_values=False),
    PaperCheck(paper.record_rows, needs_values=False),
    PaperCheck(paper.plumb_rows, needs_values=False),
    PaperCheck(
        paper.unknown_rows,
        (paper.UNKNOWN_VALUES,),
        not_acceptable="nothing can be computed without it",
        needs_values=False,
    ),
    PaperCheck(
        lambda profile: paper.wiring_rows(profile.rig),
        (paper.CAN_IDENTIFIERS, paper.CAN_LOAD, paper.SERIAL_LOAD),
        not_acceptable="devices could receive what is not meant for them, or too late",
        needs_values=False,
    ),
    PaperCheck(
        paper.stability_rows,
        (paper.STABILITY,),
        not_acceptable="the shaft could not be held",
    ),
    PaperCheck(paper.margin_rows),
    PaperCheck(
        paper.travel_rows,
        (
            paper.TRAVEL_LOOP_FAILS,
            paper.TRAVEL_NO_ANGLE,
            paper.TRAVEL_ENCODER_FAILS,
            paper.TRAVEL_MISSED_TICKS,
        ),
    ),
)
"""All checks on paper, in the order of their rows. Those of one group follow each other."""

ACCEPTABLE: Final = tuple(
    name for check in PAPER_CHECKS for name in check.names if not check.not_acceptable
)
"""Names of the rows whose failure the operator can accept."""
_OWNERS: Final = {name: check for check in PAPER_CHECKS for name in check.names}


def paper_rows(profile: Profile) -> list[CheckRow]:
    """Return the rows of all checks that need no device.

    Parameters
    ----------
    profile
        Profile of the rig.
    """
    return [row for check in PAPER_CHECKS for row in _rows(check, profile)]


def _rows(check: PaperCheck, profile: Profile) -> Iterator[CheckRow]:
    if not (check.needs_values and unknown_values(profile.rig)):
        yield from check.rows(profile)


@dataclass(frozen=True, slots=True)
class FailedCheck:
    """A row that failed on paper, and what becomes of a session."""

    name: str
    """Name of the row."""
    text: str
    """What was found, and the remedy."""
    acceptable: bool
    """Whether the operator can accept it for a session."""
    accepted: bool
    """Whether the operator has."""


@dataclass(frozen=True, slots=True)
class Clearance:
    """Result of the checks on paper for a session."""

    failed: tuple[FailedCheck, ...] = ()
    """Rows that failed, accepted or not."""
    warnings: tuple[str, ...] = ()
    """Sentences about what was accepted without need."""

    @property
    def refusals(self) -> tuple[str, ...]:
        """Why no session may be run: a sentence or two for each row that is not accepted."""
        return tuple(_refusal(each) for each in self.failed if not each.accepted)

    @property
    def accepted(self) -> tuple[FailedCheck, ...]:
        """Rows that failed and are accepted."""
        return tuple(each for each in self.failed if each.accepted)

    def require(self) -> None:
        """Raise unless all failed rows are accepted.

        Raises
        ------
        CheckFailedError
            Naming each row that failed and is not accepted.
        """
        if self.refusals:
            final = not all(each.acceptable for each in self.failed)
            raise CheckFailedError("\n".join(self.refusals), wrong_use=final)


def check_on_paper(profile: Profile, accept: Sequence[str] = ()) -> Clearance:
    """Run the checks that need no device for a session.

    Parameters
    ----------
    profile
        Profile of the rig, with the beam of the session.
    accept
        Names of rows that may fail in this session.

    Raises
    ------
    UnknownRowError
        If no row has such a name, or its failure cannot be accepted.
    """
    for name in accept:
        _check_name(name)
    failed: dict[str, FailedCheck] = {}
    for check in PAPER_CHECKS:
        for row in _rows(check, profile) if check.names else ():
            if row.verdict is not CheckResult.FAIL:
                continue
            name, text = row.name, _text(row)
            if name in failed:  # several rows of one name: an EDS file that lacks two objects
                text = f"{failed[name].text}\n{text}"
            failed[name] = FailedCheck(name, text, not check.not_acceptable, name in accept)
    needless = [name for name in dict.fromkeys(accept) if name not in failed]
    return Clearance(
        tuple(failed.values()),
        tuple(f"--accept {name}: it did not fail; nothing was accepted." for name in needless),
    )


def _check_name(name: str) -> None:
    check = _OWNERS.get(name)
    if check is None:
        raise UnknownRowError(
            f"--accept {name[:60]}: no row of rigd check has that name; those that can be accepted "
            f"are {', '.join(ACCEPTABLE)}."
        )
    if check.not_acceptable:
        raise UnknownRowError(
            f"--accept {name}: a failure of that row cannot be accepted: {check.not_acceptable}."
        )


def _text(row: CheckRow) -> str:
    wanted = f" (wanted: {row.wanted})" if row.wanted else ""
    return f"{row.group}, {row.what}: {row.found.rstrip('.')}{wanted}. {row.detail}".strip()


def _refusal(failed: FailedCheck) -> str:
    remedy = f" To accept it for one session: --accept {failed.name}." if failed.acceptable else ""
    return f"rigd check fails ({failed.name}): {failed.text}{remedy}"
