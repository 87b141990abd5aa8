"""Obstacles and impacts on a simulated beam, as written in a profile or on the command line.

``x=0.62,angle=0.6,stiffness=3000`` is an obstacle, ``x=0.5,force=2,duration=0.02,at=3`` an impact.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, replace
from math import inf, isfinite

from rigd.beam import Beam
from rigd.devices.parameters import RigParameters
from rigd.errors import UserError


class ObstacleError(UserError, ValueError):
    """Error: an obstacle or impact is written wrongly or cannot be simulated."""


@dataclass(frozen=True, slots=True)
class Obstacle:
    """Obstacle in the path of the simulated beam, which pushes the beam and never pulls it.

    Its force is ``stiffness · penetration + damping · rate of penetration``, and 0 while that sum
    is negative.
    """

    x_m: float
    """Position along the beam in m, from the motor's axis, at which the obstacle touches it."""
    angle_rad: float
    """Angle in rad of the straight beam when it just touches the obstacle."""
    stiffness_n_per_m: float = inf
    """Stiffness of the obstacle in N/m; infinite for a rigid obstacle."""
    damping_n_s_per_m: float = 0.0
    """Damping coefficient of the obstacle in N·s/m."""
    side: int = 1
    """Direction of motion that the obstacle stops: 1 for increasing angles, -1 for decreasing
    angles."""
    rate_rad_s: float = 0.0
    """Rate in rad/s at which the obstacle's angle increases after `from_s`."""
    from_s: float = 0.0
    """Time in seconds at which the obstacle appears, counted from the first enabling of the
    drive."""
    until_s: float = inf
    """Time in seconds at which the obstacle disappears, counted from the first enabling of the
    drive."""


@dataclass(frozen=True, slots=True)
class ImpactSpecification:
    """Impact on the simulated beam: a force pulse with the shape of half a sine."""

    x_m: float
    """Position along the beam in m, from the motor's axis, at which the force acts."""
    force_n: float
    """Peak force in N, positive in the direction of increasing angles."""
    duration_s: float
    """Duration of the force pulse in seconds."""
    at_s: float
    """Time in seconds at which the pulse begins, counted from the first enabling of the drive."""


Disturbance = Obstacle | ImpactSpecification
"""Obstacle or impact on the simulated beam."""


@dataclass(frozen=True, slots=True)
class _ObstacleKey:
    """Key of the text form of an obstacle or impact."""

    field_name: str
    """Name of the dataclass field that the key sets."""
    allowed_text: str
    """Description of the allowed values, for error messages."""
    is_allowed: Callable[[float], bool]
    """Function that returns whether a value is allowed."""
    is_required: bool = False
    """Whether the key must be given."""


_LARGEST_STIFFNESS_N_PER_M = 1e7
"""Largest stiffness in N/m of an obstacle that is not rigid."""
_LATEST_TIME_S = 1e6
"""Largest time in seconds at which an obstacle or impact can begin or end."""


def _is_time_allowed(time_s: float) -> bool:
    """Return whether the start or end time of an obstacle is finite and within its limits."""
    return 0 <= time_s <= _LATEST_TIME_S


