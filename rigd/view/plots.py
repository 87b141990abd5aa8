"""Plots over time: their curves, units and colours.

Colours are red, green and blue from 0 to 255. Those of Okabe and Ito (2008) are distinguishable
with any colour vision. The colours used here contrast with Rerun's dark and light backgrounds.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from operator import itemgetter
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from rerun import ComponentColumn, RecordingStream


# Colours

Color = tuple[int, int, int]
"""Colour as red, green and blue from 0 to 255."""

ORANGE: Color = (230, 159, 0)
SKY_BLUE: Color = (86, 180, 233)
GREEN: Color = (0, 158, 115)
VERMILION: Color = (213, 94, 0)
PURPLE: Color = (204, 121, 167)
RED: Color = (229, 57, 53)
"""Colour of alarms only."""
GREY: Color = (130, 130, 130)
"""Colour of frames, grids, tick labels, and curves of minor interest."""


Drawing = Callable[["RecordingStream"], None]
"""Function that sends one item to a Rerun recording."""


# Plots over time

Records = npt.NDArray[Any]
"""Structured array (n,) with a field ``t_ns``."""

Values = npt.NDArray[np.float64]
"""Array of plotted values, shape (n,) or (n, curves)."""

APPLICATION_ID: Final = "rigd"
"""Name of the application in Rerun, which stores one window layout for each name."""

TIMELINE: Final = "session_time"
"""Name in Rerun of the timeline of the time since the start of the session, from ``t_ns``."""


@dataclass(frozen=True, slots=True)
class PlotCurve:
    """Curve of a plot over time: label, style and values.

    Attributes
    ----------
    label
        Name in the legend, with its unit.
    color
        Colour of the line.
    values_of_records
        Function from records (n,) to the curve's values (n,).
    width
        Width of the line, in points.
    """

    label: str
    color: Color
    values_of_records: Callable[[Records], Values]
    width: float = 1.5


@dataclass(frozen=True, slots=True)
class Plot:
    """Plot over time: curves with a common vertical axis.

    Attributes
    ----------
    component
        Component name of the plotted values in Rerun, which ends in the unit.
    title
        Title of the axis, with its unit.
    curves
        Curves from the lowest to the topmost.
    fixed_axis_range
        Ends of a fixed axis; None if the axis follows the values.
    min_span
        Least length of the axis in the unit of the curves, so that noise is not drawn as large as a
        signal.
    """

    component: str
    title: str
    curves: tuple[PlotCurve, ...]
    fixed_axis_range: tuple[float, float] | None = None
    min_span: float = 0.0


@dataclass(frozen=True, slots=True)
class PlotSource:
    """Group of plots whose values come from the same kind of records.

    Attributes
    ----------
    entity
        Entity path of all values in Rerun. The plots have the same entity, because the cost of
        sending depends on the number of entities.
    plots
        Plots; each record has values for all of them.
    """

    entity: str
    plots: tuple[Plot, ...]

    @property
    def tick_entity(self) -> str:
        """Entity path in Rerun of the invisible points that extend the plots' axes."""
        return f"{self.entity}/ticks"

    def values_by_component(self, records: Records) -> dict[str, Values]:
        """Return the values (n, curves) of each plot from records (n,), by component name."""
        return {
            plot.component: np.column_stack(
                [plot_curve.values_of_records(records) for plot_curve in plot.curves]
            )
            for plot in self.plots
        }


def send_columns(
    stream: "RecordingStream",
    entity: str,
    t_ns: npt.NDArray[np.int64],
    columns: Mapping[str, Values],
) -> None:
    """Send values over time to an entity in Rerun.

    Parameters
    ----------
    stream
        Recording to send to.
    entity
        Entity path in Rerun.
    t_ns
        Times since the start of the session, shape (n,).
    columns
        Values (n, k) at these times, by component name.
    """
    import rerun as rr

    time_column = rr.TimeColumn(TIMELINE, duration=t_ns.astype("timedelta64[ns]"))
    stream.send_columns(
        entity,
        [time_column],
        [
            _component_column(component_name, component_values)
            for component_name, component_values in columns.items()
        ],
        strict=True,
    )


def _component_column(component_name: str, component_values: Values) -> "ComponentColumn":
    """Return values (n, k) as a column of Rerun's data, with k scalars in each of n rows."""
    import rerun as rr

    row_count, values_per_row = component_values.shape
    scalar_batch = rr.components.ScalarBatch(component_values.ravel())
    return rr.ComponentColumn(
        rr.ComponentDescriptor(component_name, component_type=scalar_batch.component_type()),
        scalar_batch,
        offsets=np.arange(0, row_count * values_per_row + 1, values_per_row, dtype=np.int32),
    )


def _axis_curves(field_pattern: str, axis_symbol: str, unit: str) -> tuple[PlotCurve, ...]:
    """Return the curves of the sensor's forces or torques along the axes x, y and z.

    `field_pattern` is the name of the samples' fields, such as ``f{}_n``, where {} is the axis.
    """
    return tuple(
        PlotCurve(
            f"{axis_symbol}{axis_letter} ({unit})",
            color,
            itemgetter(field_pattern.format(axis_letter)),
        )
        for axis_letter, color in zip("xyz", (ORANGE, SKY_BLUE, PURPLE), strict=True)
    )


