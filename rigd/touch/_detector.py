"""Sequential test: whether the innovations have ceased to be noise.

For each of the last 1, 2, 4 and 8 ticks the sum of the whitened innovations is compared with what
noise makes of it. With p channels its square over the number of ticks is chi-squared of p degrees
of freedom, whose tail sets the threshold for a stated rate of false alarms: with two channels it is
``exp(-h/2)``, with one it is less. The model's error is allowed for by a share of the torque and
shear that it predicts.

References
----------
M. Basseville, I. Nikiforov, Detection of Abrupt Changes (1993), chapter 2 (tests of a window).
"""

from dataclasses import dataclass
from math import log

from rigd.touch._innovations import FreeBeam, InnovationFilter

_WINDOWS = (1, 2, 4, 8)
_LONGEST = _WINDOWS[-1]


@dataclass(frozen=True, slots=True)
class DetectorSettings:
    """How sure the detector has to be."""

    false_alarms_per_hour: float = 1e-3
    """Expected number in white noise."""
    model_tolerance: float = 0.02
    """Share of the predicted torque and shear that is taken to be the model's error."""

    def threshold(self, rate_hz: float) -> float:
        """Return the level that the square of a window's sum over its length must exceed.

        Parameters
        ----------
        rate_hz
            Ticks a second.

        Examples
        --------
        >>> from rigd.touch import DetectorSettings
        >>> round(DetectorSettings(false_alarms_per_hour=1e-3).threshold(1000.0), 1)
        46.8
        """
        tests_per_hour = 3600.0 * rate_hz * len(_WINDOWS)
        return 2.0 * log(tests_per_hour / self.false_alarms_per_hour)


class TouchDetector:
    """Watches a record for the first touch.

    Until `arm` is called it measures the innovations of the beam at rest: where they are greater
    than the model's noise, the threshold rises by as much.

    Parameters
    ----------
    model
        The free beam with its noise.
    rate_hz
        Ticks a second.
    settings
        How sure it has to be.

    Attributes
    ----------
    level
        Largest square of a window's sum over what is allowed, at the last tick; above 1: touched.
    excess
        Variance of the innovations at rest over that of the model, at least 1.
    """

    __slots__ = (
        "_armed",
        "_channels",
        "_filter",
        "_next",
        "_squares",
        "_sums",
        "_threshold",
        "_ticks",
        "_tolerance2",
        "excess",
        "level",
    )

    def __init__(self, model: FreeBeam, rate_hz: float, settings: DetectorSettings) -> None:
        self._filter = InnovationFilter(model)
        self._threshold = settings.threshold(rate_hz)
        self._tolerance2 = settings.model_tolerance**2
        self._channels = model.channels
        self._armed = False
        self._squares = 0.0
        self._ticks = 0
        # Running totals of the last ticks, in a ring: a window's sum is a difference of two.
        self._sums = [(0.0, 0.0)] * (_LONGEST + 1)
        self._next = 0
        self.excess = 1.0
        self.level = 0.0

    def arm(self) -> None:
        """Judge from the next tick on."""
        if self._ticks:
            self.excess = max(1.0, self._squares / self._ticks / self._channels)
        self._armed = True

    def step(
        self,
        angle_rad: float,
        torque_nm: float,
        shear_n: float,
        *,
        missed: int = 0,
        angle_stale: bool = False,
        wrench_stale: bool = False,
    ) -> bool:
        """Take the readings of a tick, see `InnovationFilter.step`; say whether it is a touch.

        Parameters
        ----------
        angle_rad, torque_nm, shear_n, missed, angle_stale, wrench_stale
            See `InnovationFilter.step`.
        """
        filter_ = self._filter
        filter_.step(
            angle_rad,
            torque_nm,
            shear_n,
            missed=missed,
            angle_stale=angle_stale,
            wrench_stale=wrench_stale,
        )
        torque, shear = filter_.whitened
        number, sums = self._next, self._sums
        before_torque, before_shear = sums[number]
        self._next = number = (number + 1) % (_LONGEST + 1)
        sums[number] = total_torque, total_shear = before_torque + torque, before_shear + shear
        if not self._armed:
            self._squares += torque * torque + shear * shear
            self._ticks += 1
            return False
        u, v = filter_.predicted
        error2 = self._tolerance2 * (u * u + v * v)
        level = 0.0
        for window in _WINDOWS:
            old_torque, old_shear = sums[number - window]
            a, b = total_torque - old_torque, total_shear - old_shear
            level = max(level, (a * a + b * b) / (window * self.excess + window * window * error2))
        self.level = level / self._threshold
        return self.level > 1.0
