"""Background jobs of the daemon (predictions, checks, heavy plans), each in a process of its own.

Any client may request a prediction while a session is running. In the daemon's own process such a
job would block the interpreter that supervises the session.
"""

import asyncio
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Final, Protocol, TypeVar

from rigd.checks import run_offline_checks
from rigd.daemon._protocol import CommandError, StartRequest
from rigd.engine.messages import JobPerformed
from rigd.engine.processes import ChildError, ChildProcess, SupervisorConnection
from rigd.engine.workers import PLAN, PREDICTION, Worker
from rigd.errors import RigdError
from rigd.excitation import OptionValue
from rigd.profile import Profile, with_specimen
from rigd.runner import Series, with_tip_slope
from rigd.runner.planning import excitation_for, largest_amplitude, plan_document, predict_session
from rigd.runner.request import NoRoomError
from rigd.runtime import ignore_end_signals as ignore_signals

_JOB_TIMEOUT_S: Final = 50.0
"""Maximum time in seconds for a job, below the client's timeout so that the client gets a reply."""
_MAX_LIGHT_RECORD_S: Final = 300.0
"""Duration in seconds of the longest record that is light to plan, in half a second and 100 MB."""

Result = TypeVar("Result")
Result_co = TypeVar("Result_co", covariant=True)


class BackgroundJob(Protocol[Result_co]):
    """Job of the daemon that is performed in a process of its own."""

    worker: ClassVar[Worker]
    """Process that performs the job: only a `PREDICTION` may run during a session."""

    def perform(self) -> Result_co:
        """Perform the job and return its result; the client receives the text of a RigdError."""


@dataclass(frozen=True, slots=True)
class PredictionJob:
    """Job that predicts a session by `rigd.runner.planning.predict_session`."""

    worker: ClassVar[Worker] = PREDICTION

    profile: Profile
    """Profile of the rig."""
    excitation_kind: str
    """Kind of the excitation, such as "chirp"."""
    parameters: Mapping[str, OptionValue]
    """Parameters of the excitation by their names."""
    allows_saturation: bool
    """Whether the torques of motor and sensor may be clipped."""
    specimen: str
    """Name of the specimen, or empty for the beam of the profile."""
    start_angle_rad: float = 0.0
    """Motor angle at the start, relative to the rig's zero."""
    accepted_row_names: tuple[str, ...] = ()
    """Names of rows of `rigd check` that may fail."""
    tip_slope_rad: float | None = None
    """Maximum tip slope of an identification, or None for the limit of the profile."""

    def perform(self) -> dict[str, Any]:
        """Return the plan and the largest possible amplitude as a dictionary for JSON."""
        profile = with_specimen(self.profile, self.specimen)
        profile = with_tip_slope(profile, self.tip_slope_rad)
        excitation = excitation_for(
            profile, self.excitation_kind, self.parameters, self.start_angle_rad
        )
        plan = predict_session(
            profile,
            excitation,
            allows_saturation=self.allows_saturation,
            accepted_row_names=self.accepted_row_names,
        )
        return {
            "plan": plan_document(profile, excitation, plan),
            "largest_amplitude_rad": largest_amplitude(
                profile, excitation, allows_saturation=self.allows_saturation
            ),
        }


@dataclass(frozen=True, slots=True)
class CheckJob:
    """Job that checks a rig by `rigd.checks.check_without_devices`, while the daemon uses it."""

    worker: ClassVar[Worker] = PREDICTION
    profile: Profile
    """Profile of the rig."""
    calibration: Mapping[str, Any] | None
    """Calibration that the connected sensor reported, or None if it is not connected."""

    def perform(self) -> dict[str, Any]:
        """Return the results of all checks and the verdict as a dictionary for JSON."""
        from rigd.check_rows import overall_verdict
        from rigd.checks import check_without_devices

        check_rows = check_without_devices(self.profile, self.calibration)
        return {
            "rows": [
                {
                    "what": f"{row.group}: {row.what}",
                    "status": row.verdict.value,
                    "text": f"{row.found} (wanted: {row.wanted})" if row.wanted else row.found,
                    "remedy": row.detail,
                    "name": row.name,
                }
                for row in check_rows
            ],
            "verdict": overall_verdict(check_rows),
        }


