"""Table of the offline checks, which `rigd check` shows and every session requires.

If one of them fails, no session is started, unless the operator accepts the failed row by its name.
A new check is a function that yields rows, and an entry of `OFFLINE_CHECKS`.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from rigd.check_rows import CheckResult, CheckRow
from rigd.checks import closed_loop, offline, stopping_distance
from rigd.devices import unknown_values
from rigd.errors import FailureError, UserError
from rigd.profile import Profile


class CheckFailedError(FailureError):
    """Error if offline checks have failed; the message names them, and how to accept them.

    With `wrong_use` no session can be run with this profile, whatever the operator accepts.
    """

    def __init__(self, message: str, *, wrong_use: bool = False) -> None:
        super().__init__(message)
        self.wrong_use = wrong_use


class UnknownRowError(UserError):
    """Error if the operator accepts an unknown row; the message lists the valid names."""


@dataclass(frozen=True, slots=True)
class OfflineCheck:
    """Check of a rig's profile or computer that needs no device."""

    make_rows: Callable[[Profile], Iterator[CheckRow]]
    """Function that yields the rows of the check; rows that can fail have a name."""
    row_names: tuple[str, ...] = ()
    """Names of the rows that can fail, or none if the check only gives advice."""
    unacceptable_reason: str = ""
    """Reason why a failure cannot be accepted for a session, or "" if it can be accepted."""
    needs_known_values: bool = True
    """Whether the check computes with values of the profile.

    It is then omitted while any value is unknown."""


OFFLINE_CHECKS: Final = (
    OfflineCheck(offline.drive_file_rows, (offline.EDS_ROW,), needs_known_values=False),
    OfflineCheck(offline.profile_rows, needs_known_values=False),
    OfflineCheck(offline.record_rows, needs_known_values=False),
    OfflineCheck(offline.axis_tilt_rows, needs_known_values=False),
    OfflineCheck(
        offline.unknown_value_rows,
        (offline.UNKNOWN_VALUES_ROW,),
        unacceptable_reason="nothing can be computed without it",
        needs_known_values=False,
    ),
    OfflineCheck(
        lambda profile: offline.wiring_rows(profile.rig),
        (offline.CAN_IDENTIFIERS_ROW, offline.CAN_LOAD_ROW, offline.SERIAL_LOAD_ROW),
        unacceptable_reason="devices could receive what is not meant for them, or too late",
        needs_known_values=False,
    ),
    OfflineCheck(
        offline.added_device_rows,
        (offline.DEVICE_SETTINGS_ROW,),
        unacceptable_reason="the device could not be used",
        needs_known_values=False,
    ),
    OfflineCheck(
        offline.added_controller_rows,
        (offline.CONTROLLER_ROW,),
        unacceptable_reason="the shaft could not be held",
    ),
    OfflineCheck(
        closed_loop.stability_rows,
        (closed_loop.STABILITY_ROW,),
        unacceptable_reason="the shaft could not be held",
    ),
    OfflineCheck(closed_loop.margin_rows),
    OfflineCheck(
        stopping_distance.stopping_distance_rows,
        (
            stopping_distance.STOPPING_LOOP_FAILS_ROW,
            stopping_distance.STOPPING_NO_ANGLE_ROW,
            stopping_distance.STOPPING_ENCODER_FAILS_ROW,
            stopping_distance.STOPPING_MISSED_TICKS_ROW,
        ),
    ),
)
"""All offline checks, in the order of their rows; checks of the same group are adjacent."""

ACCEPTABLE_ROW_NAMES: Final = tuple(
    name for check in OFFLINE_CHECKS for name in check.row_names if not check.unacceptable_reason
)
"""Names of the rows whose failure the operator can accept for a session."""
_CHECK_BY_ROW_NAME: Final = {name: check for check in OFFLINE_CHECKS for name in check.row_names}
"""Map from the name of a row that can fail to its check."""


def offline_rows(profile: Profile) -> list[CheckRow]:
    """Return the rows of all offline checks, which need no device."""
    return [
        row for offline_check in OFFLINE_CHECKS for row in _rows_of_check(offline_check, profile)
    ]


def _rows_of_check(offline_check: OfflineCheck, profile: Profile) -> Iterator[CheckRow]:
    """Yield a check's result rows, or none if it needs a value that the profile lacks."""
    if not (offline_check.needs_known_values and unknown_values(profile.rig)):
        yield from offline_check.make_rows(profile)


