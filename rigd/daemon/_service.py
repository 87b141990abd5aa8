"""Service of the daemon: it owns a rig, obeys requests, and publishes events. No sockets here.

Everything runs in one thread but the calls of the rig that take their time, which run one after the
other in a second one. A stop does not wait for that one.
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
from rigd.daemon._series import Publish, SeriesTeller, ServedSeries
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
from rigd.devices import WhatMoves, what_moves
from rigd.errors import UserError
from rigd.profile import Profile
from rigd.runner import ProbeFailedError, Rig, RigError, Series
from rigd.runner.quick_looks import QuickLook, QuickLooks
from rigd.runner.request import what_is_kept
from rigd.runner.session import SessionFailedError
from rigd.runner.status import RigStatus

LOOK_S = 0.2
"""Time between two checks of the rig."""
_SIGNALS_S = 0.05
"""Time from one block of a record's signals to the next."""
_MOST_PREDICTIONS = 4
"""At a time: one is made, the others wait."""
_DEAF_S = 1.5
"""Time without a look after which the event loop counts as stuck, and hears no stop."""
_RATE_LOOKS = 10
"""Number of looks over which a rate is measured."""
_SHUTTING_DOWN = "The daemon is being shut down."

T = TypeVar("T")

_log = logging.getLogger(NAME)


