"""Display of the daemon's status on a terminal."""

from collections.abc import Iterator
from datetime import datetime
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from rigd.engine.shared_state import Phase

_STATE_STYLES = {  # Style of each state of the daemon
    "idle": "dim",
    "ready": "green",
    "running": "bold green",
    "stopping": "yellow",
    "fault": "bold red",
}
_MAX_SHOWN_TRANSITIONS = 4
"""Number of the daemon's last changes of state that are shown."""
_HIGH_BUS_LOAD_PERCENT = 80.0
"""Load of the CAN bus in per cent above which the load is highlighted."""


def print_status(status: dict[str, Any]) -> None:
    """Print the status of the daemon on the terminal."""
    Console(highlight=False).print(status_table(status))


def status_table(status: dict[str, Any]) -> RenderableType:
    """Return the daemon's reply to the request ``status`` as a rich table."""
    summary_table = Table(box=None, pad_edge=False, show_header=False)
    summary_table.add_column(style="dim", no_wrap=True)
    summary_table.add_column(overflow="fold")
    for row_name, row_value in _summary_rows(status):
        summary_table.add_row(row_name, row_value)
    status_parts: list[RenderableType] = [summary_table]
    rig_status = status["rig"]
    if rig_status is not None:
        is_recording = status["state"] in ("running", "stopping")
        tables_grid = Table.grid(padding=(0, 2, 0, 0))
        tables_grid.add_row(
            Group("", _signal_table(rig_status), "", _health_table(rig_status)),
            Group(
                "",
                _process_table(rig_status["processes"]),
                "",
                _topic_table(rig_status["topics"], is_recording=is_recording),
            ),
        )
        status_parts.append(tables_grid)
    status_parts.append(_transition_table(status["history"]))
    return Group(*status_parts)


def _summary_rows(status: dict[str, Any]) -> Iterator[tuple[str, Text]]:
    """Yield the names and values at the top of the status: rig, state, series and addresses."""
    daemon, session_series, progress = (
        status[status_key] for status_key in ("daemon", "series", "progress")
    )
    yield "rig", Text(f"{daemon['profile']} ({daemon['moving']}), daemon {daemon['pid']}")
    action_text = f" ({status['doing']})" if status["doing"] else ""
    activity_text = status["state"]
    if activity_text == "running" and progress is not None:
        activity_text = progress.get("activity", activity_text)  # an older daemon has none
    state_text = Text(f"{activity_text}{action_text}", style=_STATE_STYLES.get(status["state"], ""))
    state_text.append(
        f" since {_local_time(status['since_utc_ns'])}: {status['reason']}", style="default"
    )
    yield "state", state_text
    if status["zero_lost"]:
        yield "zero", Text("lost with the connection: run rigd zero", style="bold yellow")
    controlling_client = status["controller"]
    yield (
        "control",
        Text(
            "free"
            if controlling_client is None
            else f"process {controlling_client['pid']} of {controlling_client['user']}"
        ),
    )
    if session_series is not None:
        yield "series", Text(_series_text(session_series))
    if progress is not None:
        yield "session", Text(progress_text(progress))
    # An older daemon reports no fit; a fit without lines belongs to a lost record.
    if session_series is not None and (fit_lines := (session_series.get("fit") or {}).get("text")):
        yield "fit", Text("\n".join(fit_lines))
    rig_status = status["rig"]
    if rig_status is not None and rig_status["live_view"] is not None:
        yield "live view", Text(rig_status["live_view"]["url"])
    if daemon.get("web") is not None:
        from rigd.daemon import page_address  # late: it is slow to import

        yield "page", Text(page_address(daemon["profile"]) or daemon["web"])
    yield "output", Text(daemon["output"])


def progress_text(progress: dict[str, Any]) -> str:
    """Format the progress of a session as one line: phase, percentage, time left, and counts."""
    remaining_s = progress["time_left_s"]
    time_left_text = "" if remaining_s is None else f", {remaining_s:.0f} s left"
    return (
        f"{Phase[progress['phase'].upper()].display_text}, {progress['percent']:.0f} %"
        f"{time_left_text}; {progress['missed']} missed, {progress['late']} late, "
        f"{progress['lost']} lost"
    )


def _series_text(series: dict[str, Any]) -> str:
    """Return a line of text on the progress or the result of a series of sessions."""
    series_title = f"{series['excitation']} {series['session']} of {series['repeat']}"
    if series["running"]:
        return f"{series_title}: {series['path'] or 'being planned'}"
    complete_sessions = [
        session for session in series["sessions"] if session["outcome"] == "complete"
    ]
    reason_text = f" ({series['reason']})" if series["reason"] else ""
    return f"{series_title}, ended: {len(complete_sessions)} complete{reason_text}"


def _empty_table(first_title: str, *other_titles: str) -> Table:
    """Return a table without rows: first column left-aligned, other columns right-aligned."""
    empty_table = Table(
        box=None, pad_edge=False, padding=(0, 1, 0, 0), header_style="bold underline"
    )
    empty_table.add_column(first_title, no_wrap=True)
    for column_title in other_titles:
        empty_table.add_column(column_title, justify="right", no_wrap=True)
    return empty_table


