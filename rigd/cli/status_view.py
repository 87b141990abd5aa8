"""Status of the daemon as text for the operator."""

from collections.abc import Iterator
from datetime import datetime
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from rigd.daemon import page_address
from rigd.engine.shared_state import Phase

_STYLES = {
    "idle": "dim",
    "ready": "green",
    "running": "bold green",
    "stopping": "yellow",
    "fault": "bold red",
}
_SHOWN_TRANSITIONS = 4
_BUSY_PERCENT = 80.0


def print_status(status: dict[str, Any]) -> None:
    """Print the status of the daemon."""
    Console(highlight=False).print(status_table(status))


def status_table(status: dict[str, Any]) -> RenderableType:
    """Return the daemon's reply to ``status`` as a rich table."""
    head = Table(box=None, pad_edge=False, show_header=False)
    head.add_column(style="dim", no_wrap=True)
    head.add_column(overflow="fold")
    for name, value in _rows(status):
        head.add_row(name, value)
    parts: list[RenderableType] = [head]
    rig = status["rig"]
    if rig is not None:
        recording = status["state"] in ("running", "stopping")
        side_by_side = Table.grid(padding=(0, 2, 0, 0))
        side_by_side.add_row(
            Group("", _signals(rig), "", _health(rig)),
            Group(
                "", _processes(rig["processes"]), "", _topics(rig["topics"], recording=recording)
            ),
        )
        parts.append(side_by_side)
    parts.append(_history(status["history"]))
    return Group(*parts)


def _rows(status: dict[str, Any]) -> Iterator[tuple[str, Text]]:
    daemon, series, progress = (status[name] for name in ("daemon", "series", "progress"))
    yield "rig", Text(f"{daemon['profile']} ({daemon['moving']}), daemon {daemon['pid']}")
    doing = f" ({status['doing']})" if status["doing"] else ""
    word = status["state"]
    if word == "running" and progress is not None:
        word = progress.get("activity", word)  # an older daemon has none
    state = Text(f"{word}{doing}", style=_STYLES.get(status["state"], ""))
    state.append(f" since {_clock(status['since_utc_ns'])}: {status['reason']}", style="default")
    yield "state", state
    if status["zero_lost"]:
        yield "zero", Text("lost with the connection: run rigd zero", style="bold yellow")
    controller = status["controller"]
    yield (
        "control",
        Text(
            "free" if controller is None else f"process {controller['pid']} of {controller['user']}"
        ),
    )
    if series is not None:
        yield "series", Text(_series(series))
    if progress is not None:
        yield "session", Text(progress_text(progress))
    # An older daemon reports no fit; a fit without lines belongs to a lost record.
    if series is not None and (lines := (series.get("fit") or {}).get("text")):
        yield "fit", Text("\n".join(lines))
    rig = status["rig"]
    if rig is not None and rig["live_view"] is not None:
        yield "live view", Text(rig["live_view"]["url"])
    if daemon.get("web") is not None:
        yield "page", Text(page_address(daemon["profile"]) or daemon["web"])
    yield "output", Text(daemon["output"])


def progress_text(progress: dict[str, Any]) -> str:
    """Return the progress of a session as one line."""
    left = progress["time_left_s"]
    time_left = "" if left is None else f", {left:.0f} s left"
    return (
        f"{Phase[progress['phase'].upper()].words}, {progress['percent']:.0f} %"
        f"{time_left}; {progress['missed']} missed, {progress['late']} late, "
        f"{progress['lost']} lost"
    )


def _series(series: dict[str, Any]) -> str:
    what = f"{series['excitation']} {series['session']} of {series['repeat']}"
    if series["running"]:
        return f"{what}: {series['path'] or 'being planned'}"
    done = [session for session in series["sessions"] if session["outcome"] == "complete"]
    why = f" ({series['reason']})" if series["reason"] else ""
    return f"{what}, ended: {len(done)} complete{why}"


def _table(title: str, *columns: str) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0), header_style="bold underline")
    table.add_column(title, no_wrap=True)
    for column in columns:
        table.add_column(column, justify="right", no_wrap=True)
    return table


