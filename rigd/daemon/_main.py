"""Main program of ``rigd serve``: it takes the rig's lock, and runs until a signal."""

import asyncio
import logging
import os
import signal
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from rigd.daemon._log import LOGGER_NAME, DaemonLog
from rigd.daemon._server import Server
from rigd.daemon._service import Service
from rigd.daemon._states import resolve_user
from rigd.daemon.address import GROUP_FOLDER, bind_daemon_socket, socket_path
from rigd.devices import (
    ActuationTarget,
    actuation_target,
    describe_actuation_target,
    simulation_differences,
)
from rigd.profile import Profile
from rigd.runner import Rig
from rigd.runtime import STOP_SIGNAL
from rigd.runtime.locks import RigLock

_END_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP)

_log = logging.getLogger(LOGGER_NAME)


def run_daemon(
    profile: Profile,
    session_folder: Path,
    *,
    group_name: str | None,
    with_live_view: bool,
    uses_virtual_clock: bool,
    makes_quick_looks: bool,
    serves_page: bool = False,
    page_port: int | None = None,
) -> signal.Signals:
    """Run the daemon of a rig until a signal ends it.

    Parameters
    ----------
    profile
        Profile of the rig.
    session_folder
        Folder of the session files.
    group_name
        Group of users who may operate the rig through the daemon, in addition to this user.
    with_live_view, uses_virtual_clock
        See :class:`rigd.runner._rig.Rig`.
    makes_quick_looks
        Whether to make a quick look at each session.
    serves_page
        Whether to serve the operator's page.
    page_port
        Port of the page on the loopback interface, or None for 8720 or, if used, another port.

    Returns
    -------
    Signals
        Signal that ended the daemon.

    Raises
    ------
    RigBusyError
        If another program uses the rig.
    AddressError
        If the socket cannot be created.
    """
    target = actuation_target(profile.rig)
    with ExitStack() as resources:
        resources.enter_context(DaemonLog())
        resolve_user(os.getuid())
        resources.enter_context(
            RigLock(profile.name, "rigd serve", hardware=target is ActuationTarget.HARDWARE)
        )
        daemon_socket = socket_path(profile.name, None if group_name is None else GROUP_FOLDER)
        listener = resources.enter_context(bind_daemon_socket(daemon_socket, group_name))
        resources.callback(daemon_socket.unlink, missing_ok=True)
        rig_worker = resources.enter_context(ThreadPoolExecutor(1, "rig"))
        server = Server(listener)
        service = Service(
            Rig(profile, uses_virtual_clock=uses_virtual_clock, with_live_view=with_live_view),
            profile,
            session_folder,
            rig_worker,
            server.publish,
            partial(actuation_target, profile.rig),
            uses_virtual_clock=uses_virtual_clock,
            with_live_view=with_live_view,
            makes_quick_looks=makes_quick_looks,
        )
        _log.info(
            "%s Listening on %s", describe_actuation_target(profile.rig, target), daemon_socket
        )
        for simulation_difference in simulation_differences(profile.rig):
            _log.warning("the simulated rig has %s", simulation_difference)
        if serves_page:
            from rigd.daemon._page import PageProcess

            page_process = PageProcess(
                profile, session_folder, daemon_socket, page_port, service.set_page_address
            )
            resources.callback(page_process.close)
        return asyncio.run(_run_until_signal(server, service))


async def _run_until_signal(server: Server, service: Service) -> signal.Signals:
    """Run server and service until a signal ends the daemon, and return that signal."""
    event_loop = asyncio.get_running_loop()
    ending_signal: asyncio.Future[signal.Signals] = event_loop.create_future()

    def end_by_signal(signal_number: signal.Signals) -> None:
        if not ending_signal.done():
            ending_signal.set_result(signal_number)

    for signal_number in _END_SIGNALS:
        if signal.getsignal(signal_number) != signal.SIG_IGN:  # nohup
            event_loop.add_signal_handler(signal_number, end_by_signal, signal_number)
    # A stop by signal works even if other clients block the socket. The handler is installed before
    # the socket accepts clients.
    event_loop.add_signal_handler(STOP_SIGNAL, _stop_session, service)
    server.serve(service)
    connecting_task = asyncio.create_task(service.open())
    polling_task = asyncio.create_task(service.run())
    streaming_task = asyncio.create_task(service.stream_signals())
    streaming_task.add_done_callback(_log_stream_failure)
    # Polling ends only because of a bug, which must not leave the rig unsupervised.
    polling_task.add_done_callback(lambda _: end_by_signal(signal.SIGABRT))
    await ending_signal
    end_reason = f"the daemon got {ending_signal.result().name}"
    _log.info("%s and ends", end_reason)
    await service.close(end_reason)
    polling_task.cancel()
    streaming_task.cancel()
    await asyncio.gather(connecting_task, polling_task, streaming_task, return_exceptions=True)
    await server.close()
    return ending_signal.result()


def _log_stream_failure(streaming_task: "asyncio.Task[None]") -> None:
    """Log it if publishing the rig's signals has failed; the rig itself does not need that."""
    if not streaming_task.cancelled():
        _log.error("the signals are no longer published", exc_info=streaming_task.exception())


def _stop_session(service: Service) -> None:
    """Stop the running session; called when the daemon receives the stop signal."""
    _log.info("stop: requested by %s", STOP_SIGNAL.name)
    service.stop(f"the daemon got {STOP_SIGNAL.name}")
