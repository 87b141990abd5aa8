"""Contents of a session file, and advice on what can be recovered from a damaged one."""

import mmap
import os
import shlex
import stat
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, Final

from rigd.session._errors import SessionAccessError, SessionError
from rigd.session._mcap_limits import McapError, McapTooLargeError
from rigd.session._mcap_reader import IsChunkNeeded, McapContents, OnBlock, read_mcap
from rigd.session._mcap_writer import MAGIC
from rigd.session._schema import SAMPLE_TOPIC
from rigd.session._writer import PART_SUFFIX

_SESSION_SUFFIX: Final = ".mcap"
_RECOVERED_SUFFIX: Final = ".recovered.mcap"
_SEARCHED_BYTES: Final = 1 << 20
"""Number of bytes at the start of a file that contain the first sample, if there is one."""


def load_contents(
    path: Path,
    topics: Sequence[str] | None,
    *,
    on_block: OnBlock | None = None,
    is_salvage: bool = False,
    on_progress: Callable[[float], None] | None = None,
    is_chunk_needed: IsChunkNeeded | None = None,
) -> McapContents:
    """Return the contents of an MCAP file up to its end or its first damage.

    The other arguments are those of `rigd.session._mcap_reader.read_mcap`. Raises SessionError if
    the file is missing, empty, too large or not an MCAP file.
    """
    with open_mcap_file(path) as file:
        mapped_file = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        return read_mcap(
            memoryview(mapped_file),
            topics,
            on_block=on_block,
            is_salvage=is_salvage,
            on_progress=on_progress,
            is_chunk_needed=is_chunk_needed,
        )


def check_magic_bytes(path: Path) -> None:
    """Raise if a file does not begin with the magic bytes of an MCAP file.

    Raises
    ------
    SessionError
        If the file is missing, empty or not an MCAP file.
    """
    with open_mcap_file(path) as file:
        read_mcap(memoryview(file.read(len(MAGIC))), ())


@contextmanager
def open_mcap_file(path: Path) -> Iterator[BinaryIO]:
    """Open a file for reading, and convert errors of the enclosed code into SessionError."""
    try:
        _require_nonempty_file(path)
        with path.open("rb") as file:
            yield file
    except OSError as error:
        raise _access_error(path, error) from None
    except McapTooLargeError as error:
        raise SessionError(f"{path} {error}. Give a shorter session.") from None
    except McapError as error:
        raise _format_error(path, error) from None


def _require_nonempty_file(path: Path) -> None:
    """Raise if a path is not the path of a regular file, or if the file is empty."""
    file_status = path.stat()
    if not stat.S_ISREG(file_status.st_mode):
        raise SessionError(f"{path} is not a file. Give the path of a session file (*.mcap).")
    if file_status.st_size == 0:
        raise SessionError(f"{path} is empty, nothing was recorded to it. Record it again.")


def _access_error(path: Path, error: OSError) -> SessionAccessError:
    """Return the error for a file that the operating system does not allow to be read."""
    return SessionAccessError(
        f"{path} cannot be read: {error.strerror or error}. Check the path and its permissions."
    )


def _format_error(path: Path, error: McapError) -> SessionError:
    """Return the error for a file that is not a usable MCAP file."""
    return SessionError(f"{path} {error}. Give a session file (*.mcap).")


# Recovery


def recovered_path(path: Path) -> Path:
    """Return the path of the file to which a damaged file is recovered.

    It is ``X.mcap`` for ``X.mcap.part``, and ``X.recovered.mcap`` for ``X.mcap``.
    """
    if path.name.endswith(_SESSION_SUFFIX + PART_SUFFIX):
        return path.with_name(path.name.removesuffix(PART_SUFFIX))
    return path.with_name(path.name.removesuffix(_SESSION_SUFFIX) + _RECOVERED_SUFFIX)


def may_contain_samples(path: Path) -> bool:
    """Return whether `recover` may find a sample in a file.

    Only the first mebibyte is searched. A longer MCAP file, and a file that cannot be opened, may
    contain samples.
    """
    try:
        with path.open("rb") as file:
            first_bytes = file.read(_SEARCHED_BYTES)
            has_more_bytes = bool(file.read(1))
    except OSError:
        return True
    try:
        mcap_contents = read_mcap(memoryview(first_bytes), (), is_salvage=True)
    except McapError:
        return False
    return has_more_bytes or mcap_contents.message_count(SAMPLE_TOPIC) > 0


def recovery_advice(path: Path, *, was_complete: bool) -> str:
    """Return the end of an error message on a damaged file: what is intact, and how to recover it.

    The text begins with the punctuation mark that follows the description of the damage.
    `was_complete` states that the file was once complete, so that an intact copy may exist.
    """
    try:
        sample_count = load_contents(path, (), is_salvage=True).message_count(SAMPLE_TOPIC)
    except SessionError:
        sample_count = 0
    copy_advice = ". Copy it again from where it was recorded"
    readable_samples_text = f"; {sample_count} complete samples are readable before that"
    if not sample_count:
        no_samples_text = ", so there is nothing to recover"
        if was_complete:
            return f"{readable_samples_text}{no_samples_text}{copy_advice}."
        return (
            f"{readable_samples_text}{no_samples_text}. Copy it again if there is a complete one, "
            "or record it again."
        )
    recovered_file = recovered_path(path)
    recover_command = f"`rigd recover {shlex.quote(str(path))}`"
    if os.path.lexists(recovered_file):
        recover_command += f", once {recovered_file}, which may hold it already, is moved away"
    if was_complete:
        return f"{copy_advice}, or save what is intact with {recover_command}."
    return f"{readable_samples_text}. Save them with {recover_command}."
