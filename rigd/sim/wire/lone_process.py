"""One process a simulated rig: its lock, the folder of its sockets, and the signals that end it."""

import fcntl
import os
import signal
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rigd.devices.contracts import DeviceError
from rigd.devices.simulator import find_simulator, forget, runtime_folder

_LONGEST_SOCKET_NAME = 107
_STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextmanager
def only_one(rig_name: str) -> Iterator[None]:
    """Refuse to start beside another simulated rig of the same name."""
    folder = runtime_folder()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        lock = (folder / f"{rig_name}.lock").open("w")
    except OSError as error:
        raise DeviceError(
            f"The simulated rig cannot use the folder {folder} ({error.strerror}); set "
            "XDG_RUNTIME_DIR to one that is yours."
        ) from None
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            running = find_simulator(rig_name)
            who = "" if running is None else f" (process {running.pid})"
            raise DeviceError(
                f"A simulated rig of the profile {rig_name} runs already{who}; end it first, or "
                "use that one."
            ) from None
        # What a dead one left must go first: it names the sockets that are about to live again.
        forget(rig_name)
        yield


@contextmanager
def socket_folder(rig_name: str) -> Iterator[Path]:
    """Make room for the sockets, whose names must be short."""
    folder = runtime_folder()
    if len(os.fsencode(folder / f"{rig_name}.control")) <= _LONGEST_SOCKET_NAME:
        yield folder
        return
    with tempfile.TemporaryDirectory(prefix="rigd-", dir="/tmp") as short:
        yield Path(short)


@contextmanager
def stop_requested() -> Iterator[Callable[[], bool]]:
    """Say whether one of the signals that end the process has come; one ignored before stays so."""
    requested: list[int] = []
    before = {number: signal.getsignal(number) for number in _STOPPING}
    caught = [number for number, handler in before.items() if handler != signal.SIG_IGN]
    for number in caught:
        signal.signal(number, lambda got, _: requested.append(got))
    try:
        yield lambda: bool(requested)
    finally:
        for number in caught:
            signal.signal(number, before[number])
