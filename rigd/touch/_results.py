"""Results of the estimation of a touch."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class TouchQuantity:
    """Estimated number, with its standard deviation and its 95 % interval."""

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
    """Estimate of one touch: point, instant, force and stiffness, and the kind of obstacle.

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
    """Kind of obstacle: rigid (at rest, springy or not) | yielding | moving | knock | unknown."""
    model: str
    """Source of the beam's model."""
    channels: int
    """Number of measured quantities: 1 for torque alone, 2 with base shear."""
    samples: int
    """Number of samples after the detection that were used."""
    chi2_per_degree: float
    """Sum of squared residuals over its expectation from noise: about 1 if the touch is
    explained."""
    positions_m: Real
    """Positions at which the likelihood is given, shape (m,); empty if it was not requested."""
    log_likelihood: Real
    """Logarithm of the likelihood of a touch at each position by any force, shape (m,)."""
    innovations: Real
    """Innovations of torque and shear in standard deviations, shape (channels, n)."""
    innovation_times_s: Real
    """Instants of the innovations, from the record's first sample; shape (n,)."""
    force_history_n: Real
    """Magnitude of the contact force over time, shape (k,)."""
    force_times_s: Real
    """Instants of the contact force, from the record's first sample; shape (k,)."""

    @property
    def explained(self) -> bool:
        """Whether an obstacle or a knock explains the record except for noise."""
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
