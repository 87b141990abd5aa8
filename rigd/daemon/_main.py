"""Main program of ``rigd serve``: lock, socket, rig and signals, from start to end."""

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
from rigd.daemon._states import look_up_user
from rigd.daemon.address import COMMON, bind, socket_path
from rigd.devices import WhatMoves, reality, simulated_differently, what_moves
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
    look: bool,
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
        Group whose members may command it, as well as this user.
    live, fast
        See :class:`rigd.runner._rig.Rig`.
    look
        Take a quick look at each session.
    page
        Serve the operator's page.
    page_port
        Port of the page on loopback; None: 8720, or another one if that is taken.

    Returns
    -------
    Signals
        The one that ended it.

    Raises
    ------
    RigBusyError
        If another program runs the rig.
    AddressError
        If there can be no socket.
    """
    moving = reality(profile.rig)
    with ExitStack() as ending:
        ending.enter_context(Log())
        look_up_user(os.getuid())
        ending.enter_context(
            RigLock(profile.name, "rigd serve", hardware=moving is WhatMoves.HARDWARE)
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
            partial(reality, profile.rig),
            fast=fast,
            live=live,
            look=look,
        )
        _log.info("%s Listening on %s", what_moves(profile.rig, moving), path)
        for difference in simulated_differently(profile.rig):
            _log.warning("the simulated rig has %s", difference)
        if page:
            from rigd.daemon._page import PageProcess

            serving = PageProcess(profile, folder, path, page_port, service.set_page)
            ending.callback(serving.close)
        return asyncio.run(_run(server, service))


async def _run(server: Server, service: Service) -> signal.Signals:
    loop = asyncio.get_running_loop()
    asked: asyncio.Future[signal.Signals] = loop.create_future()

    def end(number: signal.Signals) -> None:
        if not asked.done():
            asked.set_result(number)

    for number in _ENDING:
        if signal.getsignal(number) != signal.SIG_IGN:  # nohup
            loop.add_signal_handler(number, end, number)
    # For those whom a crowd keeps from the socket; `server.serve` is what makes it findable.
    loop.add_signal_handler(STOP_SIGNAL, _stop, service)
    server.serve(service)
    opening = asyncio.create_task(service.open())
    attending = asyncio.create_task(service.attend())
    telling = asyncio.create_task(service.tell_signals())
    telling.add_done_callback(_note_end)
    # Attending ends only by a mistake in the program, which must not leave a rig unattended.
    attending.add_done_callback(lambda _: end(signal.SIGABRT))
    await asked
    why = f"the daemon got {asked.result().name}"
    _log.info("%s and ends", why)
    await service.close(why)
    attending.cancel()
    telling.cancel()
    await asyncio.gather(opening, attending, telling, return_exceptions=True)
    await server.close()
    return asked.result()


def _note_end(telling: "asyncio.Task[None]") -> None:
    """Log why no signals are told any more; the rig does not depend on them."""
    if not telling.cancelled():
        _log.error("the signals are not told any more", exc_info=telling.exception())


def _stop(service: Service) -> None:
    _log.info("stop: asked for by %s", STOP_SIGNAL.name)
    service.stop(f"the daemon got {STOP_SIGNAL.name}")
