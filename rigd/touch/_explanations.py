"""Explanations of the record of one touch: candidates of each kind, and their residuals.

A springy obstacle at rest, integrated in time through its bounces, explains the innovations of
torque and base shear. Alternatives are two obstacles, an obstacle that moves or yields, a knock
(one pulse of force), and any force at all. `_answer` decides which of them are reported.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rigd.touch._blind import BlindScan
from rigd.touch._free_motion import TouchRecord
from rigd.touch._kernels import ContactKernels
from rigd.touch._knock import Knocking
from rigd.touch._pair import Pairing
from rigd.touch._physical import (
    SOFTEST,
    STIFFEST,
    Descended,
    Prediction,
    Space,
    Touching,
    WhitenedWindow,
    chi2_of,
    descend,
)
from rigd.touch._posterior import Posterior, sampled
from rigd.touch._tables import GRID_S, Tables
from rigd.touch._uncertain import deviations
from rigd.touch.samples import FINAL_S, FIRST_S, HISTORY_S

Real = NDArray[np.float64]

_STAGES_S = (FIRST_S, 0.1, FINAL_S)
"""Times in s after the detection up to which the record is explained, in this order. The longest is
used only if an obstacle at rest explains the shorter parts and the point is still uncertain."""
_COVERED_S = 0.1
"""Time in s after the detection up to which the effects of all uncertainties are included at
once."""
_WORTH = 1.2
"""Smallest factor by which the number of samples must grow for a further stage."""
_WELL_KNOWN_M = 2e-3
"""Standard deviation of the position in m below which a longer part of the record is not used."""
_CLOUD = 96
"""Number of candidates for a longer part of the record, drawn from the posterior of a shorter
part."""
NEAR_TIP = 0.8
"""Fraction of the beam's length beyond which contacts are shorter, so that time steps are finer."""
_NEARBY_M = np.array([-4e-3, -2e-3, 2e-3, 4e-3])
"""Distances in m of additional candidates from the best ones near the tip."""
_AT_TIP = 0.95
"""Fraction of the beam's length beyond which a longer record adds nothing, because its many short
contacts fit anywhere."""

_LEAST_SCALE = 1.2
"""Smallest assumed variance of the whitened residuals, since the noise itself is estimated from few
samples."""
_DOUBT_OF_TWO = 4.0
"""Divisor of the sum of squared residuals if two obstacles clearly explain more than one: errors of
the model then decide which of several minima is the lowest."""
CLEAR = 16.0
"""Difference in the sum of squared residuals that decides between two kinds of obstacle."""
DOUBTFUL = 9.0
"""Reduction of the sum of squared residuals by a moving or yielding obstacle up to which an
obstacle at rest is still possible. In one of a hundred touches of an obstacle at rest the reduction
is that large by chance."""
_POSSIBLE = 5.0
"""Reduction of the sum of squared residuals by two obstacles from which they are possible, so that
the position is less certain."""
_HOPEFUL = 0.8
"""Reduction of the sum of squared residuals after a few iterations, from which the search for two
obstacles continues."""
_WORSE = 3.5
"""Number of standard deviations by which the sum of squared residuals may exceed its
expectation."""
POOR = 2.0
"""Number of standard deviations of the sum of squared residuals beyond which the explanation may be
wrong: other kinds are tried, and the interval of the point is that for any force."""
_WORSE_LATER = 2.5
"""Number of standard deviations by which the sum of squared residuals of the later samples alone
may exceed its expectation. Bounces amplify small errors of the model. If the later bounces are
explained less well, the first result is closer to the truth."""

_RATES_M_PER_S = np.array([-1.5, -0.7, -0.3, -0.1, 0.1, 0.25, 0.5])
"""Speeds of moving obstacles with which the search starts."""
_MOBILITIES = np.array([0.01, 0.04, 0.15, 0.6])
"""Mobilities of yielding obstacles, in m/s per N, with which the search starts."""
_STIFFNESSES = np.array([300.0, 3000.0, 30000.0])
"""Stiffnesses in N/m of moving or yielding obstacles with which the search starts."""


