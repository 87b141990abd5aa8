"""The daemon's log: on standard error, written by a separate thread.

A stopped terminal or a hanging journal must not prevent the daemon from receiving a stop.
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
    """Queue of log records; when it is full, further records are dropped and counted."""

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
    """Log of the daemon, active inside its context."""

    def __init__(self) -> None:
        self._waiting: queue.Queue[logging.LogRecord] = queue.Queue(_MOST_WAITING)
        self._handler = _Dropping(self._waiting)

    def __enter__(self) -> None:
        logging.raiseExceptions = False  # a closed terminal must not end the daemon
        logger = logging.getLogger(NAME)
        logger.setLevel(logging.INFO)
        logger.addHandler(self._handler)
        # A daemon thread: it may hang when the program ends.
        threading.Thread(target=self._write, daemon=True).start()

    def __exit__(self, *_: object) -> None:
        logging.getLogger(NAME).removeHandler(self._handler)
        deadline_s = time.monotonic() + _FLUSH_S
        while self._waiting.unfinished_tasks and time.monotonic() < deadline_s:
            time.sleep(0.01)

    def _write(self) -> None:
        """Write the log line by line, however long that takes.

        It bypasses the interpreter's buffer and the handlers of `logging`: a hanging write would
        hold their locks, and the end of the program would wait for these.
        """
        formatter = logging.Formatter("%(asctime)s %(levelname)s %(message)s")
        while True:
            line = formatter.format(self._waiting.get()) + "\n"
            data = line.encode(errors="backslashreplace")
            with contextlib.suppress(OSError):
                while data:
                    data = data[os.write(_STANDARD_ERROR, data) :]
            self._waiting.task_done()
