"""Design of excitation while a session runs: the most informative segment comes next.

A segment of a few seconds drives one or several modes, each by a narrow linear sweep. The phase of
a sweep is chosen for the present vibration. All candidates have the largest amplitude that the rig
and the linear model allow. The chosen candidate reduces the standard deviations of the targets most
per second, by the Fisher information of the whole record (`rigd.excitation._fisher_information`).
Vibration after a segment counts as well, since it still gives information while other modes are
driven.

References
----------
G. C. Goodwin and R. L. Payne, Dynamic system identification: experiment design and data analysis,
Academic Press (1977).
X. Bombois, M. Gevers, R. Hildebrand and G. Solari, Optimal experiment design for open and
closed-loop system identification, Communications in Information and Systems 11 (2011) 197-224.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from rigd.beam import Plant
from rigd.beam.tip import SMALL_TIP_SLOPE_RAD
from rigd.excitation._beam_estimate import BeamEstimate
from rigd.excitation._fisher_information import RecordSoFar, covariance_of, information
from rigd.excitation._segment_search import (
    PLANNING_HORIZON_S,
    SHORTEST_SEGMENT_S,
    Segment,
    SegmentSearch,
)
from rigd.excitation._shortest_move import MovePlant
from rigd.excitation._signals import ExcitationError
from rigd.excitation._sine_mixture import least_standard_deviations
from rigd.excitation.targets import MODE_QUANTITIES, Precision, Quantities, Target

RealArray = NDArray[np.float64]


_GEOMETRY_DOMINANCE_RATIO: Final = 1.5
"""Ratio of the smallest standard deviation with the tolerance of the geometry to that without it,
above which the tolerance is the reason for missing a target."""


class DesignRig(Protocol):
    """Interface to a rig for which segments of excitation are designed."""

    @property
    def start_rad(self) -> float:
        """Present angle of the motor from the rig's zero, in rad."""

    def plant_with(self, plant: Plant) -> MovePlant:
        """Return the rig's closed loop and limits with an estimated beam, not the profile's.

        Parameters
        ----------
        plant
            Estimated beam, with its ends.
        """


@dataclass(frozen=True, slots=True, eq=False)
class Design:
    """Designed excitation of a session: its segments, reference angle and expected precision."""

    segments: tuple[Segment, ...]
    """Segments in the order of time."""
    reference_rad: RealArray
    """Reference angle of all segments at each tick, shape (n,)."""
    angle_rad: RealArray
    """Predicted angle of the motor at each tick, shape (n,)."""
    parameter_names: tuple[str, ...]
    """Names of the free parameters, in the order of the covariance."""
    covariance: RealArray
    """Covariance of the parameters that is expected at the end of the session, shape (k, k)."""
    expected_precisions: tuple[Precision, ...]
    """Precision of each target that is expected at the end of the session."""


def next_segment(
    estimate: BeamEstimate,
    angle_rad_so_far: RealArray,
    targets: Iterable[Target],
    rig: DesignRig,
    time_left_s: float,
    *,
    tip_slope_rad: float = SMALL_TIP_SLOPE_RAD,
    modes_to_drive: Collection[int] = (),
    limit_fraction: float = 1.0,
) -> Segment:
    """Return the segment of excitation that reduces the targets' standard deviations most.

    Parameters
    ----------
    estimate
        Present estimate of beam, damping and noise.
    angle_rad_so_far
        Angle of the motor from the start of the record to the start of the segment, at the rig's
        rate; shape (n,). It is measured, or predicted (`Segment.angle_rad`) for segments that are
        not run yet. The beam is at rest at the first tick.
    targets
        Targets of the session.
    rig
        Closed loop and limits.
    time_left_s
        Remaining time of the session in s; the segment is not longer.
    tip_slope_rad
        Largest slope of the tip for which the linear model is valid.
    modes_to_drive
        Numbers of modes of which the segment must drive one; empty: the segment drives the most
        informative modes.
    limit_fraction
        Largest fraction of the limits that the segment uses, to vary its amplitude.

    Raises
    ------
    ExcitationError
        If there is no target, or no segment fits into the time or drives a mode.
    """
    driven_modes = [
        beam_mode.mode for beam_mode in estimate.modes() if beam_mode.mode in modes_to_drive
    ]
    quantities = Quantities.from_targets(targets, estimate)
    if not quantities.quantity_precisions:
        raise ExcitationError("No precision is requested; give for example --damping 1%.")
    move_plant = rig.plant_with(estimate.plant)
    record_so_far = RecordSoFar.from_angle(
        angle_rad_so_far, estimate, move_plant.rate_hz, PLANNING_HORIZON_S
    )
    segment_search = SegmentSearch(
        estimate,
        quantities,
        move_plant,
        rig.start_rad,
        record_so_far,
        tip_slope_rad,
        time_left_s,
        limit_fraction,
    )
    return segment_search.segment(
        segment_search.best_candidate(time_left_s, driven_modes), time_left_s
    )


