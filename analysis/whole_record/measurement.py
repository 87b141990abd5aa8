"""What the estimator is given: two channels on a uniform grid, and which values to trust."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.record_checks import too_much_unknown
from analysis.whole_record.bridging import bridged, longest_run
from analysis.whole_record.plant import Plant
from rigd.beam import Damping

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.record import Record
    from rigd.beam import Beam

MAX_ANGLE_GAP_PERIODS: Final = 0.4
"""Longest gap of the angle that is bridged, in periods of the band's upper end."""

MAX_TORQUE_GAP_S: Final = 1.0
"""Longest gap of the torque: a longer one may swallow a resonance."""


class MeasurementError(ValueError):
    """A record that the whole-record estimator cannot use; the message says why and what to do."""


@dataclass(frozen=True, slots=True)
class Measurement:
    """Angle and torque of one session, with what the file states of rig and specimen.

    Attributes
    ----------
    name : str
        What messages call it: the file's path.
    angle_rad, torque_nm : ndarray, shape (n,)
        Motor angle and coupling torque, one value a tick.
    rate_hz : float
        Ticks per second.
    beam : Beam
        As the file states it: where the search for density and stiffness starts.
    angle_known, torque_known : ndarray of bool, shape (n,)
        False where a tick was missed or its value is flagged (held, saturated). Such a torque is
        not compared; such an angle is bridged, since the convolution needs one.
    rest_angle_rad : float or None
        Angle at which the beam rested before the record, None if not known: then the first angle.
    delay_s : float
        By how much the torque is older than the angle at one time stamp, as the file states it.
    tool_inertia_kg_m2 : float
        Inertia between torque sensor and beam, as the file states it.
    filter_time_constant_s, second_order_filter_time_constant_s : float
        Low-pass filter of the torque's channel, as the file states it: see `Plant`.
    reference_rad : ndarray, shape (n,), or None
        Angle that a controller was asked for, if one held the motor: what of the angle does not
        follow it is taken to be the noise's doing.
    """

    name: str
    angle_rad: NDArray[np.float64]
    torque_nm: NDArray[np.float64]
    rate_hz: float
    beam: Beam
    angle_known: NDArray[np.bool_]
    torque_known: NDArray[np.bool_]
    rest_angle_rad: float | None = None
    delay_s: float = 0.0
    tool_inertia_kg_m2: float = 0.0
    reference_rad: NDArray[np.float64] | None = None
    filter_time_constant_s: float = 0.0
    second_order_filter_time_constant_s: float = 0.0

    @classmethod
    def of_record(cls, record: Record) -> Measurement:
        """Take over a record that was read from a session file.

        Raises
        ------
        MeasurementError
            The motor was held.
        """
        if record.metadata.get("excitation") == "hold":
            raise MeasurementError(
                f"{record.path}: the motor was held, and moved with no more than the noise of its "
                "sensors; record an excitation, such as rigd run chirp."
            )
        return cls(
            name=str(record.path),
            angle_rad=record.angle_rad,
            torque_nm=record.torque_nm,
            rate_hz=record.rate_hz,
            beam=record.beam,
            angle_known=record.angle_known,
            torque_known=record.torque_known,
            rest_angle_rad=record.rest_angle_rad,
            delay_s=record.torque_delay_s - record.angle_delay_s,
            tool_inertia_kg_m2=record.tool_inertia_kg_m2,
            reference_rad=record.reference_rad,
            filter_time_constant_s=record.torque_filter_s[0],
            second_order_filter_time_constant_s=record.torque_filter_s[1],
        )

    def check(self, highest_hz: float) -> None:
        """Refuse what cannot be used in a band that ends at `highest_hz`.

        Raises
        ------
        MeasurementError
            Shapes differ, values are not finite, too much is unknown or in one piece, or the angle
            never moves.
        """
        n = len(self.angle_rad)
        for other in (self.torque_nm, self.angle_known, self.torque_known):
            if len(other) != n:
                raise MeasurementError(
                    f"{self.name}: angle, torque and their masks hold {n} and {len(other)} values, "
                    "but must be of one length."
                )
        for channel, unit, values, known in (
            ("angle", "rad", self.angle_rad, self.angle_known),
            ("torque", "N·m", self.torque_nm, self.torque_known),
        ):
            bad = np.flatnonzero(known & ~np.isfinite(values))
            if bad.size:
                raise MeasurementError(
                    f"{self.name}: the {channel} is {values[bad[0]]} {unit} at tick {bad[0]} and "
                    f"not finite at {bad.size} of {n} ticks; mask them as unknown or record the "
                    "session again."
                )
            much = too_much_unknown(f"the {channel}", int(np.count_nonzero(~known)), n)
            if much:
                raise MeasurementError(f"{self.name}: {much}")
        bridged_s = MAX_ANGLE_GAP_PERIODS / highest_hz
        for channel, known, allowed_s in (
            ("angle", self.angle_known, bridged_s),
            ("torque", self.torque_known, MAX_TORQUE_GAP_S),
        ):
            run, start = longest_run(~known)
            if run > allowed_s * self.rate_hz:
                raise MeasurementError(
                    f"{self.name}: the {channel} is missing or flagged for {run} ticks from tick "
                    f"{start} on ({1e3 * run / self.rate_hz:.3g} ms), longer than the "
                    f"{1e3 * allowed_s:.3g} ms that a band up to {highest_hz:g} Hz tolerates; "
                    "record the session again."
                )
        angles = self.angle_rad[self.angle_known]
        if angles.size == 0 or np.ptp(angles) == 0:
            raise MeasurementError(
                f"{self.name}: the angle never changes, so nothing was excited; check the encoder "
                "and that the motor moved."
            )

    @property
    def nominal(self) -> Plant:
        """Rig and specimen as the file states them, without damping."""
        return Plant(
            beam=self.beam,
            damping=Damping(),
            delay_s=self.delay_s,
            tool_inertia_kg_m2=self.tool_inertia_kg_m2,
            filter_time_constant_s=self.filter_time_constant_s,
            second_order_filter_time_constant_s=self.second_order_filter_time_constant_s,
        )

    @property
    def torque_share(self) -> float:
        """Share of the torque that is known."""
        return float(np.mean(self.torque_known))

    def angle_from_rest(self, highest_hz: float) -> NDArray[np.float64]:
        """Angle relative to where the beam rested, shape (n,), unknown values bridged."""
        angle = bridged(self.angle_rad, self.angle_known, highest_hz / self.rate_hz)
        origin = angle[0] if self.rest_angle_rad is None else self.rest_angle_rad
        return angle - origin
