"""Make the layouts with which Rerun and Foxglove plot a session file that is opened directly.

Run it from anywhere after a change of the format or of what is shown; a test compares its output
with what is in this folder. ``docs/opening_sessions.md`` tells how the layouts are used.
"""

import argparse
import json
import uuid
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rigd.view.plots import APPLICATION_ID, GREEN, GREY, ORANGE, PURPLE, SKY_BLUE, VERMILION, Color

if TYPE_CHECKING:
    import rerun.blueprint as rrb

RERUN: Final = "rigd.rbl"
FOXGLOVE: Final = "foxglove.json"

SAMPLE_TOPIC: Final = "/rig/sample"
EVENT_TOPIC: Final = "/rig/event"


@dataclass(frozen=True, slots=True)
class Panel:
    """Fields of the samples that share an axis.

    Attributes
    ----------
    title
        With the unit, which is the file's.
    curves
        Field, label and colour of each curve, from the lowest to the topmost.
    """

    title: str
    curves: tuple[tuple[str, str, Color], ...]


LEFT: Final = (
    Panel(
        "Motor angle (rad)",
        (("angle_reference_rad", "reference", ORANGE), ("angle_rad", "measured", SKY_BLUE)),
    ),
    Panel("Coupling torque (N·m)", (("coupling_torque_nm", "coupling torque", GREEN),)),
    Panel("Torque command (N·m)", (("torque_command_nm", "torque command", PURPLE),)),
)
RIGHT: Final = (
    Panel(
        "Forces at the sensor (N)",
        (("fx_n", "Fx", ORANGE), ("fy_n", "Fy", SKY_BLUE), ("fz_n", "Fz", PURPLE)),
    ),
    Panel(
        "Torques at the sensor (N·m)",
        (("tx_nm", "Tx", ORANGE), ("ty_nm", "Ty", SKY_BLUE), ("tz_nm", "Tz", PURPLE)),
    ),
    Panel(
        "Lateness and work time of the loop (ns)",
        (
            ("lateness_ns", "wake-up after schedule", GREY),
            ("work_ns", "work of the tick", ORANGE),
        ),
    ),
)

ERROR_TOPIC: Final = "/studio_script/tracking_error"
ERROR_FIELD: Final = "tracking_error_rad"
ERROR_SCRIPT: Final = f"""\
// The tracking error is not in the file: it is what the motor lacks of its reference.
import {{ Input }} from "./types";

type Output = {{ {ERROR_FIELD}: number }};

export const inputs = ["{SAMPLE_TOPIC}"];
export const output = "{ERROR_TOPIC}";

export default function script(event: Input<"{SAMPLE_TOPIC}">): Output {{
  return {{ {ERROR_FIELD}: event.message.angle_reference_rad - event.message.angle_rad }};
}}
"""