@dataclass(frozen=True, slots=True)
class GeometryFloor:
    """Smallest standard deviation that a parameter of a not quite uniform beam can have."""

    target: Target
    """Target of the quantity."""
    value: float
    """Value of the quantity."""
    std: float
    """Smallest standard deviation with the tolerance of the geometry."""
    exact_geometry_std: float
    """Smallest standard deviation if the beam were exactly uniform."""

    @property
    def makes_target_unreachable(self) -> bool:
        """Whether the beam's non-uniformity makes the target standard deviation unreachable."""
        target_std = self.target.std * (abs(self.value) if self.target.is_relative else 1.0)
        return (
            target_std < self.std and self.std > _GEOMETRY_DOMINANCE_RATIO * self.exact_geometry_std
        )


def geometry_floors(
    estimate: BeamEstimate,
    rig: DesignRig,
    targets: Iterable[Target],
    uniformity: float,
    duration_s: float,
    tip_slope_rad: float = SMALL_TIP_SLOPE_RAD,
) -> tuple[GeometryFloor, ...]:
    """Return the smallest possible standard deviations of a nearly uniform beam's parameters.

    Each is computed for the mixture of steady sines that is best for this parameter alone, at the
    largest amplitudes that the rig and the linear model allow. Quantities of modes have no such
    floor, because they are defined for a beam that is not uniform as well.

    Parameters
    ----------
    estimate
        Beam, damping and noise as they are known beforehand.
    rig
        Closed loop and limits.
    targets
        Targets of the session.
    uniformity
        Relative standard deviation of each mode's frequency from that of a uniform beam.
    duration_s
        Longest duration of the record in s.
    tip_slope_rad
        Largest slope of the tip for which the linear model is valid.

    Raises
    ------
    ExcitationError
        If no mode can be driven.
    """
    targets = [
        single_target for single_target in targets if single_target.quantity not in MODE_QUANTITIES
    ]
    if not targets or not uniformity:
        return ()
    move_plant = rig.plant_with(estimate.plant)
    resting_record = RecordSoFar.from_angle(
        np.zeros(1), estimate, move_plant.rate_hz, SHORTEST_SEGMENT_S
    )
    quantities = Quantities.from_targets(targets, estimate)
    segment_search = SegmentSearch(
        estimate, quantities, move_plant, rig.start_rad, resting_record, tip_slope_rad
    )
    tolerant_estimate = estimate.with_tolerance(uniformity)
    least_stds = [
        least_standard_deviations(
            np.zeros((len(beam_estimate.free_parameters), len(beam_estimate.free_parameters))),
            beam_estimate,
            Quantities.from_targets(targets, beam_estimate),
            segment_search.line_hz,
            segment_search.line_amplitudes_rad,
            duration_s,
        )
        for beam_estimate in (tolerant_estimate, estimate)
    ]
    return tuple(
        GeometryFloor(quantity_precision.target, quantity_precision.value, std, exact_geometry_std)
        for quantity_precision, std, exact_geometry_std in zip(
            quantities.quantity_precisions,
            least_stds[0].tolist(),
            least_stds[1].tolist(),
            strict=True,
        )
        if not quantity_precision.impossible_reason
    )


