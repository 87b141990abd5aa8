"""Obstacles and impacts on a simulated beam, as written in a profile or on the command line.

``x=0.62,angle=0.6,stiffness=3000`` is an obstacle, ``x=0.5,force=2,duration=0.02,at=3`` a knock.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, replace
from math import inf, isfinite

from rigd.beam import Beam
from rigd.devices.parameters import RigParameters
from rigd.errors import UserError


class ObstacleError(UserError, ValueError):
    """An obstacle has a syntax error; the message states what is allowed."""


@dataclass(frozen=True, slots=True)
class Obstacle:
    """Obstacle in the path of the beam: it pushes, and never pulls.

    Its force is ``stiffness · penetration + damping · its rate``, while that pushes.
    """

    x_m: float
    """Where it meets the beam, from the motor's axis."""
    angle_rad: float
    """Angle at which the straight beam just touches it."""
    stiffness_n_per_m: float = inf
    """Stiffness of the obstacle; infinite: it does not yield."""
    damping_n_s_per_m: float = 0.0
    """Damping of the obstacle."""
    side: int = 1
    """1: it stops a beam that turns in the positive direction; -1: in the negative one."""
    rate_rad_s: float = 0.0
    """Speed at which its angle grows, from `from_s` on."""
    from_s: float = 0.0
    """Time at which it appears; times are counted from the first enabling of the drive."""
    until_s: float = inf
    """Time at which it is gone."""


@dataclass(frozen=True, slots=True)
class ImpactSpecification:
    """Pulse of force on the beam: half a sine."""

    x_m: float
    """Where it hits the beam, from the motor's axis."""
    force_n: float
    """Largest force; positive in the direction of a positive angle."""
    duration_s: float
    """Length of the pulse."""
    at_s: float
    """When it begins, from the first enabling of the drive."""


Disturbance = Obstacle | ImpactSpecification
"""Obstacle or impact on the simulated beam."""


@dataclass(frozen=True, slots=True)
class _ObstacleKey:
    field: str
    says: str
    fits: Callable[[float], bool]
    needed: bool = False


_MOST_STIFF = 1e7
_LONGEST_S = 1e6


def _time(value: float) -> bool:
    return 0 <= value <= _LONGEST_S


_KEYS: dict[type[Disturbance], dict[str, _ObstacleKey]] = {
    Obstacle: {
        "x": _ObstacleKey("x_m", "a distance above 0 m", lambda v: 0 < v <= 100, needed=True),
        "angle": _ObstacleKey(
            "angle_rad", "an angle in rad, -10 to 10", lambda v: abs(v) <= 10, True
        ),
        "stiffness": _ObstacleKey(
            "stiffness_n_per_m",
            f"a stiffness of 1 to {_MOST_STIFF:.0f} N/m, or rigid",
            lambda v: 1 <= v <= _MOST_STIFF or v == inf,
        ),
        "damping": _ObstacleKey(
            "damping_n_s_per_m", "a damping of 0 to 10000 N·s/m", lambda v: 0 <= v <= 1e4
        ),
        "side": _ObstacleKey("side", "1 or -1", lambda v: v in (1, -1)),
        "rate": _ObstacleKey(
            "rate_rad_s", "a speed in rad/s, -100 to 100", lambda v: abs(v) <= 100
        ),
        "from": _ObstacleKey("from_s", "a time in s, at least 0", _time),
        "until": _ObstacleKey("until_s", "a time in s, at least 0", _time),
    },
    ImpactSpecification: {
        "x": _ObstacleKey("x_m", "a distance above 0 m", lambda v: 0 < v <= 100, needed=True),
        "force": _ObstacleKey(
            "force_n", "a force in N, -1000 to 1000", lambda v: abs(v) <= 1e3, True
        ),
        "duration": _ObstacleKey(
            "duration_s", "a time in s, 0.0001 to 100", lambda v: 1e-4 <= v <= 100, True
        ),
        "at": _ObstacleKey("at_s", "a time in s, at least 0", _time, True),
    },
}
_WORDS = {"rigid": inf}
INCOMPATIBLE_WITH_FORCES = (
    "clamp_compliance_rad_per_nm", "tip_mass_kg", "torque_filter_hz", "stiffness_drift_per_s",
)  # fmt: skip
"""Keys of ``[simulation]`` with which no force along the beam is simulated, whatever exerts it."""
INCOMPATIBLE_WITH_OBSTACLES = (
    *INCOMPATIBLE_WITH_FORCES, "air_drag_m", "zeta_scatter_percent", "gamma_scatter_percent",
    "stiffness_scatter_percent",
)  # fmt: skip
"""Keys of ``[simulation]`` with which no obstacle is simulated."""


