"""Excitation that moves the motor to another angle without leaving the antenna vibrating."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Final, Protocol

from annotated_types import doc

from rigd.excitation._options import RestS, RingDownS, documented
from rigd.excitation._residual_vibration import predict_move_end
from rigd.excitation._shortest_move import MovePlant, shortest_move
from rigd.excitation._signals import (
    Excitation,
    ExcitationError,
    assemble_reference,
    lay_out_segments,
    require_finite,
    require_within_turn,
)
from rigd.identified_beam import MOVE_USE, BeamUse

_MAX_END_ANGLE_FRACTION: Final = 0.98
"""Largest fraction of the angle limit at which a move may end; the remainder is for overshoot."""
_MIN_DISTANCE_RAD: Final = 1e-3
"""Smallest distance of a move in rad."""


class MoveRig(Protocol):
    """Interface to a rig for which a move of the motor to another angle is planned."""

    @property
    def start_rad(self) -> float:
        """Present angle of the motor from the rig's zero, in rad."""

    def move_plant(self, path: str | Path, use: BeamUse) -> MovePlant:
        """Return the model of the rig for planning, with the beam of an analysis.

        `path` is a document of ``analyze --json``; if empty, the beam of the profile is used.
        """


@documented
def move(
    *,
    rate_hz: Annotated[float, doc("Ticks a second.")],
    angle_rad: Annotated[float | None, doc("Final angle from the rig's zero.")] = None,
    by_rad: Annotated[
        float | None,
        doc("Distance from the present angle, of either sign, instead of `angle_rad`."),
    ] = None,
    path: Annotated[
        str | Path,
        doc(
            "JSON written by ``analyze --json`` with the beam for which the move is planned; "
            "empty: the beam of the profile."
        ),
    ] = "",
    robust: Annotated[
        int,
        doc(
            "1: the move tolerates a 1 % frequency error and does not turn back, but takes "
            "longer. 0: the move is the shortest."
        ),
    ] = 0,
    rest_s: RestS = 1.0,
    ring_down_s: RingDownS = 5.0,
    rig: Annotated[MoveRig | None, doc("Rig that is moved.")] = None,
) -> Excitation:
    """Return the shortest move to another angle that leaves no vibration; the motor stays there.

    Raises
    ------
    ExcitationError
        If not exactly one angle is given, or the move would leave the limits.
    IdentifiedBeamError
        If the file is invalid, or has an effect that a move does not take into account.
    """
    if rig is None:
        raise ExcitationError("A move is planned for a rig; run it with its profile.")
    if (angle_rad is None) == (by_rad is None):
        raise ExcitationError("Give either angle_rad or by_rad (rad): where to, or by how much.")
    for option_name, value_rad in (("angle_rad", angle_rad), ("by_rad", by_rad)):
        if value_rad is not None:
            require_finite(option_name, value_rad, "rad")
    if robust not in (0, 1):
        raise ExcitationError(f"robust = {robust} is neither 0 nor 1; choose one.")
    start_rad = rig.start_rad
    target_rad = start_rad + by_rad if angle_rad is None else angle_rad  # type: ignore[operator]
    require_within_turn("angle_rad" if by_rad is None else "by_rad", target_rad - start_rad)
    rig_plant = rig.move_plant(path, MOVE_USE)
    farthest_allowed_rad = _MAX_END_ANGLE_FRACTION * rig_plant.max_angle_rad
    if not abs(target_rad) <= farthest_allowed_rad:
        raise ExcitationError(
            f"The move would end at {target_rad:.4g} rad, and limits.angle_rad = "
            f"{rig_plant.max_angle_rad:g} rad allows {farthest_allowed_rad:.4g} rad from the zero "
            "to either side; choose at most "
            f"that{'' if by_rad is None else _allowed_range(farthest_allowed_rad, start_rad)}."
        )
    distance_rad = target_rad - start_rad
    if abs(distance_rad) < _MIN_DISTANCE_RAD:
        raise ExcitationError(
            f"The motor is already at {start_rad:.4g} rad, and a move is of "
            f"{_MIN_DISTANCE_RAD:g} rad at least; choose another angle."
        )
    planned_move = shortest_move(rig_plant, distance_rad, start_rad=start_rad, robust=bool(robust))
    segment_ticks = lay_out_segments(rate_hz, rest_s, planned_move.duration_s, ring_down_s)
    move_end = predict_move_end(rig_plant, planned_move.reference_rad, ring_down_s)
    parameters: dict[str, float | int | str] = {
        "angle_rad": target_rad,
        "by_rad": distance_rad,
        "file": Path(path).name if path else "",
        "robust": robust,
        "duration_s": planned_move.duration_s,
        "rest_s": rest_s,
        "ring_down_s": ring_down_s,
        "limits_share": planned_move.limit_fraction,
        "residual_nm": move_end.residual_nm,
        "residual_floor_nm": move_end.noise_floor_nm,
        "frequency_residual_nm": planned_move.residual_nm,
        "quintic_residual_nm": planned_move.quintic_residual_nm,
    }
    if move_end.arrival_s is not None:
        parameters["arrival_s"] = move_end.arrival_s
    return Excitation(
        kind="move",
        parameters=parameters,
        rate_hz=rate_hz,
        reference_rad=assemble_reference(segment_ticks, planned_move.reference_rad),
        segments=segment_ticks,
        stays=True,
        model=rig_plant.model,
        motion=_move_text(parameters),
    )


def _allowed_range(farthest_allowed_rad: float, start_rad: float) -> str:
    """Return the end of a message that states the range of distances which a move may have."""
    lowest_rad, highest_rad = -farthest_allowed_rad - start_rad, farthest_allowed_rad - start_rad
    return f", that is by {lowest_rad:.4g} to {highest_rad:.4g} rad from {start_rad:.4g} rad"


def _move_text(parameters: Mapping[str, float | int | str]) -> str:
    """Return text with target angle, duration and predicted residual vibration of a move."""
    (
        move_rad,
        target_angle_rad,
        duration_s,
        residual_fraction,
        residual_nm,
        sensor_floor_nm,
        detuned_residual_nm,
        quintic_nm,
    ) = (
        float(parameters[parameter_name])
        for parameter_name in (
            *("by_rad", "angle_rad", "duration_s", "limits_share", "residual_nm"),
            *("residual_floor_nm", "frequency_residual_nm", "quintic_residual_nm"),
        )
    )
    arrival_text = "more than 1 s after that"
    if "arrival_s" in parameters:
        arrival_text = f"after {1e3 * float(parameters['arrival_s']):.0f} ms"
    residual_text = f"{1e3 * residual_nm:.2g} mN·m"
    if residual_nm < sensor_floor_nm:
        residual_text = f"below the noise of the sensor ({1e3 * sensor_floor_nm:.2g} mN·m)"
    if detuned_residual_nm > max(residual_nm, sensor_floor_nm):
        residual_text += (
            f", {1e3 * detuned_residual_nm:.2g} mN·m if the beam's frequencies are wrong by their "
            "uncertainty"
        )
    return (
        f"moves by {move_rad:.4g} rad to {target_angle_rad:.4g} rad in {1e3 * duration_s:.0f} ms, "
        f"the angle within 1 mrad {arrival_text} ({100 * residual_fraction:.0f} % of the limits); "
        f"vibration left {residual_text}; a quintic of the same time leaves {1e3 * quintic_nm:.3g} "
        f"mN·m (beam of {parameters['file'] or 'profile'})"
    )
