"""Rerun files, and the environment of Rerun's SDK.

This module is quick to import, because the command line checks a file before it draws anything.
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
"""Pattern of the system's error number in messages of the SDK."""


def without_settings(environment: Mapping[str, str]) -> dict[str, str]:
    """Return an environment without the variables of Rerun, such as ``RERUN=off``."""
    return {
        name: value
        for name, value in environment.items()
        if not name.lstrip("_").startswith("RERUN")
    }


def settle_sdk() -> None:
    """Prepare this process's environment for the SDK; call it before the SDK is imported.

    It silences the SDK's log, because the callers report a lost server or a full disk themselves.
    """
    for name in os.environ.keys() - without_settings(os.environ).keys():
        del os.environ[name]
    os.environ["RUST_LOG"] = "off"


class RrdFileError(FailureError):
    """A Rerun file cannot be written, or a file is no Rerun file."""


@contextlib.contextmanager
def new_rrd_file(path: Path) -> Iterator["RecordingStream"]:
    """Provide a recording that is written to a file, which gets its name when it is complete.

    Raises
    ------
    RrdFileError
        If the name is in use, or the file cannot be written.
    """
    settle_sdk()
    import rerun as rr

    from rigd.session import rename_new
    from rigd.view.plots import APPLICATION_ID

    check_new(path)
    part = path.with_name(f".rigd-{os.getpid()}-{uuid.uuid4().hex[:8]}.part")
    stream = rr.RecordingStream(APPLICATION_ID, recording_id=str(uuid.uuid4()))
    try:
        with _write_errors(path, part):
            path.parent.mkdir(parents=True, exist_ok=True)
            stream.save(part)
        yield stream
        with _write_errors(path, part):
            stream.flush()
            stream.disconnect()
            rename_new(part, path)
    finally:
        stream.disconnect()
        part.unlink(missing_ok=True)


def check_new(path: Path) -> None:
    """Raise RrdFileError if a path exists or does not have the suffix of a Rerun file."""
    if path.suffix != SUFFIX:
        raise RrdFileError(f"{path}: name the file ….rrd, which is how Rerun's viewer knows it.")
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return  # writing creates the folder, or reports why it cannot
    except OSError as error:
        raise RrdFileError(
            f"{path} cannot be written: {error.strerror}. Choose another name."
        ) from None
    raise RrdFileError(
        f"{path} exists; choose another name or move it away, nothing is overwritten."
    )


def check_rrd_file(path: Path) -> None:
    """Raise RrdFileError if a file does not begin as a Rerun recording does."""
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
def _write_errors(path: Path, part: Path) -> Iterator[None]:
    """Translate errors of writing a file into RrdFileError."""
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
        cause = os.strerror(int(number[1])) if number else _write_failure(part)
        raise RrdFileError(f"{path} cannot be written: {cause}.") from None


def _write_failure(part: Path) -> str:
    """Return the reason why a file cannot grow, by a trial; the SDK may not report it."""
    try:
        with part.open("ab") as file:
            file.write(bytes(_TRIAL_BYTES))
    except OSError as error:
        return error.strerror or str(error)
    return "Rerun gave up"
