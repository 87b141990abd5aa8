"""Background jobs of the daemon: predictions, checks and heavy plans, each in its own process.

They take processor time and memory, and any client may request a prediction while a session runs.
In the daemon's own process they would block the interpreter that supervises the session. Their own
process has the lowest priority of an ordinary program, and a limited fraction of the free memory.
"""

import asyncio
import json
import os
import pickle
import resource
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Final, Protocol, TypeVar

from rigd.checks import check_on_paper
from rigd.daemon._protocol import CommandError, StartRequest
from rigd.errors import RigdError
from rigd.excitation import Value
from rigd.profile import Profile, with_specimen
from rigd.runner import Series, with_tip_slope
from rigd.runner.planning import excitation_for, largest_amplitude, plan_document, predict_session
from rigd.runner.request import NoRoomError
from rigd.runtime import OWN_PYTHON, SINGLE_THREADED, prefer_oom_kill

_PATIENCE_S: Final = 50.0
"""Less than the client's timeout, so that the client gets a reply."""
_MOST_BYTES: Final = 4 << 30
_LEAST_BYTES: Final = 256 << 20
"""A session of two minutes needs 180 MiB, of which 120 MiB are the program."""
_MEMORY_FRACTION: Final = 0.25
"""Fraction of the available memory: only the control process of a session locks its memory."""
_LOWEST_PRIORITY: Final = 19
_LIGHT_S: Final = 300.0
"""Longest record that is planned in half a second and 100 MB."""

Done = TypeVar("Done")
Done_co = TypeVar("Done_co", covariant=True)


class BackgroundJob(Protocol[Done_co]):
    """A job that runs in its own process."""

    during_sessions: ClassVar[bool]
    """Whether it may run during a session, with lower priority."""

    def perform(self) -> Done_co:
        """Return the result; an error of the rig goes to the client."""


@dataclass(frozen=True, slots=True)
class PredictionJob:
    """Prediction of a session, by `rigd.runner.planning.predict_session`."""

    during_sessions: ClassVar[bool] = True

    profile: Profile
    """Rig of the session."""
    excitation: str
    """Name of the excitation."""
    parameters: Mapping[str, Value]
    """Its options."""
    force: bool
    """Whether torques may be clipped."""
    specimen: str
    """Name of the specimen; empty: the profile's."""
    start_rad: float = 0.0
    """Angle of the motor from the rig's zero."""
    accept: tuple[str, ...] = ()
    """Names of rows of `rigd check` that may fail."""
    tip_slope_rad: float | None = None
    """Largest slope of the tip in an identification; None: the profile's."""

    def perform(self) -> dict[str, Any]:
        """Return the prediction for the reply."""
        profile = with_specimen(self.profile, self.specimen)
        profile = with_tip_slope(profile, self.tip_slope_rad)
        excitation = excitation_for(profile, self.excitation, self.parameters, self.start_rad)
        plan = predict_session(profile, excitation, force=self.force, accept=self.accept)
        return {
            "plan": plan_document(profile, excitation, plan),
            "largest_amplitude_rad": largest_amplitude(profile, excitation, force=self.force),
        }


@dataclass(frozen=True, slots=True)
class CheckJob:
    """Check of a rig whose devices the daemon owns, by `rigd.checks.check_without_devices`."""

    during_sessions: ClassVar[bool] = True
    profile: Profile
    """Rig to check."""
    calibration: Mapping[str, Any] | None
    """Calibration that the connected sensor reported; None: the devices are not connected."""

    def perform(self) -> dict[str, Any]:
        """Return the rows and the verdict for the reply."""
        from rigd.checks import check_without_devices
        from rigd.checks.rows import overall

        rows = check_without_devices(self.profile, self.calibration)
        return {
            "rows": [
                {
                    "what": f"{row.group}: {row.what}",
                    "status": row.verdict.value,
                    "text": f"{row.found} (wanted: {row.wanted})" if row.wanted else row.found,
                    "remedy": row.detail,
                }
                for row in rows
            ],
            "verdict": overall(rows),
        }