def _signals(rig: dict[str, Any]) -> Table:
    """Return the table of present signals and of the peaks of the record."""
    table = _table("signal", "now", "peak")
    known = rig["signals"] or {}
    for name, unit, digits, now, peak in (
        ("angle", "rad", 5, rig["angle_rad"], None),
        (
            "tracking error",
            "rad",
            5,
            known.get("tracking_error_rad"),
            known.get("peak_tracking_error_rad"),
        ),
        (
            "coupling torque",
            "N·m",
            4,
            rig["coupling_torque_nm"],
            known.get("peak_coupling_torque_nm"),
        ),
        (
            "torque command",
            "N·m",
            4,
            rig["torque_command_nm"],
            known.get("peak_torque_command_nm"),
        ),
    ):
        table.add_row(
            f"{name}, {unit}",
            "" if now is None else f"{now:+.{digits}f}",
            "" if peak is None else f"{peak:.{digits}f}",
        )
    return table


def _health(rig: dict[str, Any]) -> Table:
    """Return the table of the health of loop, recorder, bus and view; problems are in colour."""
    table = _table("health", "")
    for name, text, style in _health_rows(rig):
        table.add_row(name, Text(text, style=style))
    return table


def _health_rows(rig: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
    health, signals = rig["health"], rig["signals"]
    if signals is not None:
        # The expected rate of the samples is that of the loop.
        expected_hz = max(topic["expected_hz"] or 0.0 for topic in rig["topics"])
        slow = signals["rate_hz"] < 0.999 * expected_hz
        yield "rate", f"{signals['rate_hz']:.1f} Hz", "yellow" if slow else ""
        late = f"{signals['lateness_p50_us']:.0f}, {signals['lateness_p99_us']:.0f} µs"
        yield "wake-up latency p50, p99", late, ""
        yield "execution time p99", f"{signals['work_p99_us']:.0f} µs", ""
    lost = f"{health['missed']}, {health['late']}, {health['lost']}"
    bad = "bold red" if health["lost"] else "yellow" if health["missed"] else ""
    yield "missed, late, lost", lost, bad
    if health["bus_load_percent"] is not None:
        load = health["bus_load_percent"]
        yield "bus load", f"{load:.1f} %", "yellow" if load > _BUSY_PERCENT else ""
    if health["bus_errors"] is not None:
        errors = health["bus_errors"]
        yield "bus errors", str(errors), "yellow" if errors else ""
    if health["sensor_status"] is not None:
        status = health["sensor_status"]
        yield "sensor", f"status {status:#06x}" if status else "OK", "red" if status else ""
    if health["disk_free_mb"] is not None:
        yield "free on the disk", f"{1e-3 * health['disk_free_mb']:.1f} GB", ""
    if health["view_dropped"]:
        yield "dropped by the viewer", f"{health['view_dropped']} samples", "yellow"


def _processes(processes: list[dict[str, Any]]) -> Table:
    table = _table("process", "pid", "state", "heartbeat, s ago")
    for process in processes:
        bad = process["state"] in ("hung", "ended")
        table.add_row(
            process["name"],
            str(process["pid"]),
            Text(process["state"], style="bold red" if bad else ""),
            f"{process['still_s']:.1f}" if process["state"] not in ("waiting", "done") else "",
        )
    return table


def _topics(topics: list[dict[str, Any]], *, recording: bool) -> Table:
    table = _table("topic", "records", "Hz", "of Hz", "backlog")
    for topic in topics:
        table.add_row(
            topic["name"],
            str(topic["written"]),
            _rate(topic["rate_hz"]),
            _rate(topic["expected_hz"]) if recording else "",
            str(topic["waiting"]),
        )
    return table


def _rate(rate_hz: float | None) -> str:
    return "" if rate_hz is None else f"{rate_hz:.0f}"


def _history(transitions: list[dict[str, Any]]) -> Table:
    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("when", no_wrap=True)
    table.add_column("from → to", no_wrap=True)
    table.add_column("why", overflow="fold")
    for transition in transitions[-_SHOWN_TRANSITIONS:]:
        table.add_row(
            _clock(transition["utc_ns"]),
            f"{transition['from']} → {transition['to']}",
            Text(transition["reason"]),
        )
    return table


def _clock(utc_ns: int) -> str:
    return f"{datetime.fromtimestamp(utc_ns * 1e-9):%H:%M:%S}"