@dataclass(frozen=True, slots=True)
class FailedCheck:
    """A failed check that needs no device, and whether a session can be run nevertheless."""

    name: str
    """Name of the failed row."""
    text: str
    """Finding and remedy, for the operator."""
    acceptable: bool
    """Whether the operator can accept the failure for a session."""
    accepted: bool
    """Whether the operator has accepted the failure for this session."""


@dataclass(frozen=True, slots=True)
class OfflineCheckResult:
    """Result of the offline checks for a session."""

    failed: tuple[FailedCheck, ...] = ()
    """All failed rows, accepted or not."""
    warnings: tuple[str, ...] = ()
    """Sentences on rows that the operator accepted although they did not fail."""

    @property
    def refusals(self) -> tuple[str, ...]:
        """Messages that refuse the session, one for each failed row that is not accepted."""
        return tuple(
            _refusal_message(failed_check)
            for failed_check in self.failed
            if not failed_check.accepted
        )

    @property
    def accepted(self) -> tuple[FailedCheck, ...]:
        """Failed rows that the operator has accepted for the session."""
        return tuple(failed_check for failed_check in self.failed if failed_check.accepted)

    def require_passed(self) -> None:
        """Raise CheckFailedError unless all failed rows are accepted.

        Raises
        ------
        CheckFailedError
            If a failed row is not accepted; the message names each of them.
        """
        if self.refusals:
            has_unacceptable_failure = not all(
                failed_check.acceptable for failed_check in self.failed
            )
            raise CheckFailedError("\n".join(self.refusals), wrong_use=has_unacceptable_failure)


def run_offline_checks(
    profile: Profile, accepted_row_names: Sequence[str] = ()
) -> OfflineCheckResult:
    """Run the offline checks for a session, and return which rows failed or are accepted.

    Parameters
    ----------
    profile
        Profile of the rig, with the beam of the session.
    accepted_row_names
        Names of rows that may fail in this session.

    Returns
    -------
    OfflineCheckResult
        Failed rows, and warnings.

    Raises
    ------
    UnknownRowError
        If no row has such a name, or its failure cannot be accepted.
    """
    for row_name in accepted_row_names:
        _require_acceptable_name(row_name)
    failed_check_by_row: dict[str, FailedCheck] = {}
    for offline_check in OFFLINE_CHECKS:
        for row in _rows_of_check(offline_check, profile) if offline_check.row_names else ():
            if row.verdict is not CheckResult.FAIL:
                continue
            row_name, names_text = row.name, _failure_text(row)
            if (
                row_name in failed_check_by_row
            ):  # several rows of one name: an EDS file that lacks two objects
                names_text = f"{failed_check_by_row[row_name].text}\n{names_text}"
            failed_check_by_row[row_name] = FailedCheck(
                row_name,
                names_text,
                not offline_check.unacceptable_reason,
                row_name in accepted_row_names,
            )
    needlessly_accepted_names = [
        row_name
        for row_name in dict.fromkeys(accepted_row_names)
        if row_name not in failed_check_by_row
    ]
    return OfflineCheckResult(
        tuple(failed_check_by_row.values()),
        tuple(
            f"--accept {row_name}: it did not fail; nothing was accepted."
            for row_name in needlessly_accepted_names
        ),
    )


def _require_acceptable_name(row_name: str) -> None:
    """Raise UnknownRowError unless a failed check of this name can be accepted by the operator."""
    offline_check = _CHECK_BY_ROW_NAME.get(row_name)
    if offline_check is None:
        raise UnknownRowError(
            f"--accept {row_name[:60]}: no row of rigd check has that name; those that can be "
            f"accepted are {', '.join(ACCEPTABLE_ROW_NAMES)}."
        )
    if offline_check.unacceptable_reason:
        raise UnknownRowError(
            f"--accept {row_name}: a failure of that row cannot be accepted: "
            f"{offline_check.unacceptable_reason}."
        )


def _failure_text(failed_row: CheckRow) -> str:
    """Return the finding of a failed row and its remedy as text for the operator."""
    requirement_text = f" (wanted: {failed_row.wanted})" if failed_row.wanted else ""
    return (
        f"{failed_row.group}, {failed_row.what}: "
        f"{failed_row.found.rstrip('.')}{requirement_text}. {failed_row.detail}"
    ).strip()


def _refusal_message(failed_check: FailedCheck) -> str:
    """Return the message that refuses a session because of a failed row."""
    remedy_text = (
        f" To accept it for one session: --accept {failed_check.name}."
        if failed_check.acceptable
        else ""
    )
    return f"rigd check fails ({failed_check.name}): {failed_check.text}{remedy_text}"
