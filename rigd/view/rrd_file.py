"""Rerun files (``*.rrd``), and the environment variables of Rerun's SDK.

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

RRD_SUFFIX: Final = ".rrd"
"""File name suffix by which Rerun's viewer recognises its files."""

_RRD_FIRST_BYTES: Final = b"RRF"
"""First bytes of every Rerun file."""
_TRIAL_WRITE_BYTES: Final = 1 << 20
"""Number of bytes that are written to find out why a file cannot grow."""
_OS_ERROR_PATTERN: Final = re.compile(r"os error (\d+)")
"""Pattern of the operating system's error number in messages of Rerun's SDK."""


def without_rerun_variables(environment: Mapping[str, str]) -> dict[str, str]:
    """Return environment variables without those that affect Rerun, such as ``RERUN=off``."""
    return {
        variable_name: variable_value
        for variable_name, variable_value in environment.items()
        if not variable_name.lstrip("_").startswith("RERUN")
    }


def prepare_sdk_environment() -> None:
    """Prepare the environment of this process for Rerun's SDK, before the SDK is imported.

    Rerun's variables are removed. The SDK's log is switched off, because the callers report a lost
    server or a full disk themselves.
    """
    for variable_name in os.environ.keys() - without_rerun_variables(os.environ).keys():
        del os.environ[variable_name]
    os.environ["RUST_LOG"] = "off"


class RrdFileError(FailureError):
    """Raised if a Rerun file cannot be written, or a file is not a Rerun file."""


@contextlib.contextmanager
def new_rrd_file(path: Path) -> Iterator["RecordingStream"]:
    """Provide a recording that is written to a new file, as a context manager.

    The file gets its name when the recording is complete.

    Raises
    ------
    RrdFileError
        If the name is in use, or the file cannot be written.
    """
    prepare_sdk_environment()
    import rerun as rr

    from rigd.session import rename_without_replacing
    from rigd.view.plots import APPLICATION_ID

    check_new_rrd_file(path)
    temporary_path = path.with_name(f".rigd-{os.getpid()}-{uuid.uuid4().hex[:8]}.part")
    stream = rr.RecordingStream(APPLICATION_ID, recording_id=str(uuid.uuid4()))
    try:
        with _translate_write_errors(path, temporary_path):
            path.parent.mkdir(parents=True, exist_ok=True)
            stream.save(temporary_path)
        yield stream
        with _translate_write_errors(path, temporary_path):
            stream.flush()
            stream.disconnect()
            rename_without_replacing(temporary_path, path)
    finally:
        stream.disconnect()
        temporary_path.unlink(missing_ok=True)


def check_new_rrd_file(path: Path) -> None:
    """Raise RrdFileError if a path exists or does not have the suffix of a Rerun file."""
    if path.suffix != RRD_SUFFIX:
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
    """Raise RrdFileError if a file does not begin with the first bytes of a Rerun file."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise RrdFileError(f"{path} is not a file. Give a recording of Rerun's (*.rrd).")
        with path.open("rb") as rrd_file:
            first_bytes = rrd_file.read(len(_RRD_FIRST_BYTES))
    except OSError as error:
        raise RrdFileError(
            f"{path} cannot be read: {error.strerror}. Check the path and its permissions."
        ) from None
    if first_bytes != _RRD_FIRST_BYTES:
        raise RrdFileError(
            f"{path} is not a Rerun recording, though its name says so. Give a session file "
            "(*.mcap), or what `rigd replay … --save` or `analyze … --rerun` wrote."
        )


@contextlib.contextmanager
def _translate_write_errors(path: Path, temporary_path: Path) -> Iterator[None]:
    """Turn errors from writing a Rerun file within this context into RrdFileError."""
    try:
        yield
    except FileExistsError:
        raise RrdFileError(
            f"{path} has appeared meanwhile; choose another name, nothing is overwritten."
        ) from None
    except OSError as error:
        raise RrdFileError(f"{path} cannot be written: {error.strerror}.") from None
    except RuntimeError as error:  # from the SDK
        error_number_match = _OS_ERROR_PATTERN.search(str(error))
        failure_cause = (
            os.strerror(int(error_number_match[1]))
            if error_number_match
            else _reason_of_write_failure(temporary_path)
        )
        raise RrdFileError(f"{path} cannot be written: {failure_cause}.") from None


def _reason_of_write_failure(temporary_path: Path) -> str:
    """Return the reason for which the operating system refuses to append to a file, by a trial.

    Rerun's SDK may not report the reason.
    """
    try:
        with temporary_path.open("ab") as trial_file:
            trial_file.write(bytes(_TRIAL_WRITE_BYTES))
    except OSError as error:
        return error.strerror or str(error)
    return "Rerun gave up"