ANGLE = Plot(
    "angle_mrad",
    "Motor angle (mrad)",
    (
        # Wider, because it lies under the measured angle.
        PlotCurve("reference (mrad)", ORANGE, lambda r: 1e3 * r["angle_reference_rad"], 2.5),
        PlotCurve("measured (mrad)", SKY_BLUE, lambda r: 1e3 * r["angle_rad"]),
    ),
    min_span=4.0,
)
"""Plot of the motor's measured angle and its reference."""
TRACKING_ERROR = Plot(
    "tracking_error_mrad",
    "Tracking error, reference − measured (mrad)",
    (
        PlotCurve(
            "tracking error (mrad)",
            VERMILION,
            lambda r: 1e3 * (r["angle_reference_rad"] - r["angle_rad"]),
        ),
    ),
    min_span=2.0,
)
"""Plot of the difference of reference and measured angle."""
COUPLING_TORQUE = Plot(
    "coupling_torque_nm",
    "Coupling torque, tared (N·m)",
    (PlotCurve("coupling torque (N·m)", GREEN, lambda r: r["coupling_torque_nm"]),),
    min_span=0.1,
)
"""Plot of the torque between motor and beam."""
TORQUE_COMMAND = Plot(
    "torque_command_nm",
    "Torque command, after limits (N·m)",
    (PlotCurve("torque command (N·m)", PURPLE, lambda r: r["torque_command_nm"]),),
    min_span=0.1,
)
"""Plot of the torque that the motor is commanded to apply."""
FORCES = Plot("forces_n", "Forces at the sensor (N)", _axis_curves("f{}_n", "F", "N"), min_span=1.0)
"""Plot of the three forces at the sensor."""
TORQUES = Plot(
    "torques_nm", "Torques at the sensor (N·m)", _axis_curves("t{}_nm", "T", "N·m"), min_span=0.1
)
"""Plot of the three torques at the sensor."""
LOOP = Plot(
    "loop_us",
    "Wake-up latency and execution time of the loop (µs)",
    (
        PlotCurve("wake-up latency (µs)", GREY, lambda r: 1e-3 * r["lateness_ns"]),
        PlotCurve("execution time (µs)", ORANGE, lambda r: 1e-3 * r["work_ns"]),
    ),
    min_span=100.0,
)
"""Plot of the control loop's wake-up latency and execution time."""
SIGNALS = PlotSource(
    "/signals",
    (ANGLE, TRACKING_ERROR, COUPLING_TORQUE, TORQUE_COMMAND, FORCES, TORQUES, LOOP),
)
"""Plots of the samples."""

AGES = Plot(
    "ages_ms",
    "Measurement latency (ms)",
    (
        PlotCurve("angle (ms)", SKY_BLUE, lambda r: 1e3 * r["angle_age_s"], 2.5),
        PlotCurve("wrench (ms)", GREEN, lambda r: 1e3 * r["wrench_age_s"]),
    ),
    min_span=1.0,
)
"""Plot of the age of angle and wrench readings."""
READINGS = PlotSource("/readings", (AGES,))
"""Plots of the readings' timings."""

FAULTY_TICKS = Plot(
    "faulty_ticks",
    "Missed, late and lost (ticks since the start)",
    (
        PlotCurve("missed (ticks)", VERMILION, lambda r: r["missed_ticks"]),
        PlotCurve("late (ticks)", ORANGE, lambda r: r["late_ticks"]),
        PlotCurve("lost (ticks)", PURPLE, lambda r: r["lost_ticks"]),
    ),
    min_span=10.0,
)
"""Plot of the number of missed, late and lost ticks."""
BACKLOG = Plot(
    "backlog_samples",
    "Backlog of the recorder, dropped by the viewer (samples)",
    (
        PlotCurve("recorder backlog (samples)", SKY_BLUE, lambda r: r["recorder_lag_ticks"]),
        PlotCurve("dropped by the viewer (samples)", GREY, lambda r: r["view_dropped"]),
    ),
    min_span=100.0,
)
"""Plot of two numbers of samples: not yet written by the recorder, and dropped by the viewer."""
BUS_LOAD = Plot(
    "bus_load_percent",
    "Bus load (%)",
    (PlotCurve("bus load (%)", SKY_BLUE, lambda r: r["bus_load_percent"]),),
    fixed_axis_range=(0.0, 105.0),
)
"""Plot of the load of the bus."""
BUS_ERRORS = Plot(
    "bus_errors",
    "Bus errors since the devices were connected (count)",
    (PlotCurve("bus errors (count)", VERMILION, lambda r: r["bus_errors"]),),
    min_span=10.0,
)
"""Plot of the number of bus errors."""
SENSOR_STATUS = Plot(
    "sensor_status",
    "Status word of the sensor (0: OK)",
    (PlotCurve("sensor status (word)", PURPLE, lambda r: r["sensor_status"]),),
)
"""Plot of the sensor's status word."""
DISK = Plot(
    "disk_free_gb",
    "Free on the disk (GB)",
    (PlotCurve("free on the disk (GB)", GREEN, lambda r: 1e-3 * r["disk_free_mb"]),),
    min_span=1.0,
)
"""Plot of the free disk space."""
BUS_PLOT_COMPONENTS: Final = frozenset(
    plot.component for plot in (BUS_LOAD, BUS_ERRORS, SENSOR_STATUS)
)
"""Component names of the plots that have values only with a bus."""
REAL_TIME_PLOT_COMPONENTS: Final = frozenset(plot.component for plot in (LOOP, AGES))
"""Component names of the plots that have no values with the virtual clock of a simulation."""
HEALTH = PlotSource("/health", (FAULTY_TICKS, BACKLOG, BUS_LOAD, BUS_ERRORS, SENSOR_STATUS, DISK))
"""Plots of the health readings."""