@dataclass(frozen=True, slots=True)
class PlanJob:
    """Job that plans a series of sessions as a `rigd.runner.Series`."""

    worker: ClassVar[Worker] = PLAN

    profile: Profile
    """Profile of the rig."""
    request: StartRequest
    """Request of the client."""
    folder: Path
    """Folder of the session files."""
    start_angle_rad: float
    """Motor angle at the start, relative to the rig's zero."""

    @property
    def is_heavy(self) -> bool:
        """Whether the planning may take more than a second or much memory.

        This is assumed for an excitation from a file, and for a long record.
        """
        parameter_items = self.request.parameters.items()
        total_duration_s = sum(
            parameter_value
            for parameter_name, parameter_value in parameter_items
            if parameter_name.endswith("_s")
        )
        return total_duration_s > _MAX_LIGHT_RECORD_S or any(
            isinstance(parameter_value, Path) for _, parameter_value in parameter_items
        )

    def perform(self) -> Series:
        """Return the planned series; raise CommandError if it is refused."""
        request = self.request
        notes = request.notes.as_metadata()
        try:
            profile = with_specimen(self.profile, notes.get("specimen", ""))
            run_offline_checks(profile, request.accept).require_passed()
            profile = with_tip_slope(profile, request.tip_slope_rad)
            return Series(
                profile,
                excitation_for(
                    profile, request.excitation, request.parameters, self.start_angle_rad
                ),
                self.folder,
                session_count=request.repeat,
                notes=notes,
                allows_saturation=request.force,
                accepted_row_names=request.accept,
                watch_fit=request.watch_fit,
            )
        except NoRoomError as error:  # the same request may succeed later
            raise CommandError(str(error)) from error
        except RigdError as error:
            raise CommandError(str(error), wrong_use=error.wrong_use) from error
        except MemoryError:
            raise CommandError("There is not enough memory to plan such a session.") from None


async def perform(job: BackgroundJob[Result]) -> Result:
    """Perform a job in a process of its own, and return its result.

    The event loop is not blocked meanwhile.

    Parameters
    ----------
    job
        Job to perform.

    Raises
    ------
    CommandError
        If the job is refused, fails, or takes longer than 50 s.
    """
    try:
        child_process = ChildProcess(job.worker)
    except ChildError as error:
        raise CommandError(f"No process can be started for it ({error.system_reason}).") from None
    try:
        await asyncio.to_thread(child_process.start, job)
        performed_job = await asyncio.wait_for(child_process.receive(), _JOB_TIMEOUT_S)
    except TimeoutError:
        raise CommandError(f"It takes longer than {_JOB_TIMEOUT_S:g} s; check CPU load.") from None
    except ChildError:
        await asyncio.to_thread(child_process.stop)
        raise CommandError(f"Its process ended with exit code {child_process.exit_code}.") from None
    finally:
        await asyncio.to_thread(child_process.stop)
    assert isinstance(performed_job, JobPerformed)
    if isinstance(performed_job.result, CommandError):
        raise performed_job.result
    job_result: Result = performed_job.result
    return job_result


def main() -> None:
    """Receive a job from the daemon, perform it, and send the daemon the result or an error."""
    ignore_signals()
    daemon_connection = SupervisorConnection()
    job: BackgroundJob[object] = daemon_connection.receive_job()
    result_or_error: object
    try:
        result_or_error = job.perform()
    except RigdError as error:
        result_or_error = CommandError(str(error), wrong_use=error.wrong_use)
    except MemoryError:
        result_or_error = CommandError(
            "There is not enough free memory to predict such a session; shorten it, or close other "
            "programs.",
            wrong_use=True,
        )
    if isinstance(result_or_error, dict):
        json.dumps(result_or_error, allow_nan=False)  # raises if the reply is not JSON
    daemon_connection.send(JobPerformed(result_or_error))


if __name__ == "__main__":
    main()