@dataclass(frozen=True, slots=True)
class Explanation:
    """Best explanation of a touch's record by obstacles of one kind."""

    kind: str
    """Kind of obstacle: rigid, moving, yielding, two or knock."""
    posterior: Posterior
    """Posterior distribution of the obstacle's parameters."""
    parameters: Real
    """Likeliest parameters, shape (p,)."""
    chi2: float
    """Sum of squared residuals of the likeliest parameters."""


@dataclass(frozen=True, slots=True)
class Explained:
    """Possible explanations of a touch's record, and the part of the record that they explain."""

    explanations: list[Explanation]
    """Explanations by kind; that by an obstacle at rest comes first."""
    window: WhitenedWindow
    """Part of the record that is explained."""
    later_doubtful: bool
    """Whether the later samples, which are left out, contradict an obstacle at rest."""
    untried: bool
    """Whether another kind of obstacle may be likelier, but was not tried."""


class Explainer:
    """Search for the obstacles that explain the record of one touch.

    Parameters
    ----------
    tables
        Precomputed tables of the model at the record's rate.
    record
        Samples from 0.3 s or more before the touch.
    noticed_s
        Longest time in s from the touch to its detection.
    earlier
        Search with the beginning of the same record, from whose results this search starts; None:
        it starts from a grid.
    """

    def __init__(
        self,
        tables: Tables,
        record: TouchRecord,
        noticed_s: float,
        earlier: "Explainer | None" = None,
    ) -> None:
        rate = tables.rate_hz
        self.tables, self.rate, self.given = tables, rate, record
        self.begin = max(0, record.detected - round(HISTORY_S * rate))
        end = min(record.angle_rad.size, record.detected + round(FINAL_S * rate))
        self.record = TouchRecord(
            rate,
            record.angle_rad[self.begin : end],
            record.torque_nm[self.begin : end],
            None if record.shear_n is None else record.shear_n[self.begin : end],
            record.detected - self.begin,
        )
        self.detected = self.record.detected
        self.quiet = self.detected - round(noticed_s * rate)
        self.motion = tables.free.motion(self.record, self.quiet, self.quiet - 4)
        self.available = self.record.angle_rad.size - self.detected
        self.edges = (float(tables.x_m[0]) + 0.002, float(tables.x_m[-1]))
        self.deviations: Real | None = None
        self._covered_s = 0.0
        whole_grid = earlier is not None and earlier.available >= round(GRID_S * rate)
        self._gridded: Real = earlier._gridded if earlier and whole_grid else self._best_of_grid()
        self._at_rest: tuple[Explanation, float] | None
        self._at_rest = None if earlier is None else earlier._at_rest

    @property
    def first(self) -> int:
        """Index of the first sample of the record that may contain the touch."""
        return self.begin + self.quiet

    @property
    def begins_too_late(self) -> bool:
        """Whether the likeliest touch begins before the samples that may contain it."""
        return bool(self.starts[0, 1] < self.motion.t[self.quiet] + 2.5 / self.rate)

    @property
    def seems_to_begin(self) -> int:
        """Index of the sample before which the likeliest touch of the grid search begins."""
        after_s = float(self.starts[0, 1] - self.motion.t[self.quiet])
        return self.first + round(after_s * self.rate)

    @property
    def misfit(self) -> float:
        """Mean square of the residuals of an obstacle at rest in the first samples, over noise."""
        return float(self._descended.chi2.min() / self._first_samples.data.size)

    def explain(self, *, first: bool) -> Explained:
        """Return the explanations of the record by one or two obstacles at rest and other kinds.

        With `first` set, other kinds than obstacles at rest are not tried, because that takes long.
        """
        rest, window, two, later_doubtful = self._over_stages()
        explanations = [rest]
        untried = False
        if two is None:
            other = not self.fits(rest, window, POOR) or self._changes(rest, window)
            if other and first:
                untried = True
            elif other:
                explanations += self._others(window)
            if self.fits(rest, window):
                two = self._two(rest, window)
        if two is not None:
            explanations.append(two)
        return Explained(explanations, window, later_doubtful=later_doubtful, untried=untried)

    def _over_stages(self) -> tuple[Explanation, WhitenedWindow, Explanation | None, bool]:
        """Explain longer and longer parts of the record by an obstacle at rest.

        Return four results: the explanation of the longest part that an obstacle at rest explains,
        or of the first part that it does not explain; this part; the explanation by two obstacles,
        or None unless they explain a part that a single obstacle does not; and whether the
        following samples contradict the first explanation.
        """
        available_s = self.available / self.rate
        stages = [seconds for seconds in _STAGES_S if _WORTH * seconds <= available_s]
        stages.append(available_s)
        before: tuple[Explanation, WhitenedWindow] | None = None
        if self._at_rest is None:
            starts = self._with_neighbours(_distinct(self._descended))
        else:
            rest, explained_s = self._at_rest
            stages = [seconds for seconds in stages if seconds > explained_s]
            starts = self._further(rest)
            self._take_along(starts, max([explained_s, *stages[:1]]))
            window = self.window(explained_s)
            [chi2] = chi2_of(self.predicting(starts[:1]), window, starts[:1])
            before = replace(rest, chi2=float(chi2)), window
            if self._enough(*before, explained_s):
                stages = []
        for seconds in stages:
            self._take_along(starts, seconds)
            window = self.window(seconds)
            rest = self.explained("rigid", self.predicting(starts), window, starts, self.space(3))
            if before is not None and self._later_is_worse(rest, window, *before):
                two = self._two(rest, window)
                if two is not None and self.fits(two, window, POOR):
                    return rest, window, two, False
                # In still later bounces the search may miss the minimum: they decide no kind.
                doubtful = seconds <= _COVERED_S and self._changes(rest, window)
                return *before, None, doubtful
            before = rest, window
            self._at_rest = rest, seconds
            if self._enough(rest, window, seconds):
                break
            starts = self._further(rest)
        assert before is not None  # there is at least one stage, or an earlier one
        return *before, None, False

    def _enough(self, rest: Explanation, window: WhitenedWindow, seconds: float) -> bool:
        """Return whether a longer part of the record would not improve the estimate."""
        x_m = rest.posterior.mean(0)
        known = rest.posterior.std(0) < _WELL_KNOWN_M or x_m > _AT_TIP * self.edges[1]
        return seconds > FIRST_S and bool(known or not self.fits(rest, window))

    def _take_along(self, likeliest: Real, seconds: float) -> None:
        """Compute the effects of all uncertainties up to `seconds` after the detection.

        They are computed for the first candidate of `likeliest`, unless this was done before.
        """
        if self._covered_s < seconds:
            self._covered_s = min(max(seconds, _COVERED_S), self.available / self.rate)
            whole = WhitenedWindow.of(self.motion, self.quiet, self.end(self._covered_s))
            self.deviations = deviations(self.tables, self.record, likeliest[:1], whole)

    def _further(self, rest: Explanation) -> Real:
        """Return candidates for a longer part of the record, from the result for a shorter part."""
        return np.vstack([rest.parameters, self._cloud(rest.posterior)])

    @cached_property
    def blind(self) -> BlindScan:
        """Likelihood of a touch by any force at each position, from the first samples.

        Its computation takes as long as the remaining estimate.
        """
        return self.tables.blind.scan(self.window(FIRST_S))

    # Data for the comparison of candidates

    def window(self, seconds: float) -> WhitenedWindow:
        """Return the whitened innovations from before the touch to a time after the detection."""
        return WhitenedWindow.of(self.motion, self.quiet, self.end(seconds), self.deviations)

    def end(self, seconds: float) -> int:
        """Return the index of the sample at a time after the detection, or the record's end."""
        return self.detected + min(self.available, round(seconds * self.rate))

    def space(self, width: int) -> Space:
        """Return the ranges of the first `width` parameters of `PARAMETERS`."""
        t = self.motion.t
        return Space(
            low=np.array([self.edges[0], t[self.quiet + 1], SOFTEST, -3.0, 0.0])[:width],
            high=np.array([self.edges[1], t[self.detected], STIFFEST, 3.0, 50.0])[:width],
            difference=np.array([2e-4, 2e-5, 2e-2, 2e-3, 2e-3])[:width],
            scale=np.array([3e-3, 1e-3, 1.0, 0.1, 0.1])[:width],
            smallest=np.array([1.5e-4, 1e-5, 2e-2, 5e-3, 5e-3])[:width],
            loose=np.array([0.02, 2e-3, 1.0, 0.3, 0.3])[:width],
        )

    def predicting(self, rows: Real, *, first: bool = False) -> Prediction:
        """Return the function that predicts the effect of obstacles near the candidates `rows`.

        Its time steps are half as long near the tip, where contacts are shorter. With `first` set,
        they are twice as long elsewhere, for a first search.
        """
        tables = self.tables
        tip = bool(np.median(rows[:, 0]) > NEAR_TIP * tables.model.beam.length_m)
        kernels = tables.finest if tip else tables.coarse if first else tables.middle
        touching = Touching(kernels, tables.x_m, self.motion)
        return lambda candidates, window: touching.predicted(candidates, window)[0]

    # Springy obstacle at rest

    def _best_of_grid(self) -> Real:
        """Return the four likeliest candidates of the grid for each position."""
        window = self.window(GRID_S)
        grid = self.tables.starts(window.end - window.first)
        starts, chi2 = grid.marched(self.motion, window, self.detected)
        starts = starts[np.lexsort((chi2, starts[:, 0]))]
        count = starts.shape[0] // np.unique(starts[:, 0]).size
        best: Real = starts.reshape(-1, count, 3)[:, :4].reshape(-1, 3)
        return best

    @cached_property
    def _first_samples(self) -> WhitenedWindow:
        """Whitened innovations with which the grid's candidates are compared.

        The effects of uncertainties through the contact are not included yet.
        """
        return WhitenedWindow.of(self.motion, self.quiet, self.end(FIRST_S))

    @cached_property
    def starts(self) -> Real:
        """The 12 likeliest candidates of the grid, compared over more samples."""
        coarse = Touching(self.tables.coarse, self.tables.x_m, self.motion)
        again = chi2_of(
            lambda rows, window: coarse.predicted(rows, window)[0],
            self._first_samples,
            self._gridded,
        )
        return self._gridded[np.argsort(again)[:12]]

    @cached_property
    def _descended(self) -> Descended:
        """Minima that least squares found from the likeliest candidates, in longer time steps."""
        predict = self.predicting(self.starts, first=True)
        return descend(predict, self._first_samples, self.starts, self.space(3), rounds=7)

    def _with_neighbours(self, starts: Real) -> Real:
        """Return candidates, with further ones nearby if they are close to the beam's tip.

        Minima are close together there.
        """
        if np.median(starts[:, 0]) <= NEAR_TIP * self.tables.model.beam.length_m:
            return starts
        nearby = np.repeat(starts[None, :2], _NEARBY_M.size, axis=0)
        nearby[:, :, 0] = np.clip(nearby[:, :, 0] + _NEARBY_M[:, None], *self.edges)
        return np.vstack([starts, nearby.reshape(-1, starts.shape[1])])

    def _cloud(self, posterior: Posterior) -> Real:
        """Return random candidates for a longer window, from the posterior of a shorter window."""
        rng = np.random.default_rng(1)
        chosen = posterior.samples[rng.choice(posterior.weights.size, _CLOUD, p=posterior.weights)]
        width = chosen.shape[1]
        space = self.space(width)
        spread = np.array([max(posterior.std(i), space.smallest[i]) for i in range(width)])
        return np.clip(
            chosen + 0.5 * spread * rng.standard_normal(chosen.shape), space.low, space.high
        )

    def explained(
        self, kind: str, predict: Prediction, window: WhitenedWindow, starts: Real, space: Space
    ) -> Explanation:
        """Return the explanation by one kind of obstacle: search for minima, and sample around."""
        if starts.shape[0] > 12:
            starts = starts[np.argsort(chi2_of(predict, window, starts))[:12]]
        found = descend(predict, window, starts, space, rounds=9)
        return self._sampled(kind, predict, window, found, space)

    def _sampled(
        self,
        kind: str,
        predict: Prediction,
        window: WhitenedWindow,
        found: Descended,
        space: Space,
        doubt: float = 1.0,
    ) -> Explanation:
        """Return an explanation with samples of the posterior around the minima in `found`.

        `doubt` is a factor on the variance of the residuals.
        """
        width = found.parameters.shape[1]
        near = np.flatnonzero(found.chi2 < found.chi2.min() + 30)
        covariances = np.array(
            [
                np.linalg.inv(found.jacobian[k].T @ found.jacobian[k] + np.diag(1 / space.loose**2))
                + np.diag(space.smallest**2)
                for k in near
            ]
        )
        degrees = max(window.data.size - width, 1)
        posterior = sampled(
            lambda rows: chi2_of(predict, window, rows),
            found.parameters[near],
            covariances,
            (space.low, space.high),
            scale=doubt * max(_LEAST_SCALE, found.chi2.min() / degrees),
            count=120,
            rounds=5,
            enough=150.0,
            smallest=space.smallest,
        )
        best = int(np.argmin(posterior.chi2))
        return Explanation(kind, posterior, posterior.samples[best], float(posterior.chi2[best]))

    # Other kinds

    def fits(self, explanation: Explanation, window: WhitenedWindow, worse: float = _WORSE) -> bool:
        """Return whether an explanation's residuals are no larger than noise.

        `worse` is the number of standard deviations by which they may exceed their expectation.
        """
        return bool(explanation.chi2 < self.most(window.data.size, worse))

    def most(self, degrees: int, worse: float = _WORSE) -> float:
        """Return the largest sum of squared residuals that noise explains.

        `degrees` is its expectation, and `worse` the allowed number of standard deviations.
        """
        of_noise = 2 * degrees**2 / (self.quiet * self.motion.noise.size)
        return float(degrees + worse * np.sqrt(2 * degrees + of_noise))

    def _later_is_worse(
        self, longer: Explanation, over: WhitenedWindow, shorter: Explanation, until: WhitenedWindow
    ) -> bool:
        """Return whether a shorter window is explained, but not the samples of a longer one."""
        added = over.data.size - until.data.size
        more = longer.chi2 - shorter.chi2
        return self.fits(shorter, until) and more > self.most(added, _WORSE_LATER)

    def _changes(self, rest: Explanation, window: WhitenedWindow) -> bool:
        """Return whether a moving or yielding obstacle is clearly likelier than one at rest."""
        extra = np.array([[-0.05, 0.0], [0.05, 0.0], [0.0, 0.02]])
        starts = np.hstack([np.tile(rest.parameters, (len(extra), 1)), extra])
        free = np.hstack([np.ones((len(extra), rest.parameters.size), dtype=bool), extra != 0])
        touching = Touching(self.tables.middle, self.tables.x_m, self.motion)
        side = touching.side(rest.parameters)
        found = descend(
            lambda candidates, window: touching.predicted(candidates, window, side)[0],
            window,
            starts,
            self.space(5),
            rounds=5,
            free=free,
        )
        return bool(found.chi2.min() < rest.chi2 - DOUBTFUL)

    def _others(self, window: WhitenedWindow) -> list[Explanation]:
        """Return the explanations of the window by a moving or yielding obstacle, and a knock."""
        blind, side = self.blind, self.side()
        likely = blind.x_m[np.argsort(-blind.log_likelihood)[:24]]
        instants = self.motion.t[self.quiet + 2 : self.detected + 1 : 2]
        found = []
        for kind, extra in (("moving", _RATES_M_PER_S), ("yielding", _MOBILITIES)):
            grid = np.meshgrid(likely, instants, np.log(_STIFFNESSES), extra, indexing="ij")
            starts = np.stack([each.ravel() for each in grid], axis=1)
            coarse = self._marching(kind, self.tables.coarse, side)
            for span, count in ((GRID_S, 80), (FIRST_S, 10)):
                chi2 = chi2_of(coarse, self.window(span), starts)
                starts = starts[np.argsort(chi2)[:count]]
            march, space = self._marching(kind, self.tables.middle, side), self._moving_space(kind)
            if window.end > self.end(FIRST_S):
                begun = descend(march, self.window(FIRST_S), starts, space, rounds=6)
                starts = begun.parameters
            found.append(self.explained(kind, march, window, starts, space))
        touching = Touching(self.tables.middle, self.tables.x_m, self.motion)
        knocking = Knocking(touching, self.tables.middle, 2)
        starts = knocking.starts(self.window(FIRST_S), self.detected, 10)
        rest = self.space(3)
        space = knocking.space(self.edges, (rest.low[1], rest.high[1]))
        found.append(self.explained("knock", knocking.predicted, window, starts, space))
        return found

    def pairing(self) -> Pairing:
        """Return the integration of the contact with two obstacles for this record."""
        tables = self.tables
        touching = Touching(tables.coarse, tables.x_m, self.motion)
        return Pairing(touching, tables.coarse, tables.crossing)

    def _two(self, rest: Explanation, window: WhitenedWindow) -> Explanation | None:
        """Return the explanation by two obstacles, or None if one obstacle explains as much."""
        pairing = self.pairing()
        space = pairing.space(self.space(3))
        # The first samples show in less time whether more iterations are worthwhile.
        early = self.window(_COVERED_S) if window.end > self.end(_COVERED_S) else window
        starts = pairing.starts(rest.parameters, early, space, 2)
        found = descend(pairing.channels, early, starts, space, rounds=4)
        one = rest.parameters[None]
        if found.chi2.min() > chi2_of(self.predicting(one), early, one)[0] - _HOPEFUL:
            return None
        likely = found.parameters[np.argsort(found.chi2)[:3]]
        starts = np.vstack([likely, pairing.exchanged(likely[:1])])
        found = descend(pairing.channels, window, starts, space, rounds=8)
        gain = rest.chi2 - found.chi2.min()
        if gain < _POSSIBLE:
            return None
        doubt = _DOUBT_OF_TWO if gain > CLEAR else 1.0
        return self._sampled("two", pairing.channels, window, found, space, doubt)

    def side(self) -> float:
        """Return the direction in which the beam presses on the obstacle, 1 or -1.

        It is opposite to the direction of the likeliest force on the beam.
        """
        return -1.0 if self.blind.force_n.sum() > 0 else 1.0

    def _marching(self, kind: str, kernels: ContactKernels, side: float) -> Prediction:
        """Return the function that predicts the effect of moving or yielding obstacles.

        Their fourth parameter is the speed or the mobility.
        """
        touching = Touching(kernels, self.tables.x_m, self.motion)

        def predicted(candidates: Real, window: WhitenedWindow) -> Real:
            if kind == "yielding":
                candidates = np.insert(candidates, 3, 0.0, axis=1)
            return touching.predicted(candidates, window, side)[0]

        return predicted

    def _moving_space(self, kind: str) -> Space:
        """Return the ranges of the four parameters of a moving or yielding obstacle."""
        ranges = self.space(5)
        columns = [0, 1, 2, 3 if kind == "moving" else 4]
        return Space(
            ranges.low[columns],
            ranges.high[columns],
            ranges.difference[columns],
            ranges.scale[columns],
            ranges.smallest[columns],
            ranges.loose[columns],
        )


def _distinct(found: Descended) -> Real:
    """Return the parameters of minima that are not close to a better minimum, the best first."""
    order = np.argsort(found.chi2)
    distinct: list[Real] = []
    for row in found.parameters[order[found.chi2[order] < 2 * found.chi2.min() + 60]]:
        if all(np.any(np.abs(row - other)[:2] > (5e-4, 4e-5)) for other in distinct):
            distinct.append(row)
    return np.array(distinct)
