"""How well loop, recorder, bus and view are doing, for the operator to see."""

from dataclasses import astuple, dataclass, fields
from typing import Any, Final

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, slots=True)
class Health:
    """Readings of one moment; None is one that is not known (there is no bus, say).

    Attributes
    ----------
    missed_ticks
        Skipped by the loop since the start of the session.
    late_ticks
        That woke late but were not missed, since the start.
    lost_ticks
        Whose samples found no room in the ring, since the start.
    recorder_lag_ticks
        Samples that wait in the ring for the recorder.
    disk_free_mb
        On the disk that the session goes to, in 10⁶ bytes.
    view_dropped
        Samples that could not be shown in time, since the start.
    bus_load_percent
        Of the CAN bus or the serial line.
    bus_errors
        Disturbed, damaged or missing messages, since the devices were connected.
    sensor_status
        Status word of the force-torque sensor; 0: all is well.
    rate_hz
        Ticks a second, as measured.
    """

    missed_ticks: float | None = None
    late_ticks: float | None = None
    lost_ticks: float | None = None
    recorder_lag_ticks: float | None = None
    disk_free_mb: float | None = None
    view_dropped: float | None = None
    bus_load_percent: float | None = None
    bus_errors: float | None = None
    sensor_status: float | None = None
    rate_hz: float | None = None


HEALTH_DTYPE: Final = np.dtype(
    [("t_ns", "<i8")] + [(field.name, "<f8") for field in fields(Health)]
)
"""A reading as a record; NaN is what is not known."""


def health_record(t_ns: int, health: Health) -> npt.NDArray[Any]:
    """Return an array (1,) of ``HEALTH_DTYPE`` with the reading of one moment."""
    values = (np.nan if value is None else value for value in astuple(health))
    return np.array([(t_ns, *values)], HEALTH_DTYPE)
