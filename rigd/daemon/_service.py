"""Service of the daemon: it owns a rig, executes requests and publishes events, without sockets.

Everything runs in the event loop's thread, except slow calls of the rig, which run one after the
other in a worker thread. A stop does not wait for the worker.
"""

import asyncio
import logging
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import asdict
from functools import partial
from math import inf
from pathlib import Path
from typing import TypeVar

from rigd.checks import check_on_paper
from rigd.daemon import _protocol as protocol
from rigd.daemon import background
from rigd.daemon._log import NAME
from rigd.daemon._protocol import CommandError
from rigd.daemon._series import Publish, SeriesReporter, ServedSeries
from rigd.daemon._states import (
    DaemonState,
    DaemonStateMachine,
    Document,
    Peer,
    Transition,
    daemon_document,
    histories,
    peer_document,
    progress_document,
    rig_document,
    signals_document,
    transition_document,
)
from rigd.devices import ActuationTarget, describe_actuation_target
from rigd.errors import UserError
from rigd.profile import Profile
from rigd.runner import ProbeFailedError, Rig, RigError, Series
from rigd.runner.quick_looks import QuickLook, QuickLooks
from rigd.runner.request import remaining_file_text
from rigd.runner.session import SessionFailedError
from rigd.runner.status import RigStatus

POLL_S = 0.2
"""Time between two checks of the rig."""
_SIGNALS_S = 0.05
"""Time from one block of a record's signals to the next."""
_MOST_PREDICTIONS = 4
"""Limit of simultaneous predictions: one runs, the others wait."""
_DEAF_S = 1.5
"""Time without a poll after which the event loop counts as stuck, so that it receives no stop."""
_RATE_POLLS = 10
"""Number of polls over which a rate is measured."""
_SHUTTING_DOWN = "The daemon is being shut down."

T = TypeVar("T")

_log = logging.getLogger(NAME)


