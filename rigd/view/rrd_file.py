"""Rerun's files, and its SDK's environment.

Quick to import: the command line names a file before it draws anything.
"""

import contextlib
import os
import re
import stat
import uuid
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rigd.errors import FailureError

if TYPE_CHECKING:
    from rerun import RecordingStream

SUFFIX: Final = ".rrd"
"""Suffix by which Rerun's viewer recognises its files."""

_MAGIC: Final = b"RRF"
_TRIAL_BYTES: Final = 1 << 20
_OS_ERROR: Final = re.compile(r"os error (\d+)")
"""The system's error number in the SDK's messages, whose sentences are not for the operator."""


def without_settings(environment: Mapping[str, str]) -> dict[str, str]:
    """Return an environment without what is meant for Rerun: ``RERUN=off`` and so on."""
    return {
        name: value
        for name, value in environment.items()
        if not name.lstrip("_").startswith("RERUN")
    }


def settle_sdk() -> None:
    """Prepare this process's environment for the SDK; to be called before it is imported.

    What it has to say of a server that is gone or of a full disk is told by us.
    """
    for name in os.environ.keys() - without_settings(os.environ).keys():
        del os.environ[name]
    os.environ["RUST_LOG"] = "off"


class RrdFileError(FailureError):
    """A file of Rerun's cannot be written, or is none."""


@contextlib.contextmanager
def new_rrd_file(path: Path) -> Iterator["RecordingStream"]:
    """Give a recording that is written to a file, which has its name once all is in it.

    Raises
    ------
    RrdFileError
        If there is something of that name, or the file cannot be written.
    """
    settle_sdk()
    import rerun as rr

    from rigd.session import rename_new
    from rigd.view.plots import APPLICATION_ID

    check_new(path)
    part = path.with_name(f".rigd-{os.getpid()}-{uuid.uuid4().hex[:8]}.part")
    stream = rr.RecordingStream(APPLICATION_ID, recording_id=str(uuid.uuid4()))
    try:
        with _told(path, part):
            path.parent.mkdir(parents=True, exist_ok=True)
            stream.save(part)
        yield stream
        with _told(path, part):
            stream.flush()
            stream.disconnect()
            rename_new(part, path)
    finally:
        stream.disconnect()
        part.unlink(missing_ok=True)


def check_new(path: Path) -> None:
    """Raise RrdFileError if something has that name, or it is not a name of such a file."""
    if path.suffix != SUFFIX:
        raise RrdFileError(f"{path}: name the file ….rrd, which is how Rerun's viewer knows it.")
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return  # the folder is made, or why not is told, when the file is written
    except OSError as error:
        raise RrdFileError(
            f"{path} cannot be written: {error.strerror}. Choose another name."
        ) from None
    raise RrdFileError(
        f"{path} exists; choose another name or move it away, nothing is overwritten."
    )


def check_rrd_file(path: Path) -> None:
    """Raise RrdFileError if a file is not a Rerun recording, as far as its beginning tells."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise RrdFileError(f"{path} is not a file. Give a recording of Rerun's (*.rrd).")
        with path.open("rb") as file:
            found = file.read(len(_MAGIC))
    except OSError as error:
        raise RrdFileError(
            f"{path} cannot be read: {error.strerror}. Check the path and its permissions."
        ) from None
    if found != _MAGIC:
        raise RrdFileError(
            f"{path} is not a Rerun recording, though its name says so. Give a session file "
            "(*.mcap), or what `rigd replay … --save` or `analyze … --rerun` wrote."
        )


@contextlib.contextmanager
def _told(path: Path, part: Path) -> Iterator[None]:
    """Say what kept a file from being written."""
    try:
        yield
    except FileExistsError:
        raise RrdFileError(
            f"{path} has appeared meanwhile; choose another name, nothing is overwritten."
        ) from None
    except OSError as error:
        raise RrdFileError(f"{path} cannot be written: {error.strerror}.") from None
    except RuntimeError as error:  # from the SDK
        number = _OS_ERROR.search(str(error))
        cause = os.strerror(int(number[1])) if number else _why_not(part)
        raise RrdFileError(f"{path} cannot be written: {cause}.") from None


def _why_not(part: Path) -> str:
    """Find out by trying why a file does not grow; the SDK may only say that it gave up."""
    try:
        with part.open("ab") as file:
            file.write(bytes(_TRIAL_BYTES))
    except OSError as error:
        return error.strerror or str(error)
    return "Rerun gave up"
