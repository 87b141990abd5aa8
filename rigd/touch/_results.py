"""Data classes of an estimated touch."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

RealArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class TouchQuantity:
    """Estimated quantity of a touch, with standard deviation and 95 % interval."""

    value: float
    """Estimated value."""
    std: float
    """Standard deviation of the estimated value."""
    interval_95: tuple[float, float]
    """Interval that contains the true value in 95 of 100 records."""

    def as_dict(self) -> dict[str, Any]:
        """Return value, standard deviation and 95 % interval as a dictionary of JSON types."""
        return {"value": self.value, "std": self.std, "interval_95": list(self.interval_95)}


@dataclass(frozen=True, slots=True)
class TouchEstimate:
    """Estimate of one touch: position, instant, force and stiffness, and the kind of obstacle.

    A quantity is None if the record does not determine it.
    """

    x_m: TouchQuantity | None
    """Distance of the touched point from the motor's axis."""
    time_s: TouchQuantity | None
    """Instant of the first contact, from the record's first sample."""
    force_n: TouchQuantity | None
    """Peak of the contact force's magnitude."""
    stiffness_n_per_m: TouchQuantity | None
    """Stiffness of the obstacle."""
    kind: str
    """Kind of obstacle: rigid (one at rest, also if springy), yielding, moving, knock (an impact)
    or unknown."""
    model: str
    """Origin of the beam's model: ``profile`` or the path of a document."""
    channels: int
    """Number of measured quantities: 1 for torque alone, 2 with base shear."""
    samples: int
    """Number of samples after the detection that were used."""
    chi2_per_degree: float
    """Sum of squared residuals, divided by its expectation for noise alone: about 1 if the touch is
    explained."""
    positions_m: RealArray
    """Positions of `log_likelihood` in m, shape (m,); empty if no likelihood was requested."""
    log_likelihood: RealArray
    """Logarithm of the likelihood of a touch at each position for an arbitrary force, shape
    (m,)."""
    innovations: RealArray
    """Innovations of torque and shear, divided by their standard deviations, shape (channels,
    n)."""
    innovation_times_s: RealArray
    """Instants of the innovations, from the record's first sample; shape (n,)."""
    force_history_n: RealArray
    """Magnitude of the contact force over time, shape (k,)."""
    force_times_s: RealArray
    """Instants of the contact force, from the record's first sample; shape (k,)."""

    @property
    def is_explained(self) -> bool:
        """Whether an obstacle or an impact explains the record up to noise."""
        return self.time_s is not None

    def as_dict(self, start_s: float = 0.0) -> dict[str, Any]:
        """Return the estimate of the touch as a dictionary of JSON types.

        Parameters
        ----------
        start_s
            Time of the record's first sample, which is added to the instant of touch.
        """
        touch_time = self.time_s
        if touch_time is not None:
            low_s, high_s = touch_time.interval_95
            touch_time = replace(
                touch_time,
                value=touch_time.value + start_s,
                interval_95=(low_s + start_s, high_s + start_s),
            )
        quantities = {
            "x_m": self.x_m,
            "time_s": touch_time,
            "force_n": self.force_n,
            "stiffness_n_per_m": self.stiffness_n_per_m,
        }
        return {
            quantity_name: estimated and estimated.as_dict()
            for quantity_name, estimated in quantities.items()
        } | {
            "kind": self.kind,
            "model": self.model,
        }