class Service:
    """A rig under command; all methods are called from the event loop's thread.

    Parameters
    ----------
    rig
        Rig to own; not connected yet.
    profile
        Profile of the rig.
    folder
        Folder for session files.
    worker
        Runs the calls of the rig, one at a time.
    publish
        Takes the events for clients that watch.
    moving
        Says what would move if the rig were connected now.
    fast, live
        Options with which the rig was made.
    look
        Take a quick look at each session.

    Attributes
    ----------
    controller
        The client that holds control.
    """

    def __init__(
        self,
        rig: Rig,
        profile: Profile,
        folder: Path,
        worker: Executor,
        publish: Publish,
        moving: Callable[[], WhatMoves],
        *,
        fast: bool = False,
        live: bool = False,
        look: bool = False,
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
        self._states = DaemonStateMachine(self._tell_transition)
        self._began_utc_ns = time.time_ns()
        self._fault = ""
        """Why it went into fault last, but for what failed in resetting it."""
        self._doing = ""
        self._opened = asyncio.Event()
        """Set once the first connection has been tried."""
        self._stops = 0
        """Number of stops that were asked for."""
        self._closing = False
        self._series: ServedSeries | None = None
        self._looks = QuickLooks(self._tell_look) if look else None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._task: asyncio.Task[None] | None = None
        self._count = 0
        self._listened_s = inf
        self._look: RigStatus | None = None
        self._written: deque[tuple[float, dict[str, int]]] = deque(maxlen=_RATE_LOOKS + 1)
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
        """Connect the rig; a failure leaves a fault, which an operator may reset."""
        self._doing = "connecting"
        self._loop = asyncio.get_running_loop()
        try:
            await self._connect(reset_fault=False)
        except CommandError:
            pass  # the fault says it
        finally:
            self._doing = ""
            self._opened.set()

    async def attend(self) -> None:
        """Watch over the rig, until cancelled."""
        while True:
            await asyncio.sleep(LOOK_S)
            self._listened_s = time.monotonic()
            self.look()
            if self._looks is not None:
                self._looks.attend()
            # Not waited for: another look is due while the second thread is busy.
            await self.watch()

    async def tell_signals(self) -> None:
        """Publish the signals to those who want them, until cancelled."""
        while True:
            at_work = self.state in (DaemonState.RUNNING, DaemonState.STOPPING)
            await asyncio.sleep(_SIGNALS_S if at_work else LOOK_S)
            self._publish_signals()

    def _publish_signals(self) -> None:
        """Publish what has come of the signals, if a client has subscribed to them."""
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
        """End a running session safely and let the rig go."""
        self._closing = True
        self.stop(reason)
        if self._task is not None:
            await asyncio.wait([self._task])
        if self._looks is not None:
            self._looks.close()
        await self._call(self._rig.disconnect)
        if self.state is DaemonState.READY:
            self._states.move(DaemonState.IDLE, reason)

    def set_page(self, address: str | None) -> None:
        """Take note of where the operator's page is, without its token; from any thread."""
        self._page = address

    def release(self, peer: Peer) -> None:
        """Take control from a client that is gone; what it started goes on."""
        self._signal_watchers.discard(peer)
        if self.controller == peer:
            self.controller = None
            _log.info("control: released by %s", peer)

    async def handle(self, request: protocol.AnyRequest, peer: Peer) -> Document:
        """Obey a request.

        Raises
        ------
        CommandError
            If it is refused, or fails.
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
        _log.info("%s: asked by %s", request.command, peer)
        try:
            return await self._obey(request, peer)
        except CommandError as error:
            _log.warning("%s: refused: %s", request.command, error)
            raise

    async def _obey(self, request: protocol.AnyRequest, peer: Peer) -> Document:
        """Obey a request that may change something."""
        if request.controlling:
            self._take_control(peer)
            await self._wait_until_opened(peer)
        if isinstance(request, protocol.StartRequest):
            return await self._start(request)
        if isinstance(request, protocol.StopSessionRequest):
            return self.stop(f"stop asked for by {peer}")
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
        look = self._look if self._rig.connected else None
        return {
            "daemon": daemon_document(
                self._profile.name,
                str(self._folder),
                moving=self._began_moving.value,
                hardware=self._began_moving is WhatMoves.HARDWARE,
                told=what_moves(self._profile.rig, self._began_moving),
                fast=self._fast,
                live=self._live,
                web=self._page,
                calibration=self._rig.calibration,
                quick_looks=self._looks is not None,
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
            "rig": None if look is None else rig_document(look, self._rates()),
            "last_check": self._last_check,
            "history": histories(self._states.history),
        }

    def stop(self, reason: str) -> Document:
        """Ask for the end of what runs; the answer says whether there was anything."""
        self._stops += 1
        series = self._series
        if series is None or not series.running:
            return {"stopping": False}
        if not series.stop.requested:
            series.stop.request()
            if self.state is DaemonState.RUNNING:
                self._states.move(DaemonState.STOPPING, reason)
        return {"stopping": True}

    def look(self) -> None:
        """Read the rig's status, and publish the progress."""
        self._look = look = self._rig.status()
        if look is None:
            self._written.clear()
            return
        self._written.append((time.monotonic(), {t.name: t.written for t in look.topics}))
        progress = self._progress()
        if progress is not None:
            self._publish({"event": "progress", **progress})

    async def watch(self) -> None:
        """Check whether the rig is well between sessions."""
        # A check asks nothing of the rig, and the thread of its calls is free.
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
        """Wait for the devices of a daemon that has just been started."""
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
        """Predict a session, whatever else is being done."""
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
            told = await background.perform(
                background.CheckJob(self._profile, self._rig.calibration)
            )
        finally:
            self._doing = ""
        self._last_check = {"utc_ns": time.time_ns(), "verdict": told["verdict"]}
        return told

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
        """Connect the rig; if that fails, the `fault` that was to be reset is told still."""
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
            self._fail_again(str(error), fault)
            raise CommandError(str(error)) from None
        except Exception as error:
            _log.exception("unexpected error while the rig was being connected")
            await self._let_go()
            reason = f"The rig could not be connected: unexpected error ({error!r})."
            self._fail_again(reason, fault)
            raise CommandError(reason) from None
        if self._closing:
            await self._call(self._rig.disconnect)
            raise CommandError(_SHUTTING_DOWN)
        self._states.move(DaemonState.READY, f"{moving.value} is connected")

    def _fail_again(self, reason: str, fault: str) -> None:
        """Go into fault, with what came before it if that could not be reset."""
        same = not fault or fault == reason
        self._states.move(DaemonState.FAULT, reason if same else f"{reason} Not reset: {fault}")
        self._fault = fault or reason

    # Series

    def _start_rad(self) -> float:
        """Return where the motor stands, from the rig's zero; 0 while that is not known."""
        status = self._rig.status()
        return 0.0 if status is None else status.angle_rad

    async def _follow(self, series: ServedSeries, planned: Series) -> None:
        """Run a series to its end, whatever that is."""
        fault = ""
        loop = asyncio.get_running_loop()
        try:
            await self._call(partial(self._run_series, series, planned, loop))
        except (UserError, RigError, ProbeFailedError, SessionFailedError) as error:
            series.reason = str(error)
            if not error.wrong_use:
                path = error.path if isinstance(error, SessionFailedError) else None
                fault = series.reason = f"{error} {what_is_kept(path)}"
        except Exception as error:
            # Nobody may be left to switch off: what cannot be explained ends with everything off.
            _log.exception("unexpected error in a session")
            fault = series.reason = f"The session failed: unexpected error ({error!r})."
            await self._let_go()
        else:
            last = series.results[-1] if series.results else None
            if last is not None and not last.went_well:
                series.reason = last.reason
                if last.fault:
                    fault = last.reason
        if not self._rig.connected:
            fault = fault or series.reason or "The connection to the devices is lost."
        try:
            self._publish_signals()  # the last ones come before the end is told
        except Exception:
            _log.exception("the last signals could not be sent")
        series.running = False
        series.failed = bool(fault or (series.reason and not series.stop.requested))
        self._states.move(*series.state_after(fault))
        self._publish({"event": "series", **series.as_document()})

    async def _let_go(self) -> None:
        """Disconnect the rig, and go on whatever that leads to."""
        try:
            await self._call(self._rig.disconnect)
        except Exception:
            _log.exception("the rig could not be disconnected")

    def _run_series(
        self, series: ServedSeries, planned: Series, loop: asyncio.AbstractEventLoop
    ) -> None:
        """Run the sessions one after the other; in the second thread."""

        def publish(event: Document) -> None:
            loop.call_soon_threadsafe(self._publish, event)

        told = SeriesTeller(series, publish, self._listens)
        try:
            planned.run(
                self._rig,
                series.stop,
                told,
                live=self._live,
                listens=self._listens,
                looks=self._looks,
            )
        except SessionFailedError as error:
            told.ended(error.result(), look_follows=False)
            raise

    def _listens(self) -> bool:
        """Whether somebody who asks for a stop is heard; asked from the second thread.

        A session whose operator cannot be heard gets no sign of life any more, and ends.
        """
        return time.monotonic() - self._listened_s < _DEAF_S

    # Telling

    def _progress(self) -> Document | None:
        series, look = self._series, self._look
        if series is None or not series.running or series.planned is None or look is None:
            return None
        rate_hz = None if self._fast else self._profile.rig.rate_hz
        document = progress_document(look, series.planned.ticks, rate_hz)
        return {"session": series.session, "repeat": series.request.repeat, **document}

    def _rates(self) -> dict[str, float | None]:
        """Return the measured rates of all topics."""
        if len(self._written) < 2:
            return {}
        (first_s, first), (last_s, last) = self._written[0], self._written[-1]
        return {
            name: max(0, written - first.get(name, 0)) / (last_s - first_s)
            for name, written in last.items()
        }

    def _tell_transition(self, transition: Transition) -> None:
        if transition.after is DaemonState.FAULT:
            self._fault = transition.reason
        level = logging.ERROR if transition.after is DaemonState.FAULT else logging.INFO
        _log.log(
            level, "state: %s -> %s: %s", transition.before, transition.after, transition.reason
        )
        self._publish({"event": "state", **transition_document(transition)})

    def _tell_look(self, look: QuickLook) -> None:
        """Tell of a quick look; called in either thread."""
        if self._series is not None:
            look.note(self._series.results)
        for line in look.lines:
            _log.info("%s", line)
        if self._loop is not None:
            self._loop.call_soon_threadsafe(
                self._publish, {"event": "quick_look", **look.as_dict()}
            )

    async def _call(self, function: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._worker, function)
