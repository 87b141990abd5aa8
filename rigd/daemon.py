"""The supervisor: starts the processes of a session, brings them together, and ends them.

It moves nothing itself. It opens the file before the drive is enabled, lets tick 0 happen when the
recorder is ready, shows the progress, passes a stop on, and closes the file with the outcome.
"""

import json
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from rigd import __version__
from rigd.crew import Crew
from rigd.devices.registry import simulated_differently
from rigd.engine.board import Phase, Stop, Word
from rigd.engine.events import Event, read_events
from rigd.engine.jobs import ControlJob, RecorderJob
from rigd.engine.process import ChildError, Message
from rigd.engine.ring import Observer
from rigd.engine.signals import StopRequest
from rigd.excitation import Excitation
from rigd.live.job import LiveJob
from rigd.profile import Profile
from rigd.session.writer import PART_SUFFIX

_POLL_S = 0.05
_PATIENCE_S = 5.0
_LIVE_PATIENCE_S = 10.0
_SLOW_PATIENCE_S = 30.0
"""For connecting devices and for switching them off, which may take its time."""
_TORQUE_PHASES = (Phase.SETTLING, Phase.READY, Phase.RUNNING, Phase.RETURNING)


class SessionFailedError(Exception):
    """A session could not be run or ended; the message says why, in the operator's words."""


@dataclass(frozen=True, slots=True)
class Order:
    """What the operator asked for."""

    profile: Profile
    excitation: Excitation
    path: Path
    fast: bool = False
    notes: tuple[tuple[str, str], ...] = ()
    """Operator, specimen, note: metadata as given."""


@dataclass(frozen=True, slots=True)
class SessionResult:
    """How a session ended."""

    path: Path | None
    """None: it ended before tick 0, and there is no file."""
    outcome: str
    reason: str
    scheduled: int
    recorded: int
    missed: int
    late: int
    lost: int
    live_dropped: int = 0
    """Samples that the live view did not get."""

    @property
    def went_well(self) -> bool:
        """Whether nothing at all is to be said against it."""
        return self.outcome == "complete" and not self.reason


@dataclass(frozen=True, slots=True)
class SessionProgress:
    """Where a running session is."""

    phase: Phase
    tick: int
    missed: int
    late: int


Watcher = Callable[[SessionProgress, list[Event]], None]


def run_session(order: Order, crew: Crew, stop: StopRequest, watcher: Watcher) -> SessionResult:
    """Run one session in the processes of `crew`.

    Parameters
    ----------
    order
        What to run, already checked against the profile's limits.
    crew
        Freshly started processes and their memory laid out; they serve one session only.
    stop
        The operator's, from now on passed on to the session.
    watcher
        Called some twenty times a second with the progress and the events since the last call.

    Returns
    -------
    SessionResult

    Raises
    ------
    SessionFailedError
        If the file cannot be opened or written, or a process died. The drive is off when the
        crew has been left; :func:`what_is_kept` then tells what there is of the session.
    """
    session = _Session(order, crew, watcher)
    stop.on_request = session.stop
    if stop.requested:
        session.stop()
    try:
        return session.run()
    except ChildError as error:
        raise SessionFailedError(str(error)) from None
    finally:
        stop.on_request = _nothing


