"""Design of excitation while a session runs: the piece that tells most of what is asked.

A piece of a few seconds drives one mode or several at once, each by a narrow linear sweep with a
phase that suits what still rings. Of all pieces tried, at the largest amplitude that the rig and
the linear model allow, that one is taken which lowers the deviations asked for most per second, by
the Fisher information of the whole record with it (`rigd.excitation._fisher_information`). The
ringing that a piece leaves counts for it, since it goes on weighted while other modes are driven.

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

from rigd.beam import LoadedBeam
from rigd.beam.tip import SMALL_SLOPE_RAD
from rigd.excitation._beam_estimate import BeamEstimate
from rigd.excitation._fisher_information import RecordSoFar, covariance_of, information
from rigd.excitation._piece_search import (
    HORIZON_S,
    SHORTEST_S,
    Piece,
    PieceSearch,
    least_deviations,
)
from rigd.excitation._shortest_move import MovePlant
from rigd.excitation._signals import ExcitationError
from rigd.excitation.targets import OF_MODES, Precision, Quantities, Target

Real = NDArray[np.float64]


_BY_GEOMETRY: Final = 1.5
"""Factor by which the tolerance of the geometry widens a deviation, from which it is the cause."""


class DesignRig(Protocol):
    """Rig that pieces are designed for."""

    @property
    def start_rad(self) -> float:
        """Where the motor stands, from the rig's zero."""

    def plant_with(self, beam: LoadedBeam) -> MovePlant:
        """Return closed loop and limits with a beam in place of the profile's.

        Parameters
        ----------
        beam
            The beam as estimated, with what is at its ends.
        """


@dataclass(frozen=True, slots=True, eq=False)
class Design:
    """A session of designed pieces, one after the other."""

    segments: tuple[Piece, ...]
    """In the order in which they are played."""
    reference_rad: Real
    """Shape (n,): all of them."""
    angle_rad: Real
    """Shape (n,): the angle predicted."""
    names: tuple[str, ...]
    """Free parameters, in the order of the covariance."""
    covariance: Real
    """Shape (k, k): expected at the end."""
    expected: tuple[Precision, ...]
    """Everything asked, as precise as it is expected to be at the end."""


def next_piece(
    estimate: BeamEstimate,
    angle_rad_so_far: Real,
    targets: Iterable[Target],
    rig: DesignRig,
    time_left_s: float,
    *,
    tip_slope_rad: float = SMALL_SLOPE_RAD,
    through: Collection[int] = (),
) -> Piece:
    """Design the piece that lowers the deviations asked for most per second.

    Parameters
    ----------
    estimate
        Beam, damping and noise as they are known.
    angle_rad_so_far
        Shape (n,): angle from the beginning of the record to that of the piece, at the rig's rate:
        as measured, and as predicted (`Piece.angle_rad`) where a piece is still to be played. The
        beam rested at the first.
    targets
        What is asked.
    rig
        Closed loop and limits.
    time_left_s
        Time in which the session has to end; a piece takes no more.
    tip_slope_rad
        Slope of the tip up to which the linear model is trusted.
    through
        Modes one of which has to be driven; empty: whatever tells most.

    Raises
    ------
    ExcitationError
        If nothing is asked, or no piece fits into the time or drives a mode.
    """
    driven = [mode.number for mode in estimate.modes() if mode.number in through]
    quantities = Quantities.of(targets, estimate)
    if not quantities.items:
        raise ExcitationError("No precision is asked for; give for example --damping 1%.")
    plant = rig.plant_with(estimate.loaded_beam)
    record = RecordSoFar.of(angle_rad_so_far, estimate, plant.rate_hz, HORIZON_S)
    decision = PieceSearch(
        estimate, quantities, plant, rig.start_rad, record, tip_slope_rad, time_left_s
    )
    return decision.segment(decision.best(time_left_s, driven), time_left_s)


@dataclass(frozen=True, slots=True)
class GeometryFloor:
    """Least standard deviation of a quantity that the tolerance of the geometry leaves."""

    target: Target
    """What is asked."""
    value: float
    """Value of the quantity."""
    std: float
    """With the tolerance."""
    exact_std: float
    """If the beam were exactly uniform."""

    @property
    def below(self) -> bool:
        """Whether less than the floor is asked for, and the geometry is why it is out of reach."""
        target_std = self.target.std * (abs(self.value) if self.target.relative else 1.0)
        return target_std < self.std and self.std > _BY_GEOMETRY * self.exact_std