def rerun_layout() -> "rrb.Blueprint":
    """Return Rerun's layout of a session file, whose fields it does not plot by itself."""
    import rerun.blueprint as rrb

    events = rrb.TextLogView(name="Events", origin=EVENT_TOPIC)
    columns = [rrb.Vertical(*map(_rerun_plot, panels)) for panels in (LEFT, RIGHT)]
    plots = rrb.Horizontal(*columns)
    whole = rrb.Vertical(plots, events, row_shares=[5, 1])
    # Not by chance, so that a layout that is made again is the same.
    for name, part in {"left": columns[0], "right": columns[1], "plots": plots}.items():
        part.id = _fixed_id(name)
    whole.id, events.id = _fixed_id("whole"), _fixed_id("events")
    return rrb.Blueprint(
        whole,
        rrb.TimePanel(timeline="message_log_time", play_state="paused", state="collapsed"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
    )


def foxglove_layout() -> dict[str, Any]:
    """Return Foxglove's layout, as its app exports and imports layouts."""
    error = _foxglove_plot(
        "Tracking error, reference − measured (rad)",
        [_foxglove_path(f"{ERROR_TOPIC}.{ERROR_FIELD}", "tracking error", VERMILION)],
    )
    angle, torque, command, forces, torques, loop = (
        _foxglove_plot(
            panel.title,
            [
                _foxglove_path(f"{SAMPLE_TOPIC}.{field}", label, color)
                for field, label, color in panel.curves
            ],
        )
        for panel in (*LEFT, *RIGHT)
    )
    events = {"searchTerms": [], "minLogLevel": 1, "topicToRender": EVENT_TOPIC}
    columns = (
        {
            "Plot!angle": angle,
            "Plot!trackingError": error,
            "Plot!couplingTorque": torque,
            "Plot!torqueCommand": command,
        },
        {
            "Plot!forces": forces,
            "Plot!torques": torques,
            "Plot!loop": loop,
            "RosOut!events": events,
        },
    )
    return {
        "configById": {name: config for column in columns for name, config in column.items()},
        "globalVariables": {},
        "userNodes": {
            str(_fixed_id("tracking error")): {
                "name": "Tracking error",
                "sourceCode": ERROR_SCRIPT,
            }
        },
        "playbackConfig": {"speed": 1},
        "layout": {
            "direction": "row",
            "first": _stacked(list(columns[0])),
            "second": _stacked(list(columns[1])),
            "splitPercentage": 50,
        },
    }


def write(folder: Path) -> None:
    """Write both layouts into a folder."""
    rerun_layout().save(APPLICATION_ID, str(folder / RERUN))
    text = json.dumps(foxglove_layout(), indent=2, ensure_ascii=False)
    (folder / FOXGLOVE).write_text(f"{text}\n", encoding="utf-8")


def _rerun_plot(panel: Panel) -> "rrb.TimeSeriesView":
    import rerun as rr
    import rerun.blueprint as rrb
    from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

    curves = [
        # The default averages what falls on one pixel, and so understates peaks.
        rr.SeriesLines(names=[label], colors=[color], aggregation_policy="MinMax").visualizer(
            mappings=[
                VisualizerComponentMapping(
                    "Scalars:scalars",
                    ComponentSourceKind.SourceComponent,
                    source_component="rigd.Sample:message",
                    selector=f".{field}",
                )
            ]
        )
        for field, label, color in panel.curves
    ]
    for curve, (field, _, _) in zip(curves, panel.curves, strict=True):
        curve.id = _fixed_id(field)
    whole = rr.TimeRange(
        start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.infinite()
    )
    view = rrb.TimeSeriesView(
        name=panel.title,
        origin=SAMPLE_TOPIC,
        overrides={SAMPLE_TOPIC: curves},
        plot_legend=rrb.PlotLegend(corner="LeftTop", visible=len(curves) > 1),
        # Left to itself it shows a minute around the cursor.
        axis_x=rrb.TimeAxis(view_range=whole),
    )
    view.id = _fixed_id(panel.title)
    return view


def _foxglove_plot(title: str, paths: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "title": title,
        "foxglovePanelTitle": title,
        "paths": paths,
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "showLegend": True,
        "legendDisplay": "floating",
        "showPlotValuesInLegend": False,
        "isSynced": True,
        "xAxisVal": "timestamp",
    }


def _foxglove_path(value: str, label: str, color: Color) -> dict[str, Any]:
    return {
        "value": value,
        "label": label,
        "color": "#{:02x}{:02x}{:02x}".format(*color),
        "enabled": True,
        "timestampMethod": "receiveTime",
    }


def _stacked(panels: list[str]) -> str | dict[str, Any]:
    """Return panels one under the other, all of the same height."""
    first, *rest = panels
    if not rest:
        return first
    return {
        "direction": "column",
        "first": first,
        "second": _stacked(rest),
        "splitPercentage": 100 / len(panels),
    }


def _fixed_id(name: str) -> uuid.UUID:
    return uuid.uuid5(uuid.NAMESPACE_URL, f"{APPLICATION_ID}/layouts/{name}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Make the layouts again.")
    parser.add_argument("folder", nargs="?", type=Path, default=Path(__file__).parent)
    write(parser.parse_args().folder)
