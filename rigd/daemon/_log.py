"""The daemon's log on standard error, which a separate thread writes.

A suspended terminal or a hanging journal must not prevent the daemon from receiving a stop.
"""

import contextlib
import logging
import logging.handlers
import os
import queue
import threading
import time
from typing import Final

LOGGER_NAME: Final = "rigd.serve"
"""Name of the daemon's logger."""
_MAX_WAITING_LOG_RECORDS: Final = 1000
"""Maximum number of log records that wait to be written."""
_STANDARD_ERROR_FD: Final = 2
"""File descriptor of standard error."""
_FLUSH_TIMEOUT_S: Final = 1.0
"""Maximum time in seconds to wait at the end until all records are written."""


class _DroppingQueueHandler(logging.handlers.QueueHandler):
    """Log handler that queues records, and drops and counts records if the queue is full."""

    def __init__(self, record_queue: "queue.Queue[logging.LogRecord]") -> None:
        super().__init__(record_queue)
        self._queue = record_queue
        self._dropped = 0

    def enqueue(self, record: logging.LogRecord) -> None:
        """Add a record to the queue without waiting; drop it if the queue is full."""
        if self._dropped and not self._queue.full():
            dropped_text = f"{self._dropped} lines before this one were dropped (log not read)"
            self._queue.put_nowait(
                logging.LogRecord(LOGGER_NAME, logging.WARNING, "", 0, dropped_text, None, None)
            )
            self._dropped = 0
        try:
            self._queue.put_nowait(record)
        except queue.Full:
            self._dropped += 1


class DaemonLog:
    """Context in which a thread writes the records of the daemon's logger to standard error."""

    def __init__(self) -> None:
        self._queue: queue.Queue[logging.LogRecord] = queue.Queue(_MAX_WAITING_LOG_RECORDS)
        self._handler = _DroppingQueueHandler(self._queue)

    def __enter__(self) -> None:
        logging.raiseExceptions = False  # a closed terminal must not end the daemon
        logger = logging.getLogger(LOGGER_NAME)
        logger.setLevel(logging.INFO)
        logger.addHandler(self._handler)
        # A daemon thread: it may hang when the program ends.
        threading.Thread(target=self._write_records, daemon=True).start()

    def __exit__(self, *_: object) -> None:
        logging.getLogger(LOGGER_NAME).removeHandler(self._handler)
        deadline_s = time.monotonic() + _FLUSH_TIMEOUT_S
        while self._queue.unfinished_tasks and time.monotonic() < deadline_s:
            time.sleep(0.01)

    def _write_records(self) -> None:
        """Write the queued records line by line; run in a thread, because writing may block.

        The lines are not written through Python's buffered stream or the handlers of `logging`.
        Otherwise a blocked write would hold their locks, and the program could not end.
        """
        formatter = logging.Formatter("%(asctime)s %(levelname)s %(message)s")
        while True:
            log_line = formatter.format(self._queue.get()) + "\n"
            line_bytes = log_line.encode(errors="backslashreplace")
            with contextlib.suppress(OSError):
                while line_bytes:
                    line_bytes = line_bytes[os.write(_STANDARD_ERROR_FD, line_bytes) :]
            self._queue.task_done()
