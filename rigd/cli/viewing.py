"""What the commands that show something in Rerun's viewer have in common."""

import contextlib
import os
import platform
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from rigd.cli.exits import EXIT_FAILED, fail
from rigd.interruption import raise_on

if TYPE_CHECKING:
    from rigd.live.address import LiveAddress


def has_screen() -> bool:
    """Whether there is a screen for a window."""
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def tunnel_advice(view: "LiveAddress") -> str:
    """Return what to type on another computer, to look on from there."""
    page, grpc = view.page_port, view.grpc_port
    return (
        f"From another computer: ssh -L {page}:127.0.0.1:{page} -L {grpc}:127.0.0.1:{grpc} "
        f"{platform.node()}, and open http://127.0.0.1:{page} there."
    )


@contextlib.contextmanager
def scratch_folder() -> Iterator[Path]:
    """Give a temporary folder: the viewer leaves files behind when it is ended."""
    try:
        folder = tempfile.TemporaryDirectory(prefix="rigd-view-", ignore_cleanup_errors=True)
    except OSError as error:
        fail(
            f"No temporary folder can be made ({error.strerror}); set TMPDIR to one with room.",
            EXIT_FAILED,
        )
    with folder as name:
        yield Path(name)


@contextlib.contextmanager
def ended_gently() -> Iterator[None]:
    """Have every way of being asked to end mean Ctrl-C, so that temporary files go too."""
    asked = (signal.SIGTERM, signal.SIGHUP)
    before = [signal.getsignal(number) for number in asked]
    raise_on(*asked)
    try:
        yield
    finally:
        for number, handler in zip(asked, before, strict=True):
            signal.signal(number, handler)