def _signal_table(rig_status: dict[str, Any]) -> Table:
    """Return the table of the rig's present signals and their peaks in the record."""
    signal_table = _empty_table("signal", "now", "peak")
    signals = rig_status["signals"] or {}
    for signal_name, unit_text, decimal_count, now, peak_value in (
        ("angle", "rad", 5, rig_status["angle_rad"], None),
        (
            "tracking error",
            "rad",
            5,
            signals.get("tracking_error_rad"),
            signals.get("peak_tracking_error_rad"),
        ),
        (
            "coupling torque",
            "N·m",
            4,
            rig_status["coupling_torque_nm"],
            signals.get("peak_coupling_torque_nm"),
        ),
        (
            "torque command",
            "N·m",
            4,
            rig_status["torque_command_nm"],
            signals.get("peak_torque_command_nm"),
        ),
    ):
        signal_table.add_row(
            f"{signal_name}, {unit_text}",
            "" if now is None else f"{now:+.{decimal_count}f}",
            "" if peak_value is None else f"{peak_value:.{decimal_count}f}",
        )
    return signal_table


def _health_table(rig_status: dict[str, Any]) -> Table:
    """Return the table of the health of loop, recorder, bus and live view, problems in colour."""
    health_table = _empty_table("health", "")
    for row_name, row_text, row_style in _health_rows(rig_status):
        health_table.add_row(row_name, Text(row_text, style=row_style))
    return health_table


def _health_rows(rig_status: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Yield the name, text and style of each row of `_health_table`."""
    health, signals = rig_status["health"], rig_status["signals"]
    if signals is not None:
        # The expected rate of the samples is that of the loop.
        expected_rate_hz = max(topic["expected_hz"] or 0.0 for topic in rig_status["topics"])
        is_rate_low = signals["rate_hz"] < 0.999 * expected_rate_hz
        yield "rate", f"{signals['rate_hz']:.1f} Hz", "yellow" if is_rate_low else ""
        latency_text = f"{signals['lateness_p50_us']:.0f}, {signals['lateness_p99_us']:.0f} µs"
        yield "wake-up latency p50, p99", latency_text, ""
        yield "execution time p99", f"{signals['work_p99_us']:.0f} µs", ""
    tick_counts_text = f"{health['missed']}, {health['late']}, {health['lost']}"
    tick_counts_style = "bold red" if health["lost"] else "yellow" if health["missed"] else ""
    yield "missed, late, lost", tick_counts_text, tick_counts_style
    if health["bus_load_percent"] is not None:
        bus_load_percent = health["bus_load_percent"]
        yield (
            "bus load",
            f"{bus_load_percent:.1f} %",
            "yellow" if bus_load_percent > _HIGH_BUS_LOAD_PERCENT else "",
        )
    if health["bus_errors"] is not None:
        bus_errors = health["bus_errors"]
        yield "bus errors", str(bus_errors), "yellow" if bus_errors else ""
    if health["sensor_status"] is not None:
        sensor_status = health["sensor_status"]
        yield (
            "sensor",
            f"status {sensor_status:#06x}" if sensor_status else "OK",
            "red" if sensor_status else "",
        )
    if health["disk_free_mb"] is not None:
        yield "free on the disk", f"{1e-3 * health['disk_free_mb']:.1f} GB", ""
    if health["view_dropped"]:
        yield "dropped by the viewer", f"{health['view_dropped']} samples", "yellow"


def _process_table(processes: list[dict[str, Any]]) -> Table:
    """Return the table of the rig's processes with their state and last heartbeat."""
    process_table = _empty_table("process", "pid", "state", "heartbeat, s ago")
    for process in processes:
        is_failed_state = process["state"] in ("hung", "ended")
        process_table.add_row(
            process["name"],
            str(process["pid"]),
            Text(process["state"], style="bold red" if is_failed_state else ""),
            f"{process['still_s']:.1f}" if process["state"] not in ("waiting", "done") else "",
        )
    return process_table


def _topic_table(topics: list[dict[str, Any]], *, is_recording: bool) -> Table:
    """Return the table of recorded message topics with their rate and the recorder's backlog."""
    topic_table = _empty_table("topic", "records", "Hz", "of Hz", "backlog")
    for topic in topics:
        topic_table.add_row(
            topic["name"],
            str(topic["written"]),
            _rate_text(topic["rate_hz"]),
            _rate_text(topic["expected_hz"]) if is_recording else "",
            str(topic["waiting"]),
        )
    return topic_table


def _rate_text(rate_hz: float | None) -> str:
    """Format a rate in Hz; "" for None."""
    return "" if rate_hz is None else f"{rate_hz:.0f}"


def _transition_table(transitions: list[dict[str, Any]]) -> Table:
    """Return the table of the daemon's last changes of state with their reasons."""
    transition_table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 2, 0, 0))
    transition_table.add_column("when", no_wrap=True)
    transition_table.add_column("from → to", no_wrap=True)
    transition_table.add_column("why", overflow="fold")
    for transition in transitions[-_MAX_SHOWN_TRANSITIONS:]:
        transition_table.add_row(
            _local_time(transition["utc_ns"]),
            f"{transition['from']} → {transition['to']}",
            Text(transition["reason"]),
        )
    return transition_table


def _local_time(utc_ns: int) -> str:
    """Format the local time of day of a UTC time in nanoseconds."""
    return f"{datetime.fromtimestamp(utc_ns * 1e-9):%H:%M:%S}"
