"""The daemon's log: on standard error, written by a separate thread.

A terminal that was stopped, or a journal that hangs, must not keep the daemon from hearing a stop.
"""

import contextlib
import logging
import logging.handlers
import os
import queue
import threading
import time
from typing import Final

NAME: Final = "rigd.serve"
_MOST_WAITING: Final = 1000
_STANDARD_ERROR: Final = 2
_FLUSH_S: Final = 1.0


class _Dropping(logging.handlers.QueueHandler):
    """Passes records on; if they are not read, the oldest are kept and the rest counted."""

    def __init__(self, waiting: "queue.Queue[logging.LogRecord]") -> None:
        super().__init__(waiting)
        self._waiting = waiting
        self._dropped = 0

    def enqueue(self, record: logging.LogRecord) -> None:
        """Queue a record without waiting."""
        if self._dropped and not self._waiting.full():
            text = f"{self._dropped} lines before this one were dropped (log not read)"
            self._waiting.put_nowait(
                logging.LogRecord(NAME, logging.WARNING, "", 0, text, None, None)
            )
            self._dropped = 0
        try:
            self._waiting.put_nowait(record)
        except queue.Full:
            self._dropped += 1


class Log:
    """The log for as long as its context lasts."""

    def __init__(self) -> None:
        self._waiting: queue.Queue[logging.LogRecord] = queue.Queue(_MOST_WAITING)
        self._handler = _Dropping(self._waiting)

    def __enter__(self) -> None:
        logging.raiseExceptions = False  # a terminal that is gone must not end anything
        logger = logging.getLogger(NAME)
        logger.setLevel(logging.INFO)
        logger.addHandler(self._handler)
        # A daemonic thread: it may be stuck when the program ends.
        threading.Thread(target=self._write, daemon=True).start()

    def __exit__(self, *_: object) -> None:
        logging.getLogger(NAME).removeHandler(self._handler)
        deadline_s = time.monotonic() + _FLUSH_S
        while self._waiting.unfinished_tasks and time.monotonic() < deadline_s:
            time.sleep(0.01)

    def _write(self) -> None:
        """Write line by line, for as long as that takes.

        Past the interpreter's buffer and logging's handlers: both have locks, which one that is
        stuck would hold, and for which the end of the program would wait.
        """
        formatter = logging.Formatter("%(asctime)s %(levelname)s %(message)s")
        while True:
            line = formatter.format(self._waiting.get()) + "\n"
            rest = line.encode(errors="backslashreplace")
            with contextlib.suppress(OSError):
                while rest:
                    rest = rest[os.write(_STANDARD_ERROR, rest) :]
            self._waiting.task_done()