def geometry_floors(
    estimate: BeamEstimate,
    rig: DesignRig,
    targets: Iterable[Target],
    uniformity: float,
    duration_s: float,
    tip_slope_rad: float = SMALL_SLOPE_RAD,
) -> tuple[GeometryFloor, ...]:
    """Compute how precisely the parameters asked for can be known of a nearly uniform beam.

    Each is that of the best mixture of steady sines for it alone, at the largest amplitudes that
    the rig and the linear model allow. Modes have no floor: they are those of the antenna, uniform
    or not.

    Parameters
    ----------
    estimate
        Beam, damping and noise as they are known beforehand.
    rig
        Closed loop and limits.
    targets
        What is asked.
    uniformity
        Relative standard deviation of each mode's frequency from that of a uniform beam.
    duration_s
        Longest record.
    tip_slope_rad
        Slope of the tip up to which the linear model is trusted.

    Raises
    ------
    ExcitationError
        If no mode can be driven.
    """
    targets = [target for target in targets if target.quantity not in OF_MODES]
    if not targets or not uniformity:
        return ()
    plant = rig.plant_with(estimate.loaded_beam)
    rest = RecordSoFar.of(np.zeros(1), estimate, plant.rate_hz, SHORTEST_S)
    quantities = Quantities.of(targets, estimate)
    decision = PieceSearch(estimate, quantities, plant, rig.start_rad, rest, tip_slope_rad)
    tolerant = estimate.with_tolerance(uniformity)
    floors = [
        least_deviations(
            np.zeros((len(each.names), len(each.names))),
            each,
            Quantities.of(targets, each),
            *decision.lines(),
            duration_s,
        )
        for each in (tolerant, estimate)
    ]
    return tuple(
        GeometryFloor(item.target, item.value, std, exact_std)
        for item, std, exact_std in zip(
            quantities.items, floors[0].tolist(), floors[1].tolist(), strict=True
        )
        if not item.impossible
    )


def expected_precisions(
    angle_rad: Real, estimate: BeamEstimate, targets: Iterable[Target], rate_hz: float
) -> tuple[Precision, ...]:
    """Compute how precisely a record is expected to determine what is asked.

    Parameters
    ----------
    angle_rad
        Shape (n,): motor angle; the beam rested at the first.
    estimate
        Beam, damping and noise.
    targets
        What is asked.
    rate_hz
        Rate of the angle.
    """
    covariance = covariance_of(information(angle_rad, estimate, rate_hz), estimate)
    return Quantities.of(targets, estimate).precisions(covariance)


def design_excitation(
    estimate: BeamEstimate,
    rig: DesignRig,
    targets: Sequence[Target],
    duration_s: float,
    *,
    angle_rad_so_far: Real | None = None,
    tip_slope_rad: float = SMALL_SLOPE_RAD,
) -> Design:
    """Design a session: pieces until everything asked is reached, or the time is over.

    Parameters
    ----------
    estimate
        Beam, damping and noise as they are known beforehand.
    rig
        Closed loop and limits: `rigd.runner.planning.LoopPreview`.
    targets
        What is asked.
    duration_s
        Time of all pieces together.
    angle_rad_so_far
        Shape (n,): angle of the record that the pieces continue; None: they begin with the beam
        at rest.
    tip_slope_rad
        Slope of the tip up to which the linear model is trusted.

    Raises
    ------
    ExcitationError
        If nothing is asked, or no piece fits into the time or drives a mode.

    Examples
    --------
    >>> import numpy as np
    >>> from rigd.beam import Beam, Damping
    >>> from rigd.excitation import BeamEstimate
    >>> from rigd.excitation.experiment_design import design_excitation
    >>> from rigd.excitation.targets import parse_target
    >>> from rigd.profile import load_profile
    >>> from rigd.runner.planning import LoopPreview
    >>> estimate = BeamEstimate(
    ...     beam=Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.0903),
    ...     damping=Damping(zeta=7e-5, gamma=0.02),
    ...     names=("zeta", "gamma", "density_over_stiffness", "bending_stiffness_n_m2"),
    ...     noise_frequency_hz=np.array([1.0]),
    ...     noise_nm2_per_hz=np.array([5e-8]),
    ... )
    >>> rig = LoopPreview(load_profile("sim"))
    >>> design = design_excitation(estimate, rig, [parse_target("zeta", "2%")], 20.0)
    >>> all(each.reached for each in design.expected), design.reference_rad.size < 10_000
    (True, True)
    """
    plant = rig.plant_with(estimate.loaded_beam)
    before_rad = np.zeros(1) if angle_rad_so_far is None else angle_rad_so_far
    reference_rad = angle_rad = np.zeros(0)
    left_s = duration_s
    segments: list[Piece] = []
    while not segments or (
        left_s >= SHORTEST_S and not all(each.reached for each in segments[-1].expected)
    ):
        so_far_rad = np.concatenate([before_rad, angle_rad])
        segment = next_piece(
            estimate, so_far_rad, targets, rig, left_s, tip_slope_rad=tip_slope_rad
        )
        segments.append(segment)
        reference_rad = np.concatenate([reference_rad, segment.reference_rad])
        # What one leaves in the loop is part of the next.
        angle_rad = plant.respond(reference_rad).angle_rad
        left_s -= segment.reference_rad.size / plant.rate_hz
    return Design(
        segments=tuple(segments),
        reference_rad=reference_rad,
        angle_rad=angle_rad,
        names=estimate.names,
        covariance=segments[-1].covariance,
        expected=segments[-1].expected,
    )