class Service:
    """Service that commands a rig; its methods are called from the event loop's thread.

    Parameters
    ----------
    rig
        Rig, not connected yet.
    profile
        Profile of the rig.
    folder
        Folder for session files.
    worker
        Runs the calls of the rig, one at a time.
    publish
        Receives the events for clients that watch.
    moving
        Returns what would move if the rig were connected now.
    fast, live
        Options with which the rig was created.
    quick_looks
        Whether to make a quick look of each session.

    Attributes
    ----------
    controller
        Client that holds control.
    """

    def __init__(
        self,
        rig: Rig,
        profile: Profile,
        folder: Path,
        worker: Executor,
        publish: Publish,
        moving: Callable[[], ActuationTarget],
        *,
        fast: bool = False,
        live: bool = False,
        quick_looks: bool = False,
    ) -> None:
        self._rig = rig
        self._profile = profile
        self._folder = folder
        self._worker = worker
        self._publish = publish
        self._moving = moving
        self._began_moving = moving()
        self._failed_checks = [asdict(each) for each in check_on_paper(profile).failed]
        self._fast = fast
        self._live = live
        self._states = DaemonStateMachine(self._report_transition)
        self._began_utc_ns = time.time_ns()
        self._fault = ""
        """Reason of the last fault, without failures of its reset."""
        self._doing = ""
        self._opened = asyncio.Event()
        """Set after the first attempt to connect."""
        self._stops = 0
        """Number of requested stops."""
        self._closing = False
        self._series: ServedSeries | None = None
        self._quick_looks = QuickLooks(self._report_quick_look) if quick_looks else None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._task: asyncio.Task[None] | None = None
        self._count = 0
        self._listened_s = inf
        self._rig_status: RigStatus | None = None
        self._written: deque[tuple[float, dict[str, int]]] = deque(maxlen=_RATE_POLLS + 1)
        self._signal_watchers: set[Peer] = set()
        self._predictions = 0
        self._predicting = asyncio.Lock()
        self._last_check: Document | None = None
        self.controller: Peer | None = None
        self._page: str | None = None

    @property
    def state(self) -> DaemonState:
        """State of the daemon."""
        return self._states.state

    async def open(self) -> None:
        """Connect the rig; a failure leads to a fault, which the operator can reset."""
        self._doing = "connecting"
        self._loop = asyncio.get_running_loop()
        try:
            await self._connect(reset_fault=False)
        except CommandError:
            pass  # the fault states it
        finally:
            self._doing = ""
            self._opened.set()

    async def run(self) -> None:
        """Poll the rig until cancelled."""
        while True:
            await asyncio.sleep(POLL_S)
            self._listened_s = time.monotonic()
            self.poll_status()
            if self._quick_looks is not None:
                self._quick_looks.poll()
            # Returns at once while the worker thread is busy, so that the polls continue.
            await self.watch()

    async def stream_signals(self) -> None:
        """Publish the signals to subscribed clients until cancelled."""
        while True:
            at_work = self.state in (DaemonState.RUNNING, DaemonState.STOPPING)
            await asyncio.sleep(_SIGNALS_S if at_work else POLL_S)
            self._publish_signals()

    def _publish_signals(self) -> None:
        """Publish the new blocks of signals, if a client has subscribed to them."""
        if not self._signal_watchers:
            return
        series = self._series
        planned = series.planned if series is not None and series.running else None
        for block in self._rig.signals():
            self._publish(
                signals_document(
                    block,
                    self._profile.rig.rate_hz,
                    None if planned is None else planned.frequency_hz(block.last_tick),
                )
            )

    async def close(self, reason: str) -> None:
        """End a running session safely and disconnect the rig."""
        self._closing = True
        self.stop(reason)
        if self._task is not None:
            await asyncio.wait([self._task])
        if self._quick_looks is not None:
            self._quick_looks.close()
        await self._call(self._rig.disconnect)
        if self.state is DaemonState.READY:
            self._states.move(DaemonState.IDLE, reason)

    def set_page(self, address: str | None) -> None:
        """Store the address of the operator's page, without its token; from any thread."""
        self._page = address

    def release(self, peer: Peer) -> None:
        """Release the control of a client that is gone; its sessions continue."""
        self._signal_watchers.discard(peer)
        if self.controller == peer:
            self.controller = None
            _log.info("control: released by %s", peer)

    async def handle(self, request: protocol.AnyRequest, peer: Peer) -> Document:
        """Execute a request and return the reply.

        Raises
        ------
        CommandError
            If it is refused or fails.
        """
        match request:
            case protocol.StatusRequest():
                return self.status()
            case protocol.WatchRequest():
                if request.signals:
                    self._signal_watchers.add(peer)
                return {}
            case protocol.PredictRequest():
                return await self._predict(request)
        _log.info("%s: requested by %s", request.command, peer)
        try:
            return await self._obey(request, peer)
        except CommandError as error:
            _log.warning("%s: refused: %s", request.command, error)
            raise

    async def _obey(self, request: protocol.AnyRequest, peer: Peer) -> Document:
        """Execute a request that may change the rig."""
        if request.controlling:
            self._take_control(peer)
            await self._wait_until_opened(peer)
        if isinstance(request, protocol.StartRequest):
            return await self._start(request)
        if isinstance(request, protocol.StopSessionRequest):
            return self.stop(f"stop requested by {peer}")
        if isinstance(request, protocol.CheckRequest):
            return await self._check_rig()
        if isinstance(request, protocol.TareRequest):
            return await self._measure("tare", self._rig.tare)
        if isinstance(request, protocol.ZeroRequest):
            return await self._measure("zero", self._rig.zero)
        return await self._reset()

    def status(self) -> Document:
        """Return the status of daemon, rig and session."""
        series = self._series
        status = self._rig_status if self._rig.connected else None
        return {
            "daemon": daemon_document(
                self._profile.name,
                str(self._folder),
                moving=self._began_moving.value,
                hardware=self._began_moving is ActuationTarget.HARDWARE,
                moving_text=describe_actuation_target(self._profile.rig, self._began_moving),
                fast=self._fast,
                live=self._live,
                web=self._page,
                calibration=self._rig.calibration,
                quick_looks=self._quick_looks is not None,
                failed_checks=self._failed_checks,
                began_utc_ns=self._began_utc_ns,
            ),
            "state": self.state.value,
            "since_utc_ns": self._states.since_utc_ns,
            "reason": self._states.reason,
            "doing": self._doing,
            "zero_lost": self._rig.zero_lost,
            "controller": peer_document(self.controller),
            "series": None if series is None else series.as_document(),
            "progress": self._progress(),
            "rig": None if status is None else rig_document(status, self._rates()),
            "last_check": self._last_check,
            "history": histories(self._states.history),
        }

    def stop(self, reason: str) -> Document:
        """Request the end of the running series; the reply says whether there is one."""
        self._stops += 1
        series = self._series
        if series is None or not series.running:
            return {"stopping": False}
        if not series.stop.requested:
            series.stop.request()
            if self.state is DaemonState.RUNNING:
                self._states.move(DaemonState.STOPPING, reason)
        return {"stopping": True}

    def poll_status(self) -> None:
        """Read the rig's status, and publish the progress."""
        self._rig_status = status = self._rig.status()
        if status is None:
            self._written.clear()
            return
        self._written.append((time.monotonic(), {t.name: t.written for t in status.topics}))
        progress = self._progress()
        if progress is not None:
            self._publish({"event": "progress", **progress})

    async def watch(self) -> None:
        """Check the rig between sessions."""
        # The command `check` does not use the worker thread.
        busy = self._doing not in ("", "check")
        if (
            busy
            or not self._rig.connected
            or self.state not in (DaemonState.READY, DaemonState.FAULT)
        ):
            return
        try:
            await self._call(self._rig.watch)
        except RigError as error:
            if not self._closing and self.state is DaemonState.READY:
                self._states.move(DaemonState.FAULT, str(error))

    # Commands

    def _take_control(self, peer: Peer) -> None:
        if self.controller is not None and self.controller != peer:
            raise CommandError(
                f"The rig is controlled by {self.controller}, until it is done; watch with rigd "
                "status, and stop with rigd stop."
            )
        if self.controller is None:
            self.controller = peer
            _log.info("control: taken by %s", peer)

    async def _wait_until_opened(self, peer: Peer) -> None:
        """Wait until a daemon that has just started has connected its devices."""
        if self._doing != "connecting":
            return
        stops = self._stops
        await self._opened.wait()
        if self._stops > stops or self.controller != peer:
            raise CommandError("It was stopped before it began.")

    def _check(self, command: str) -> None:
        if self._closing:
            raise CommandError(_SHUTTING_DOWN)
        refusal = self._states.refusal(command)
        if refusal:
            raise CommandError(refusal)
        self._refuse_if_busy()

    def _refuse_if_busy(self) -> None:
        if self._doing:
            raise CommandError(f"The rig is busy ({self._doing}); try again in a moment.")

    async def _predict(self, request: protocol.PredictRequest) -> Document:
        """Predict a session, in parallel to everything else."""
        if self._predictions >= _MOST_PREDICTIONS:
            raise CommandError("Several predictions are running; try again in a moment.")
        job = background.PredictionJob(
            self._profile,
            request.excitation,
            request.parameters,
            request.force,
            request.notes.specimen,
            self._start_rad(),
            tuple(request.accept),
            request.tip_slope_rad,
        )
        self._predictions += 1
        try:
            async with self._predicting:
                return await background.perform(job)
        finally:
            self._predictions -= 1

    async def _check_rig(self) -> Document:
        if self.state in (DaemonState.RUNNING, DaemonState.STOPPING):
            raise CommandError(
                "check needs a rig without a running session: wait for the session to end, or end "
                "it with rigd stop."
            )
        self._refuse_if_busy()
        self._doing = "check"
        try:
            reply = await background.perform(
                background.CheckJob(self._profile, self._rig.calibration)
            )
        finally:
            self._doing = ""
        self._last_check = {"utc_ns": time.time_ns(), "verdict": reply["verdict"]}
        return reply

    async def _start(self, request: protocol.StartRequest) -> Document:
        self._check("start")
        if self._rig.zero_lost:
            raise CommandError(
                "The zero of the angle was lost with the connection, and the limits with it; move "
                "the motor to mid-travel and run rigd zero."
            )
        self._count += 1
        last = self._series
        series = self._series = ServedSeries(self._count, request, running=True)
        self._doing = "planning"
        try:
            job = background.PlanJob(self._profile, request, self._folder, self._start_rad())
            planned = await (background.perform(job) if job.is_heavy else self._call(job.perform))
            if series.stop.requested or self._closing:
                raise CommandError("It was stopped before it began.")
            refusal = self._states.refusal("start")
            if refusal:
                raise CommandError(refusal)
        except Exception:
            self._series = last
            raise
        finally:
            self._doing = ""
        for warning in planned.plan.warnings:
            _log.warning("series %d: %s", series.number, warning)
        series.planned = planned
        times = f", {request.repeat} sessions" if request.repeat > 1 else ""
        self._states.move(DaemonState.RUNNING, f"{series.words} was started{times}")
        self._task = asyncio.create_task(self._follow(series, planned))
        return {"series": series.number, "plan": planned.plan_document()}

    async def _measure(self, name: str, measure: Callable[[], Document]) -> Document:
        self._check(name)
        self._doing = name
        try:
            return await self._call(measure)
        except RigError as error:
            if not self._rig.connected and self.state is DaemonState.READY:
                self._states.move(DaemonState.FAULT, str(error))
            raise CommandError(str(error)) from None
        finally:
            self._doing = ""

    async def _reset(self) -> Document:
        self._check("reset")
        self._doing = "reset"
        try:
            if self._rig.connected:
                try:
                    await self._call(self._rig.watch)
                except RigError:
                    pass  # it is reconnected
                else:
                    self._states.move(DaemonState.READY, "reset by the operator")
                    return {"zero_lost": self._rig.zero_lost}
            if self._closing:
                raise CommandError(_SHUTTING_DOWN)
            fault = self._fault
            self._states.move(DaemonState.IDLE, "reset by the operator")
            await self._connect(reset_fault=True, fault=fault)
        finally:
            self._doing = ""
        return {"zero_lost": self._rig.zero_lost}

    async def _connect(self, *, reset_fault: bool, fault: str = "") -> None:
        """Connect the rig; a failure is reported with the `fault` that was to be reset."""
        try:
            moving = self._moving()
            if moving is not self._began_moving:
                raise RigError(
                    f"{moving.value.capitalize()} would move now, where it was "
                    f"{self._began_moving.value} when the daemon was started; restart the daemon "
                    "if that is intended."
                )
            await self._call(partial(self._rig.connect, moving, reset_fault=reset_fault))
        except RigError as error:
            self._enter_fault(str(error), fault)
            raise CommandError(str(error)) from None
        except Exception as error:
            _log.exception("unexpected error while the rig was being connected")
            await self._disconnect_safely()
            reason = f"The rig could not be connected: unexpected error ({error!r})."
            self._enter_fault(reason, fault)
            raise CommandError(reason) from None
        if self._closing:
            await self._call(self._rig.disconnect)
            raise CommandError(_SHUTTING_DOWN)
        self._states.move(DaemonState.READY, f"{moving.value} is connected")

    def _enter_fault(self, reason: str, fault: str) -> None:
        """Enter the fault state, with the earlier fault if that could not be reset."""
        same = not fault or fault == reason
        self._states.move(DaemonState.FAULT, reason if same else f"{reason} Not reset: {fault}")
        self._fault = fault or reason

    # Series

    def _start_rad(self) -> float:
        """Return the motor's angle from the rig's zero; 0 if unknown."""
        status = self._rig.status()
        return 0.0 if status is None else status.angle_rad

    async def _follow(self, series: ServedSeries, planned: Series) -> None:
        """Run a series to its end, and set the resulting state."""
        fault = ""
        loop = asyncio.get_running_loop()
        try:
            await self._call(partial(self._run_series, series, planned, loop))
        except (UserError, RigError, ProbeFailedError, SessionFailedError) as error:
            series.reason = str(error)
            if not error.wrong_use:
                path = error.path if isinstance(error, SessionFailedError) else None
                fault = series.reason = f"{error} {remaining_file_text(path)}"
        except Exception as error:
            # After an unexpected error everything is switched off, because nothing else may do so.
            _log.exception("unexpected error in a session")
            fault = series.reason = f"The session failed: unexpected error ({error!r})."
            await self._disconnect_safely()
        else:
            last = series.results[-1] if series.results else None
            if last is not None and not last.went_well:
                series.reason = last.reason
                if last.fault:
                    fault = last.reason
        if not self._rig.connected:
            fault = fault or series.reason or "The connection to the devices is lost."
        try:
            self._publish_signals()  # the last signals come before the report of the end
        except Exception:
            _log.exception("the last signals could not be sent")
        series.running = False
        series.failed = bool(fault or (series.reason and not series.stop.requested))
        self._states.move(*series.state_after(fault))
        self._publish({"event": "series", **series.as_document()})

    async def _disconnect_safely(self) -> None:
        """Disconnect the rig, whatever errors occur."""
        try:
            await self._call(self._rig.disconnect)
        except Exception:
            _log.exception("the rig could not be disconnected")

    def _run_series(
        self, series: ServedSeries, planned: Series, loop: asyncio.AbstractEventLoop
    ) -> None:
        """Run the sessions one after the other, in the worker thread."""

        def publish(event: Document) -> None:
            loop.call_soon_threadsafe(self._publish, event)

        reporter = SeriesReporter(series, publish, self._listens)
        try:
            planned.run(
                self._rig,
                series.stop,
                reporter,
                live=self._live,
                listens=self._listens,
                quick_looks=self._quick_looks,
            )
        except SessionFailedError as error:
            reporter.ended(error.result(), look_follows=False)
            raise

    def _listens(self) -> bool:
        """Return whether the event loop can receive a stop; called from the worker thread.

        If it cannot, the session no longer gets the supervisor's heartbeat, and ends.
        """
        return time.monotonic() - self._listened_s < _DEAF_S

    # Reports

    def _progress(self) -> Document | None:
        series, status = self._series, self._rig_status
        if series is None or not series.running or series.planned is None or status is None:
            return None
        rate_hz = None if self._fast else self._profile.rig.rate_hz
        document = progress_document(status, series.planned.ticks, rate_hz)
        return {"session": series.session, "repeat": series.request.repeat, **document}

    def _rates(self) -> dict[str, float | None]:
        """Return the measured rates of all topics, in records per second."""
        if len(self._written) < 2:
            return {}
        (first_s, first), (last_s, last) = self._written[0], self._written[-1]
        return {
            name: max(0, written - first.get(name, 0)) / (last_s - first_s)
            for name, written in last.items()
        }

    def _report_transition(self, transition: Transition) -> None:
        if transition.after is DaemonState.FAULT:
            self._fault = transition.reason
        level = logging.ERROR if transition.after is DaemonState.FAULT else logging.INFO
        _log.log(
            level, "state: %s -> %s: %s", transition.before, transition.after, transition.reason
        )
        self._publish({"event": "state", **transition_document(transition)})

    def _report_quick_look(self, quick_look: QuickLook) -> None:
        """Log and publish a quick look; called in either thread."""
        if self._series is not None:
            quick_look.note(self._series.results)
        for line in quick_look.lines:
            _log.info("%s", line)
        if self._loop is not None:
            self._loop.call_soon_threadsafe(
                self._publish, {"event": "quick_look", **quick_look.as_dict()}
            )

    async def _call(self, function: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._worker, function)