_KEYS_BY_DISTURBANCE_TYPE: dict[type[Disturbance], dict[str, _ObstacleKey]] = {
    Obstacle: {
        "x": _ObstacleKey("x_m", "a distance above 0 m", lambda v: 0 < v <= 100, is_required=True),
        "angle": _ObstacleKey(
            "angle_rad", "an angle in rad, -10 to 10", lambda v: abs(v) <= 10, True
        ),
        "stiffness": _ObstacleKey(
            "stiffness_n_per_m",
            f"a stiffness of 1 to {_LARGEST_STIFFNESS_N_PER_M:.0f} N/m, or rigid",
            lambda v: 1 <= v <= _LARGEST_STIFFNESS_N_PER_M or v == inf,
        ),
        "damping": _ObstacleKey(
            "damping_n_s_per_m", "a damping of 0 to 10000 N·s/m", lambda v: 0 <= v <= 1e4
        ),
        "side": _ObstacleKey("side", "1 or -1", lambda v: v in (1, -1)),
        "rate": _ObstacleKey(
            "rate_rad_s", "a speed in rad/s, -100 to 100", lambda v: abs(v) <= 100
        ),
        "from": _ObstacleKey("from_s", "a time in s, at least 0", _is_time_allowed),
        "until": _ObstacleKey("until_s", "a time in s, at least 0", _is_time_allowed),
    },
    ImpactSpecification: {
        "x": _ObstacleKey("x_m", "a distance above 0 m", lambda v: 0 < v <= 100, is_required=True),
        "force": _ObstacleKey(
            "force_n", "a force in N, -1000 to 1000", lambda v: abs(v) <= 1e3, True
        ),
        "duration": _ObstacleKey(
            "duration_s", "a time in s, 0.0001 to 100", lambda v: 1e-4 <= v <= 100, True
        ),
        "at": _ObstacleKey("at_s", "a time in s, at least 0", _is_time_allowed, True),
    },
}
"""Keys of the text form of an obstacle and of an impact."""
_NUMBER_BY_WORD = {"rigid": inf}
"""Numbers that can be written as a word."""
INCOMPATIBLE_WITH_FORCES = (
    "clamp_compliance_rad_per_nm", "tip_mass_kg", "torque_filter_hz", "stiffness_drift_per_s",
)  # fmt: skip
"""Keys of ``[simulation]`` that cannot be combined with a force along the beam."""
INCOMPATIBLE_WITH_OBSTACLES = (
    *INCOMPATIBLE_WITH_FORCES, "air_drag_m", "zeta_scatter_percent", "gamma_scatter_percent",
    "stiffness_scatter_percent",
)  # fmt: skip
"""Keys of ``[simulation]`` that cannot be combined with an obstacle or impact."""


def parse_obstacle(obstacle_text: str) -> Disturbance:
    """Parse the text form of an obstacle or impact.

    Parameters
    ----------
    obstacle_text
        ``key=value`` pairs, separated by commas. For an obstacle: ``x`` (m), ``angle`` (rad) and,
        optionally, ``stiffness`` (N/m, or ``rigid``, the default), ``damping`` (N·s/m), ``side`` (1
        or -1; by default the sign of the angle), ``rate`` (rad/s), ``from`` and ``until`` (s). For
        an impact: ``x``, ``force`` (N), ``duration`` and ``at`` (s).

    Raises
    ------
    ObstacleError
        If a key or value is wrong; the message states the allowed ones.

    Examples
    --------
    >>> from rigd.devices.obstacles import parse_obstacle
    >>> parse_obstacle("x=0.62,angle=0.6,stiffness=3000").stiffness_n_per_m
    3000.0
    """
    assignments = [assignment.strip() for assignment in obstacle_text.split(",")]
    disturbance_type = (
        ImpactSpecification
        if any(assignment.partition("=")[0].strip() == "force" for assignment in assignments)
        else Obstacle
    )
    allowed_key_by_name = _KEYS_BY_DISTURBANCE_TYPE[disturbance_type]
    value_by_field: dict[str, float] = {}
    for assignment in assignments:
        key_name, _, value_text = (text_part.strip() for text_part in assignment.partition("="))
        if key_name not in allowed_key_by_name:
            raise _obstacle_error(
                obstacle_text, f"unknown key '{key_name}'; give {', '.join(allowed_key_by_name)}"
            )
        obstacle_key = allowed_key_by_name[key_name]
        if obstacle_key.field_name in value_by_field:
            raise _obstacle_error(obstacle_text, f"'{key_name}' is given twice")
        try:
            field_value = (
                _NUMBER_BY_WORD[value_text]
                if value_text in _NUMBER_BY_WORD
                else _parse_finite(value_text)
            )
            if not obstacle_key.is_allowed(field_value):
                raise ValueError(value_text)
        except ValueError:
            raise _obstacle_error(
                obstacle_text, f"{key_name}={value_text}: give {obstacle_key.allowed_text}"
            ) from None
        value_by_field[obstacle_key.field_name] = field_value
    for key_name, obstacle_key in allowed_key_by_name.items():
        if obstacle_key.is_required and obstacle_key.field_name not in value_by_field:
            raise _obstacle_error(
                obstacle_text,
                f"'{key_name}' is missing; give {key_name}=…, {obstacle_key.allowed_text}",
            )
    if disturbance_type is ImpactSpecification:
        return ImpactSpecification(**value_by_field)
    side = int(value_by_field.pop("side", _default_side(value_by_field["angle_rad"])))
    obstacle = Obstacle(**value_by_field, side=side)
    if obstacle.until_s <= obstacle.from_s:
        raise _obstacle_error(obstacle_text, "until is not later than from")
    return obstacle