def expected_precisions(
    angle_rad: RealArray, estimate: BeamEstimate, targets: Iterable[Target], rate_hz: float
) -> tuple[Precision, ...]:
    """Return the standard deviation of each target quantity expected from a motor angle record.

    Parameters
    ----------
    angle_rad
        Motor angle at each tick, shape (n,). The beam is at rest at the first tick.
    estimate
        Beam, damping and noise.
    targets
        Targets of the session.
    rate_hz
        Rate of the angle.
    """
    covariance = covariance_of(information(angle_rad, estimate, rate_hz), estimate)
    return Quantities.from_targets(targets, estimate).precisions(covariance)


def design_excitation(
    estimate: BeamEstimate,
    rig: DesignRig,
    targets: Sequence[Target],
    duration_s: float,
    *,
    angle_rad_so_far: RealArray | None = None,
    tip_slope_rad: float = SMALL_TIP_SLOPE_RAD,
) -> Design:
    """Design segments of excitation until all target precisions are reached or time is over.

    Parameters
    ----------
    estimate
        Beam, damping and noise as they are known beforehand.
    rig
        Closed loop and limits: `rigd.runner.planning.RigPreview`.
    targets
        Targets of the session.
    duration_s
        Longest total duration of all segments in s.
    angle_rad_so_far
        Motor angle of the record before the segments, shape (n,); None: the beam is at rest before
        the first segment.
    tip_slope_rad
        Largest slope of the tip for which the linear model is valid.

    Raises
    ------
    ExcitationError
        If there is no target, or no segment fits into the time or drives a mode.

    Examples
    --------
    >>> import numpy as np
    >>> from rigd.beam import Beam, Damping, Plant
    >>> from rigd.excitation import BeamEstimate
    >>> from rigd.excitation.experiment_design import design_excitation
    >>> from rigd.excitation.targets import parse_target
    >>> from rigd.profile import load_profile
    >>> from rigd.runner.planning import RigPreview
    >>> beam = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.0903)
    >>> estimate = BeamEstimate(
    ...     plant=Plant(beam, Damping(zeta=7e-5, gamma=0.02)),
    ...     free_parameters=("zeta", "gamma", "density_over_stiffness", "bending_stiffness_n_m2"),
    ...     noise_frequency_hz=np.array([1.0]),
    ...     noise_nm2_per_hz=np.array([5e-8]),
    ... )
    >>> rig = RigPreview(load_profile("sim"))
    >>> design = design_excitation(estimate, rig, [parse_target("zeta", "2%")], 20.0)
    >>> all(each.reached for each in design.expected_precisions), design.reference_rad.size < 10_000
    (True, True)
    """
    move_plant = rig.plant_with(estimate.plant)
    earlier_angle_rad = np.zeros(1) if angle_rad_so_far is None else angle_rad_so_far
    reference_rad = angle_rad = np.zeros(0)
    remaining_s = duration_s
    planned_segments: list[Segment] = []
    while not planned_segments or (
        remaining_s >= SHORTEST_SEGMENT_S
        and not all(
            planned_segment.reached for planned_segment in planned_segments[-1].expected_precisions
        )
    ):
        total_angle_rad = np.concatenate([earlier_angle_rad, angle_rad])
        new_segment = next_segment(
            estimate, total_angle_rad, targets, rig, remaining_s, tip_slope_rad=tip_slope_rad
        )
        planned_segments.append(new_segment)
        reference_rad = np.concatenate([reference_rad, new_segment.reference_rad])
        # The loop's state after one segment is the initial state of the next.
        angle_rad = move_plant.respond(reference_rad).angle_rad
        remaining_s -= new_segment.reference_rad.size / move_plant.rate_hz
    return Design(
        segments=tuple(planned_segments),
        reference_rad=reference_rad,
        angle_rad=angle_rad,
        parameter_names=estimate.free_parameters,
        covariance=planned_segments[-1].covariance,
        expected_precisions=planned_segments[-1].expected_precisions,
    )
