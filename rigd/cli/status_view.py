"""The daemon's status as a text for the operator."""

from collections.abc import Iterator
from datetime import datetime
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from rigd.engine.board import Phase

_STYLES = {
    "idle": "dim",
    "ready": "green",
    "running": "bold green",
    "stopping": "yellow",
    "fault": "bold red",
}
_SHOWN_TRANSITIONS = 8


def print_status(told: dict[str, Any]) -> None:
    """Write it to standard output."""
    Console(highlight=False).print(status_table(told))


def status_table(told: dict[str, Any]) -> RenderableType:
    """Return it as something that rich can show.

    Parameters
    ----------
    told
        The daemon's reply to ``status``.
    """
    head = Table(box=None, pad_edge=False, show_header=False)
    head.add_column(style="dim", no_wrap=True)
    head.add_column(overflow="fold")
    for name, value in _rows(told):
        head.add_row(name, value)
    parts: list[RenderableType] = [head]
    rig = told["rig"]
    if rig is not None:
        parts += [_processes(rig["processes"]), _topics(rig["topics"], told["state"])]
    parts.append(_history(told["history"]))
    return Group(*parts)


def _rows(told: dict[str, Any]) -> Iterator[tuple[str, Text]]:
    daemon, series, progress, rig = (told[name] for name in ("daemon", "series", "progress", "rig"))
    yield "rig", Text(f"{daemon['profile']} ({daemon['moving']}), daemon {daemon['pid']}")
    doing = f" ({told['doing']})" if told["doing"] else ""
    state = Text(f"{told['state']}{doing}", style=_STYLES.get(told["state"], ""))
    state.append(f" since {_clock(told['since_utc_ns'])}: {told['reason']}", style="default")
    yield "state", state
    if told["zero_lost"]:
        yield "zero", Text("lost with the connection: run rigd zero", style="bold yellow")
    controller = told["controller"]
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
    if rig is not None:
        yield "angle", Text(f"{rig['angle_rad']:+.5f} rad")
        yield "coupling torque", Text(f"{rig['coupling_torque_nm']:+.4f} N·m")
        yield "torque command", Text(f"{rig['torque_command_nm']:+.4f} N·m")
    yield "output", Text(daemon["output"])


def progress_text(progress: dict[str, Any]) -> str:
    """Say in one line how far a session is."""
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
    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 2, 0, 0), title_justify="left")
    table.add_column(title, no_wrap=True)
    for column in columns:
        table.add_column(column, justify="right", no_wrap=True)
    return table


def _processes(processes: list[dict[str, Any]]) -> Table:
    table = _table("process", "pid", "state", "last sign")
    for process in processes:
        bad = process["state"] in ("hung", "ended")
        table.add_row(
            process["name"],
            str(process["pid"]),
            Text(process["state"], style="bold red" if bad else ""),
            f"{process['still_s']:.1f} s ago"
            if process["state"] not in ("waiting", "done")
            else "",
        )
    return table


def _topics(topics: list[dict[str, Any]], state: str) -> Table:
    table = _table("topic", "records", "rate", "expected", "waiting")
    for topic in topics:
        recording = state in ("running", "stopping")
        table.add_row(
            topic["name"],
            str(topic["written"]),
            _rate(topic["rate_hz"]),
            _rate(topic["expected_hz"]) if recording else "",
            str(topic["waiting"]),
        )
    return table


def _rate(rate_hz: float | None) -> str:
    return "" if rate_hz is None else f"{rate_hz:.0f} Hz"


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