def check_obstacles(
    disturbances: Iterable[Disturbance], beam: Beam, simulated_effects: Mapping[str, float | None]
) -> None:
    """Raise if obstacles or impacts cannot be simulated, because of position or other effects.

    Parameters
    ----------
    disturbances
        Obstacles and impacts.
    beam
        Beam, within whose length every obstacle and impact has to be.
    simulated_effects
        Values of the other simulated effects by the keys in `INCOMPATIBLE_WITH_OBSTACLES`; 0 or
        None if the effect is not simulated.

    Raises
    ------
    ObstacleError
        If an obstacle or impact cannot be simulated; the message states reason and remedy.
    """
    for disturbance in disturbances:
        if disturbance.x_m > beam.length_m:
            raise ObstacleError(
                f"Obstacle '{describe_obstacle(disturbance)}': x={disturbance.x_m:g} m lies beyond "
                f"the tip of the beam at {beam.length_m:g} m (beam.length_m); give a smaller x."
            )
        for effect_name, effect_value in simulated_effects.items():
            if effect_value:
                raise ObstacleError(
                    f"simulation.{effect_name} and an obstacle cannot be simulated together; leave "
                    "one of them out."
                )


def with_obstacles(rig: RigParameters, added_obstacle_texts: Iterable[str]) -> RigParameters:
    """Return a rig's parameters with more obstacles and impacts on its simulated beam.

    Parameters
    ----------
    rig
        Parameters of the rig, with a section ``simulation``.
    added_obstacle_texts
        Obstacles and impacts in the syntax of `parse_obstacle`.

    Raises
    ------
    ObstacleError
        If a text has a syntax error, or cannot be simulated on this rig.
    """
    simulation = rig.simulation
    if simulation is None:
        raise ObstacleError(
            f"The profile {rig.name} has no section [simulation], so that its beam cannot have an "
            "obstacle; copy it from that of rigd profiles show sim."
        )
    added_obstacle_texts = tuple(added_obstacle_texts)
    simulated_effects = {
        effect_name: getattr(simulation, effect_name) for effect_name in INCOMPATIBLE_WITH_OBSTACLES
    }
    check_obstacles(map(parse_obstacle, added_obstacle_texts), rig.beam, simulated_effects)
    return replace(
        rig, simulation=replace(simulation, obstacles=simulation.obstacles + added_obstacle_texts)
    )


def describe_obstacle(disturbance: Disturbance) -> str:
    """Return the text form of an obstacle or impact, which `parse_obstacle` reads back.

    Parameters
    ----------
    disturbance
        Obstacle or impact.
    """
    default_value_by_field = {
        dataclass_field.name: dataclass_field.default for dataclass_field in fields(disturbance)
    }
    if isinstance(disturbance, Obstacle):
        default_value_by_field["side"] = _default_side(disturbance.angle_rad)
    return ",".join(
        f"{key_name}={field_value:g}"
        if float(f"{field_value:g}") == field_value
        else f"{key_name}={field_value!r}"
        for key_name, key in _KEYS_BY_DISTURBANCE_TYPE[type(disturbance)].items()
        if (field_value := getattr(disturbance, key.field_name))
        != default_value_by_field[key.field_name]
    )


def _default_side(angle_rad: float) -> int:
    """Return the default side of an obstacle, reached by a beam that moves away from angle zero."""
    return -1 if angle_rad < 0 else 1


def _parse_finite(number_text: str) -> float:
    """Parse a finite number, or raise ValueError."""
    parsed_number = float(number_text)
    if not isfinite(parsed_number):
        raise ValueError(number_text)
    return parsed_number


def _obstacle_error(obstacle_text: str, reason: str) -> ObstacleError:
    """Return the error for a text that describes no valid obstacle or impact, with the reason."""
    return ObstacleError(f"Obstacle '{obstacle_text}': {reason}.")
