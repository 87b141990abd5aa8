"""Text on a terminal for a session: plan, progress and result.

`rigd run` and `rigd start` show the same text. Plans and results are JSON documents, because
`rigd start` receives them from the daemon.
"""

import contextlib
import threading
import time
from collections.abc import Iterator, Mapping
from typing import Any, Final

from rigd.engine.shared_state import Phase
from rigd.printable import counts_text, progress_bar
from rigd.session.touches import touch_line

_MIN_REDRAW_INTERVAL_S: Final = 0.05
"""Minimum time in seconds between two redraws of the progress line, each of which takes 2 ms."""
_CLOSE_TIMEOUT_S: Final = 2.0
"""Maximum time in seconds to wait for a suspended terminal at the end of a session."""


def plan_lines(plan: Mapping[str, Any]) -> Iterator[str]:
    """Yield the lines of text that describe the plan of a session.

    Parameters
    ----------
    plan
        Plan as in the daemon's reply to ``start``. Keys that an older daemon omits must not raise
        an error here, because then Ctrl-C would no longer stop the session.
    """
    limits = plan.get("limits", {})

    def peak_text(peak_name: str, unit: str) -> str:
        limit_text = f" (limit {limits[peak_name]:g})" if peak_name in limits else ""
        return f"{plan[f'peak_{peak_name}']:.3g} {unit}{limit_text}"

    subject_prefix = f"{plan['excitation']} on {plan['profile']}, " if "profile" in plan else ""
    sweep_prefix = f"{plan['sweep']}, " if plan.get("sweep") else ""
    maximum_prefix = "at most " if plan.get("ends_itself") else ""
    yield f"{subject_prefix}{sweep_prefix}record of {maximum_prefix}{plan['record_s']:g} s."
    yield (
        f"Predicted peaks: angle {peak_text('angle_rad', 'rad')}, "
        f"speed {peak_text('velocity_rad_s', 'rad/s')}, torque {peak_text('torque_nm', 'N·m')}."
    )
    for key in ("specimen_in_words", "tip_in_words"):
        if plan.get(key):
            yield plan[key]
    for warning in plan["warnings"]:
        yield f"Warning: {warning}"


def result_line(session_document: Mapping[str, Any]) -> str:
    """Return one line that states how a session ended.

    Parameters
    ----------
    session_document
        Result of the session, from :meth:`rigd.runner.session.SessionResult.as_dict`.
    """
    outcome_text = session_document["outcome"].capitalize()
    reason_text = f" {session_document['reason']}" if session_document["reason"] else ""
    if session_document["part"] is not None:
        return f"{outcome_text}: file incomplete, {session_document['part']}.{reason_text}"
    if session_document["path"] is None:
        return f"{outcome_text}: no record.{reason_text}"
    touches_text = "".join(
        f" {touch_line(touch)}." for touch in session_document.get("touches", [])
    )
    return f"{outcome_text}: {counts_text(session_document)}.{reason_text}{touches_text}"


class ProgressLine:
    """Progress line of a session on standard error, with messages above it.

    A separate thread writes the line, because a suspended terminal (Ctrl-S) or a pipe without a
    reader must not block the supervisor.
    """

    def __init__(self) -> None:
        self._progress = progress_bar(
            "{task.percentage:3.0f} %", "{task.fields[counts]}", auto_refresh=False
        )
        self._task = self._progress.add_task("preparing", total=None, counts="")
        self._lock = threading.Lock()
        self._state: dict[str, Any] = {}
        self._messages: list[str] = []
        self._is_closed = False
        self._has_record_begun = False
        self._has_changed = threading.Event()
        self._next_redraw_s = 0.0
        self._thread = threading.Thread(target=self._write_until_closed, daemon=True)
        self._thread.start()

    def update(
        self,
        phase: Phase,
        tick: int,
        total_ticks: int,
        *,
        missed_ticks: int,
        late_ticks: int,
        session_number_text: str = "",
    ) -> None:
        """Show the present progress of the session.

        Parameters
        ----------
        phase
            Phase of the control process.
        tick, total_ticks
            Number of ticks that were due so far, and total number of ticks of the record.
        missed_ticks, late_ticks
            Number of missed ticks and of late ticks so far. They are shown only if a tick was
            missed.
        session_number_text
            Number of the session in its series, such as ``2/5``; empty for a single session.
        """
        # A daemon's first event may have the counter of the previous session.
        self._has_record_begun |= phase is Phase.RUNNING
        self._state = {
            "description": f"{phase.display_text} {session_number_text}".rstrip(),
            "completed": tick if self._has_record_begun else 0,
            "total": total_ticks,
            "counts": f"{missed_ticks} missed, {late_ticks} late" if missed_ticks else "",
        }
        now_s = time.monotonic()
        if now_s >= self._next_redraw_s:
            self._next_redraw_s = now_s + _MIN_REDRAW_INTERVAL_S
            self._has_changed.set()

    def write_message(self, message: str) -> None:
        """Write a message for the operator above the progress line."""
        with self._lock:
            self._messages.append(message)
        self._has_changed.set()

    def close(self) -> None:
        """Remove the progress line after all messages are written, or after a timeout."""
        self._is_closed = True
        self._has_changed.set()
        self._thread.join(_CLOSE_TIMEOUT_S)

    def _write_until_closed(self) -> None:
        """Write the progress line and the messages until `close` is called; runs in a thread."""
        is_closed = False
        while not is_closed:
            self._has_changed.wait()
            self._has_changed.clear()
            is_closed = (
                self._is_closed
            )  # read first, so that all earlier messages are still written
            with self._lock:
                messages, self._messages = self._messages, []
            with contextlib.suppress(OSError):  # the session continues without a terminal
                self._write_messages(messages)
        if self._progress.live.is_started:  # otherwise stopping only prints an empty line
            with contextlib.suppress(OSError):
                self._progress.stop()

    def _write_messages(self, messages: list[str]) -> None:
        """Write messages, and redraw the progress line below them."""
        for message in messages:
            self._progress.console.print(message, markup=False, highlight=False, soft_wrap=True)
        if self._state:
            self._progress.start()
            self._progress.update(self._task, **self._state)
            self._progress.refresh()
