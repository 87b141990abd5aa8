"""Parameters of the closed loop: motor, beam, delays, and the law of the controller."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite

from rigd.beam import Plant
from rigd.control._pid import ControlSettings

CONTROLLER_INPUTS = ("reference_rad", "angle_rad", "coupling_torque_nm")
"""Inputs of a linear controller, in the order of the columns of its matrices b and d."""

MAX_CONTROLLER_STATES = 200
"""Largest number of states of a linear controller; one with 16 takes a microsecond a tick."""


@dataclass(frozen=True, slots=True)
class LinearController:
    """Discrete linear controller at the rig's rate, as a state space.

    The equations are ``x[k+1] = a x[k] + b w[k]`` and ``u[k] = c x[k] + d w[k]``, with the inputs
    w = (reference, measured angle, measured coupling torque) in rad, rad and N·m. Both angles are
    relative to the angle at which the controller was reset, where x = 0. The output u is a torque
    in N·m, or a shift of the reference in rad.

    The matrices are given as nested sequences or arrays, and stored as tuples.

    Raises
    ------
    ValueError
        If the shapes do not match, or a number is not finite.

    Examples
    --------
    >>> from rigd.control import LinearController
    >>> LinearController(a=[[1.0]], b=[[0.2, -0.2, 0.0]], c=[1.0], d=[8.0, -8.0, 1.0]).order
    1
    """

    a: Sequence[Sequence[float]]
    """State matrix, shape (n, n)."""
    b: Sequence[Sequence[float]]
    """Input matrix, shape (n, 3)."""
    c: Sequence[float]
    """Output row, shape (n,)."""
    d: Sequence[float]
    """Direct effect of the inputs on the output, shape (3,)."""
    anti_windup: Sequence[float] = ()
    """Effect on the next state of 1 N·m by which the motor's limit changes the torque, shape (n,).

    It keeps the states from winding up while the torque is limited: for an observer it is the
    column of the torque in its model, for an integral the ratio of period and tracking time. Empty:
    none, which suits a shift of the reference, whose PID has its own."""

    def __post_init__(self) -> None:
        """Check the shapes, and store the matrices as tuples of floats."""
        n = len(self.a)
        if not 0 < n <= MAX_CONTROLLER_STATES:
            raise ValueError(f"a has {n} rows; a controller has 1 to {MAX_CONTROLLER_STATES}.")
        shape_by_matrix = {"a": (n, n), "b": (n, len(CONTROLLER_INPUTS))}
        for name, (row_count, column_count) in shape_by_matrix.items():
            matrix = tuple(tuple(map(float, row)) for row in getattr(self, name))
            if len(matrix) != row_count or {len(row) for row in matrix} != {column_count}:
                raise ValueError(f"{name} must have the shape ({row_count}, {column_count}).")
            object.__setattr__(self, name, matrix)
        length_by_vector = {
            "c": n,
            "d": len(CONTROLLER_INPUTS),
            "anti_windup": n if len(self.anti_windup) else 0,
        }
        for name, length in length_by_vector.items():
            row = tuple(map(float, getattr(self, name)))
            if len(row) != length:
                raise ValueError(f"{name} must have {length} numbers.")
            object.__setattr__(self, name, row)
        for name in (*shape_by_matrix, *length_by_vector):
            coefficients = getattr(self, name)
            for row in coefficients if name in shape_by_matrix else (coefficients,):
                if not all(map(isfinite, row)):
                    raise ValueError(f"{name} has a number that is not finite.")

    @property
    def order(self) -> int:
        """Number of states."""
        return len(self.a)


@dataclass(frozen=True, slots=True)
class LoopModel:
    """Parameters of motor, beam, delays and controller, from which a closed loop is computed."""

    rate_hz: float
    """Ticks a second."""
    plant: Plant | None
    """Beam on the motor, with its damping and ends and the tool inertia; None: the motor alone. The
    delay of the torque relative to the angle follows from the ages of both readings."""
    motor_inertia_kg_m2: float
    """Inertia of the motor, at the output shaft."""
    viscous_nm_s_per_rad: float
    """Viscous friction of the motor, at the output shaft."""
    actuation_delay_s: float
    """Delay from a tick to the instant when its command takes effect; any fraction of a period."""
    angle_delay_s: float
    """Age of the angle reading at the tick that uses it."""
    torque_delay_s: float
    """Age of the coupling torque reading at the tick that uses it."""
    settings: ControlSettings
    """Settings of the controller."""
    controller: LinearController | None = None
    """Linear controller of an installed package; None: the PID alone."""
    shifts_reference: bool = False
    """Whether the output of `controller` is added to the reference of the PID, instead of being the
    motor's torque."""