@dataclass(frozen=True, slots=True)
class PlanJob:
    """Plan of sessions, a `rigd.runner.Series`."""

    during_sessions: ClassVar[bool] = False

    profile: Profile
    """Rig of the sessions."""
    request: StartRequest
    """Request of the client."""
    folder: Path
    """Folder for the files."""
    start_rad: float
    """Angle of the motor from the rig's zero."""

    @property
    def is_heavy(self) -> bool:
        """Whether it may need over a second or much memory, as for a file or a long record."""
        values = self.request.parameters.items()
        long_s = sum(value for name, value in values if name.endswith("_s"))
        return long_s > _LIGHT_S or any(isinstance(value, Path) for _, value in values)

    def perform(self) -> Series:
        """Return the series, after checking that it may run."""
        request = self.request
        notes = request.notes.as_metadata()
        try:
            profile = with_specimen(self.profile, notes.get("specimen", ""))
            check_on_paper(profile, request.accept).require()
            profile = with_tip_slope(profile, request.tip_slope_rad)
            return Series(
                profile,
                excitation_for(profile, request.excitation, request.parameters, self.start_rad),
                self.folder,
                repeat=request.repeat,
                notes=notes,
                force=request.force,
                accept=request.accept,
                watch_fit=request.watch_fit,
            )
        except NoRoomError as error:  # the same request may succeed later
            raise CommandError(str(error)) from error
        except RigdError as error:
            raise CommandError(str(error), wrong_use=error.wrong_use) from error
        except MemoryError:
            raise CommandError("There is not enough memory to plan such a session.") from None


async def perform(job: BackgroundJob[Done]) -> Done:
    """Run a job in its own process and return its result, without blocking the event loop.

    Parameters
    ----------
    job
        Job to run.

    Raises
    ------
    CommandError
        If it is refused, fails, or takes longer than 50 s.
    """
    try:
        process = await asyncio.create_subprocess_exec(
            *(*OWN_PYTHON, "-m", "rigd.daemon.background"),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=os.environ | SINGLE_THREADED,
        )
    except OSError as error:
        raise CommandError(f"No process can be started for it ({error.strerror}).") from None
    try:
        output, _ = await asyncio.wait_for(process.communicate(pickle.dumps(job)), _PATIENCE_S)
        answer = pickle.loads(output)
    except TimeoutError:
        raise CommandError(f"It takes longer than {_PATIENCE_S:g} s; check CPU load.") from None
    except (EOFError, pickle.UnpicklingError):
        raise CommandError(f"Its process ended with exit code {process.returncode}.") from None
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    if isinstance(answer, CommandError):
        raise answer
    done: Done = answer
    return done


def main() -> None:
    """Run the job from standard input, and write the result or the error to standard output.

    Unpickling is safe, because this program writes both ends.
    """
    prefer_oom_kill()
    most_bytes = _memory_limit()
    resource.setrlimit(resource.RLIMIT_AS, (most_bytes, most_bytes))
    job = pickle.load(sys.stdin.buffer)
    if job.during_sessions:
        os.setpriority(os.PRIO_PROCESS, 0, _LOWEST_PRIORITY)
    try:
        answer = job.perform()
    except RigdError as error:
        answer = CommandError(str(error), wrong_use=error.wrong_use)
    except MemoryError:
        answer = CommandError(
            "There is not enough free memory to predict such a session; shorten it, or close other "
            "programs.",
            wrong_use=True,
        )
    if isinstance(answer, dict):
        json.dumps(answer, allow_nan=False)  # raises if the reply is not JSON
    pickle.dump(answer, sys.stdout.buffer)


def _memory_limit(meminfo: Path = Path("/proc/meminfo")) -> int:
    """Return the limit of a job's address space in bytes."""
    text = meminfo.read_text()
    available = int(text.partition("MemAvailable:")[2].split()[0]) * 1024
    return int(min(max(_MEMORY_FRACTION * available, _LEAST_BYTES), _MOST_BYTES))


if __name__ == "__main__":
    main()