class _Session:
    def __init__(self, order: Order, crew: Crew, watcher: Watcher) -> None:
        self._order = order
        self._crew = crew
        self._board = crew.channels.board
        self._events = Observer(crew.channels.events)
        self._watcher = watcher

    def stop(self) -> None:
        self._board[Word.STOP] = Stop.OPERATOR

    def run(self) -> SessionResult:
        order, crew = self._order, self._crew
        crew.recorder.start(RecorderJob(order.path, crew.channels.specs))
        self._ask_recorder("opened")
        crew.control.start(
            ControlJob(order.profile, order.excitation, crew.channels.specs, order.fast)
        )
        answer = self._listen_to_control()
        if "ready" in answer:
            crew.recorder.send(begin=self._header(answer))
            self._ask_recorder("armed")
            self._board[Word.GO] = 1
            answer = self._listen_to_control()
        return self._close(answer)

    def _listen_to_control(self) -> Message:
        """Wait for the control process's next message, watching the others meanwhile."""
        recorder_lost: str | None = None
        deadline, phase = 0.0, -1
        while True:
            try:
                answer = self._crew.control.poll(_POLL_S)
            except ChildError as error:
                return self._control_died(str(error))
            self._report()
            if self._board[Word.STOP] == Stop.NO or self._board[Word.PHASE] != phase:
                phase = self._board[Word.PHASE]
                patience_s = _PATIENCE_S if phase in _TORQUE_PHASES else _SLOW_PATIENCE_S
                deadline = time.monotonic() + patience_s
            elif answer is None and time.monotonic() > deadline:
                # It hangs: a drive's own watchdog is all that is left, and this calls it.
                self._crew.control.kill()
                return self._control_died(
                    f"The control process did not stop within {patience_s:g} s and was killed."
                )
            if answer is not None:
                if recorder_lost is not None:
                    raise SessionFailedError(recorder_lost)
                return answer
            if recorder_lost is None:
                recorder_lost = self._recorder_trouble()
                if recorder_lost is not None:
                    self._board[Word.STOP] = Stop.NO_RECORDER

    def _control_died(self, reason: str) -> Message:
        """Say what the control process would have said, as far as the board tells."""
        board = self._board
        counts = {
            "scheduled": board[Word.SCHEDULED],
            "missed": board[Word.MISSED],
            "late": board[Word.LATE],
        }
        return {"finished": "fault", "reason": reason, "counts": counts, "results": {}}

    def _recorder_trouble(self) -> str | None:
        try:
            message = self._crew.recorder.poll(0.0)
        except ChildError as error:
            return str(error)
        return None if message is None else str(message.get("error", message))

    def _ask_recorder(self, expected: str) -> Message:
        message = self._crew.recorder.poll(_PATIENCE_S)
        if message is None:
            raise SessionFailedError(
                f"The recorder process does not answer within {_PATIENCE_S:g} s."
            )
        if "error" in message:
            raise SessionFailedError(message["error"])
        if expected not in message:
            raise SessionFailedError(f"The recorder process answers {message}.")
        return message

    def _report(self) -> None:
        board = self._board
        progress = SessionProgress(
            Phase(board[Word.PHASE]), board[Word.SCHEDULED], board[Word.MISSED], board[Word.LATE]
        )
        self._watcher(progress, read_events(self._events.take(16)))

    def _header(self, ready: Message) -> Message:
        order = self._order
        rig = order.profile.rig
        metadata = {
            "id": order.path.stem,
            "rate_hz": repr(rig.rate_hz),
            "excitation": order.excitation.kind,
            **{name: _text(value) for name, value in order.excitation.parameters.items()},
            "beam_length_m": repr(rig.beam.length_m),
            "beam_density_kg_per_m": repr(rig.beam.density_kg_per_m),
            "beam_bending_stiffness_n_m2": repr(rig.beam.bending_stiffness_n_m2),
            "tool_inertia_kg_m2": repr(rig.sensor.tool_inertia_kg_m2),
            "angle_delay_s": repr(rig.encoder.delay_s),
            "torque_delay_s": repr(rig.sensor.delay_s),
            "actuation_delay_s": repr(rig.actuation.delay_s),
            "sensor_projection": ",".join(map(repr, rig.sensor.projection)),
            "drive": rig.devices.drive,
            "sensor": rig.devices.sensor,
            "simulated": str(ready["simulated"]).lower(),
            "profile": order.profile.name,
            "software": f"rigd {__version__}",
            "host": platform.node(),
            **{f"realtime_{name}": value for name, value in ready["realtime"].items()},
            **ready["ready"],
            **dict(order.notes),
        }
        differences = simulated_differently(rig)
        if differences:
            metadata["simulated_differently"] = "; ".join(differences)
        if rig.acquisition is not None:
            metadata["acquisition_mode"] = rig.acquisition.mode
            metadata["acquisition_deadline_s"] = repr(rig.acquisition.deadline_us * 1e-6)
        if rig.ati_serial is not None:
            metadata["sensor_filter"] = rig.ati_serial.filter
            metadata["sensor_filter_delay_s"] = repr(rig.ati_serial.filter_delay_s(rig.rate_hz))
        if rig.devices.drive == "sim" and rig.simulation is not None:
            metadata["simulation_seed"] = str(rig.simulation.seed)
        return {
            "metadata": metadata,
            "segments": order.excitation.segments,
            "attachments": {
                "profile.toml": order.profile.text,
                "calibration.json": json.dumps(ready["calibration"], indent=1),
            },
        }

    def _close(self, finished: Message) -> SessionResult:
        self._report()
        counts = finished["counts"]
        outcome = {
            "outcome": finished["finished"],
            "reason": finished["reason"],
            **{name: str(count) for name, count in counts.items()},
            **finished["results"],
        }
        self._crew.recorder.send(close=outcome)
        closed = self._crew.recorder.poll(2 * _PATIENCE_S)
        if closed is None:
            raise SessionFailedError("The recorder process does not close the file.")
        if "error" in closed:
            raise SessionFailedError(closed["error"])
        # What the recorder counted in the file has the last word.
        counts = {"scheduled": 0, "missed": 0, "late": 0} | counts | closed.get("counts", {})
        return SessionResult(
            path=Path(closed["closed"]) if "closed" in closed else None,
            outcome=finished["finished"],
            reason=finished["reason"],
            scheduled=counts["scheduled"],
            recorded=counts.get("recorded", 0),
            missed=counts["missed"],
            late=counts["late"],
            lost=counts.get("lost", 0),
            live_dropped=self._board[Word.LIVE_DROPPED],
        )


