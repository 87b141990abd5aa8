"""Main program of ``rigd serve``: lock, socket, rig and signals."""

import asyncio
import logging
import os
import signal
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from rigd.daemon._log import NAME, Log
from rigd.daemon._server import Server
from rigd.daemon._service import Service
from rigd.daemon._states import resolve_user
from rigd.daemon.address import COMMON, bind, socket_path
from rigd.devices import (
    ActuationTarget,
    actuation_target,
    describe_actuation_target,
    simulated_differently,
)
from rigd.profile import Profile
from rigd.runner import Rig
from rigd.runtime import STOP_SIGNAL, RigLock

_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP)

_log = logging.getLogger(NAME)


def run_daemon(
    profile: Profile,
    folder: Path,
    *,
    group: str | None,
    live: bool,
    fast: bool,
    quick_looks: bool,
    page: bool = False,
    page_port: int | None = None,
) -> signal.Signals:
    """Run the rig daemon until a signal ends it.

    Parameters
    ----------
    profile
        Profile of the rig.
    folder
        Folder for session files.
    group
        Group whose members may command the daemon, in addition to this user.
    live, fast
        See :class:`rigd.runner._rig.Rig`.
    quick_looks
        Whether to make a quick look of each session.
    page
        Whether to serve the operator's page.
    page_port
        Port of the page on loopback; None: 8720, or another one if that is taken.

    Returns
    -------
    Signals
        Signal that ended the daemon.

    Raises
    ------
    RigBusyError
        If another program runs the rig.
    AddressError
        If the socket cannot be created.
    """
    moving = actuation_target(profile.rig)
    with ExitStack() as ending:
        ending.enter_context(Log())
        resolve_user(os.getuid())
        ending.enter_context(
            RigLock(profile.name, "rigd serve", hardware=moving is ActuationTarget.HARDWARE)
        )
        path = socket_path(profile.name, None if group is None else COMMON)
        listener = ending.enter_context(bind(path, group))
        ending.callback(path.unlink, missing_ok=True)
        worker = ending.enter_context(ThreadPoolExecutor(1, "rig"))
        server = Server(listener)
        service = Service(
            Rig(profile, fast=fast, live=live),
            profile,
            folder,
            worker,
            server.publish,
            partial(actuation_target, profile.rig),
            fast=fast,
            live=live,
            quick_looks=quick_looks,
        )
        _log.info("%s Listening on %s", describe_actuation_target(profile.rig, moving), path)
        for difference in simulated_differently(profile.rig):
            _log.warning("the simulated rig has %s", difference)
        if page:
            from rigd.daemon._page import PageProcess

            serving = PageProcess(profile, folder, path, page_port, service.set_page)
            ending.callback(serving.close)
        return asyncio.run(_run(server, service))


async def _run(server: Server, service: Service) -> signal.Signals:
    loop = asyncio.get_running_loop()
    ending_signal: asyncio.Future[signal.Signals] = loop.create_future()

    def end(number: signal.Signals) -> None:
        if not ending_signal.done():
            ending_signal.set_result(number)

    for number in _ENDING:
        if signal.getsignal(number) != signal.SIG_IGN:  # nohup
            loop.add_signal_handler(number, end, number)
    # A stop by signal works even if other clients block the socket. Register it before the socket
    # accepts clients.
    loop.add_signal_handler(STOP_SIGNAL, _stop, service)
    server.serve(service)
    opening = asyncio.create_task(service.open())
    polling = asyncio.create_task(service.run())
    streaming = asyncio.create_task(service.stream_signals())
    streaming.add_done_callback(_log_stream_failure)
    # Polling ends only by a bug, which must not leave the rig unsupervised.
    polling.add_done_callback(lambda _: end(signal.SIGABRT))
    await ending_signal
    why = f"the daemon got {ending_signal.result().name}"
    _log.info("%s and ends", why)
    await service.close(why)
    polling.cancel()
    streaming.cancel()
    await asyncio.gather(opening, polling, streaming, return_exceptions=True)
    await server.close()
    return ending_signal.result()


def _log_stream_failure(streaming: "asyncio.Task[None]") -> None:
    """Log the failure of the signal stream, on which the rig does not depend."""
    if not streaming.cancelled():
        _log.error("the signals are no longer published", exc_info=streaming.exception())


def _stop(service: Service) -> None:
    _log.info("stop: requested by %s", STOP_SIGNAL.name)
    service.stop(f"the daemon got {STOP_SIGNAL.name}")