def parse_obstacle(text: str) -> Disturbance:
    """Read an obstacle or a knock.

    Parameters
    ----------
    text
        ``key=value`` with commas: ``x`` (m), ``angle`` (rad) and, if wanted, ``stiffness`` (N/m,
        or ``rigid``, the default), ``damping`` (N·s/m), ``side`` (1 or -1; by default that of the
        angle's sign), ``rate`` (rad/s), ``from`` and ``until`` (s); for a knock ``x``, ``force``
        (N), ``duration`` and ``at`` (s).

    Raises
    ------
    ObstacleError
        If a key or value is wrong; the message states what is allowed.

    Examples
    --------
    >>> from rigd.devices.obstacles import parse_obstacle
    >>> parse_obstacle("x=0.62,angle=0.6,stiffness=3000").stiffness_n_per_m
    3000.0
    """
    words = [word.strip() for word in text.split(",")]
    kind = (
        ImpactSpecification
        if any(word.partition("=")[0].strip() == "force" for word in words)
        else Obstacle
    )
    keys = _KEYS[kind]
    values: dict[str, float] = {}
    for word in words:
        name, _, given = (part.strip() for part in word.partition("="))
        if name not in keys:
            raise _complaint(text, f"unknown key '{name}'; give {', '.join(keys)}")
        key = keys[name]
        if key.field in values:
            raise _complaint(text, f"'{name}' is given twice")
        try:
            value = _WORDS[given] if given in _WORDS else _finite(given)
            if not key.fits(value):
                raise ValueError(given)
        except ValueError:
            raise _complaint(text, f"{name}={given}: give {key.says}") from None
        values[key.field] = value
    for name, key in keys.items():
        if key.needed and key.field not in values:
            raise _complaint(text, f"'{name}' is missing; give {name}=…, {key.says}")
    if kind is ImpactSpecification:
        return ImpactSpecification(**values)
    side = int(values.pop("side", _side_of(values["angle_rad"])))
    obstacle = Obstacle(**values, side=side)
    if obstacle.until_s <= obstacle.from_s:
        raise _complaint(text, "until is not later than from")
    return obstacle


def check_obstacles(
    disturbances: Iterable[Disturbance], beam: Beam, simulated: Mapping[str, float | None]
) -> None:
    """Refuse obstacles that cannot be simulated on a rig.

    Parameters
    ----------
    disturbances
        Obstacles and knocks.
    beam
        The beam, on which they have to be.
    simulated
        Other simulated effects, by the keys of `INCOMPATIBLE_WITH_OBSTACLES`; 0 or None: none
        of that kind.

    Raises
    ------
    ObstacleError
        If one cannot be simulated; the message states reason and remedy.
    """
    for disturbance in disturbances:
        if disturbance.x_m > beam.length_m:
            raise ObstacleError(
                f"Obstacle '{describe_obstacle(disturbance)}': x={disturbance.x_m:g} m lies beyond "
                f"the tip of the beam at {beam.length_m:g} m (beam.length_m); give a smaller x."
            )
        for name, value in simulated.items():
            if value:
                raise ObstacleError(
                    f"simulation.{name} and an obstacle cannot be simulated together; leave one of "
                    "them out."
                )


def with_obstacles(rig: RigParameters, texts: Iterable[str]) -> RigParameters:
    """Add obstacles to those of a rig's simulated beam.

    Parameters
    ----------
    rig
        Parameters of the rig, with a section ``simulation``.
    texts
        Obstacles and knocks, as for `parse_obstacle`.

    Raises
    ------
    ObstacleError
        If one has a syntax error, or cannot be simulated on this rig.
    """
    simulation = rig.simulation
    if simulation is None:
        raise ObstacleError(
            f"The profile {rig.name} has no section [simulation], so that its beam can meet no "
            "obstacle; copy it from that of rigd profiles show sim."
        )
    texts = tuple(texts)
    simulated = {name: getattr(simulation, name) for name in INCOMPATIBLE_WITH_OBSTACLES}
    check_obstacles(map(parse_obstacle, texts), rig.beam, simulated)
    return replace(rig, simulation=replace(simulation, obstacles=simulation.obstacles + texts))


def describe_obstacle(disturbance: Disturbance) -> str:
    """Write an obstacle or a knock so that `parse_obstacle` reads it back.

    Parameters
    ----------
    disturbance
        Obstacle or impact.
    """
    default = {each.name: each.default for each in fields(disturbance)}
    if isinstance(disturbance, Obstacle):
        default["side"] = _side_of(disturbance.angle_rad)
    return ",".join(
        f"{name}={value:g}" if float(f"{value:g}") == value else f"{name}={value!r}"
        for name, key in _KEYS[type(disturbance)].items()
        if (value := getattr(disturbance, key.field)) != default[key.field]
    )


def _side_of(angle_rad: float) -> int:
    """Side of an obstacle of which none is given: that from which a beam at zero comes."""
    return -1 if angle_rad < 0 else 1


def _finite(text: str) -> float:
    value = float(text)
    if not isfinite(value):
        raise ValueError(text)
    return value


def _complaint(text: str, what: str) -> ObstacleError:
    return ObstacleError(f"Obstacle '{text}': {what}.")