def start_live(crew: Crew, order: Order) -> str:
    """Hand the publisher its job and return the address of the view, or why there is none."""
    assert crew.publisher is not None
    specs = crew.channels.specs
    crew.publisher.start(
        LiveJob(
            samples=specs.samples,
            board_fd=specs.board_fd,
            name=order.path.stem,
            rate_hz=order.profile.rig.rate_hz,
        )
    )
    try:
        answer = crew.publisher.poll(_LIVE_PATIENCE_S) or {"error": "it does not answer."}
    except ChildError as error:
        answer = {"error": str(error)}
    if "url" in answer:
        return f"Live view: {answer['url']}"
    return f"No live view: {answer['error']} The session goes on without it."


def what_is_kept(path: Path) -> str:
    """Say what there is of a session that failed, once its processes have ended."""
    part = path.with_name(path.name + PART_SUFFIX)
    if part.exists():
        return f"What was recorded is in {part}."
    return f"Its file is {path}." if path.exists() else "There is no file of it."


def choose_path(folder: Path, kind: str, number: int | None = None) -> Path:
    """Name a new session file: time, excitation, and its number in a series.

    Nothing is created; the recorder refuses a name that is taken.
    """
    stem = f"{datetime.now(UTC):%Y%m%d-%H%M%S}-{kind}"
    if number is not None:
        stem += f"-{number:02d}"
    path, extra = folder / f"{stem}.mcap", 1
    while path.exists() or path.with_name(path.name + PART_SUFFIX).exists():
        extra += 1
        path = folder / f"{stem}_{extra}.mcap"
    return path


def with_seed(profile: Profile, seed: int) -> Profile:
    """Return the profile of a simulated rig with another seed for its noise."""
    assert profile.rig.simulation is not None
    simulation = replace(profile.rig.simulation, seed=seed)
    return replace(profile, rig=replace(profile.rig, simulation=simulation))


def _nothing() -> None:
    """Answer a stop request that comes between two sessions: its being noted is enough."""


def _text(value: float | str) -> str:
    return value if isinstance(value, str) else repr(value)
