"""What a picture is of: a session, as far as its views depend on it."""

from dataclasses import dataclass

from rigd.beam import Beam, Damping


@dataclass(frozen=True, slots=True)
class Subject:
    """A session, as far as its views depend on it.

    Attributes
    ----------
    name
        Of the session; the viewer shows it as the recording's.
    rate_hz
        Scheduled ticks a second.
    ticks
        Of the whole record, as scheduled.
    sweep
        First tick of the excitation, and its end (exclusive).
    beam
        The specimen.
    damping
        Nominal damping of the profile; None where it is not known: then no model is drawn over the
        frequency response.
    tool_inertia_kg_m2
        Between the torque sensor and the beam, about the motor's axis.
    angle_delay_s, torque_delay_s
        Age of either value at its time stamp; positive: the value is older.
    """

    name: str
    rate_hz: float
    ticks: int
    sweep: tuple[int, int]
    beam: Beam
    damping: Damping | None
    tool_inertia_kg_m2: float = 0.0
    angle_delay_s: float = 0.0
    torque_delay_s: float = 0.0
