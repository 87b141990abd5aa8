"""What can be done about a torn or damaged session file, for messages that advise it."""

import os
import shlex
from pathlib import Path
from typing import Final

from rigd.session.errors import SessionError
from rigd.session.mcap_limits import McapError
from rigd.session.mcap_reader import read_mcap
from rigd.session.reader import load_contents
from rigd.session.recovery import recovered_path
from rigd.session.schema import SAMPLE_TOPIC

_BEGINNING_BYTES: Final = 1 << 20
"""In which the first samples are, if there are any."""


def holds_samples(path: Path) -> bool:
    """Tell whether `recover` finds a sample in a file, as far as its beginning says.

    That of a file that cannot be read is not known, and counts as if there were one.
    """
    try:
        with path.open("rb") as file:
            beginning = file.read(_BEGINNING_BYTES)
            longer = bool(file.read(1))
    except OSError:
        return True
    try:
        contents = read_mcap(memoryview(beginning), (), salvage=True)
    except McapError:
        return False
    return longer or contents.count(SAMPLE_TOPIC) > 0


def remedy(path: Path, *, was_whole: bool) -> str:
    """Say how much of an incomplete or damaged file is intact, and how to save that.

    Parameters
    ----------
    path : the file
    was_whole : it was complete once, so that a sound one may be elsewhere

    Returns
    -------
    What goes on behind what is wrong with it, from the mark after that on.
    """
    try:
        count = load_contents(path, (), salvage=True).count(SAMPLE_TOPIC)
    except SessionError:
        count = 0
    again = ". Copy it again from where it was recorded"
    readable = f"; {count} complete samples are readable before that"
    if not count:
        nothing = ", so there is nothing to recover"
        if was_whole:
            return f"{readable}{nothing}{again}."
        return f"{readable}{nothing}. Copy it again if there is a whole one, or record it again."
    target = recovered_path(path)
    command = f"`rigd recover {shlex.quote(str(path))}`"
    if os.path.lexists(target):
        command += f", once {target}, which may hold it already, is moved away"
    if was_whole:
        return f"{again}, or save what is intact with {command}."
    return f"{readable}. Save them with {command}."
