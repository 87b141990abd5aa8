"""What explains the record of one touch: candidates of each kind, and what they leave of it.

Innovations of torque and base shear are explained by a springy obstacle at rest, marched through
its bounces; beside it stand two obstacles, those that move or give way, a knock, and any force at
all. What of them is told is decided elsewhere (`_answer`).
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
"""After the detection: what is explained, the longest only if an obstacle at rest explains the
shorter ones and the point is not well known yet."""
_COVERED_S = 0.1
"""After the detection: so far the effects of what is uncertain are taken along at once."""
_WORTH = 1.2
"""So many times the samples are worth another stage."""
_WELL_KNOWN_M = 2e-3
_CLOUD = 96
"""Starts for a longer part of the record, from what a shorter one leaves likely."""
NEAR_TIP = 0.8
"""Share of the length beyond which contacts are shorter, and steps finer."""
_NEARBY_M = np.array([-4e-3, -2e-3, 2e-3, 4e-3])
_AT_TIP = 0.95
"""Beyond this share a longer record tells no more: its many short contacts fit anywhere."""

_LEAST_SCALE = 1.2
"""Variance of the residuals at least assumed: the noise itself is known from few samples."""
_DOUBT_OF_TWO = 4.0
"""The sum of squared residuals of two obstacles that clearly explain more than one counts so many
times less: which of their several minima is the lowest, the errors of the model decide."""
CLEAR = 16.0
"""Difference in the sum of squared residuals that decides between two kinds."""
DOUBTFUL = 9.0
"""By so much less, that of an obstacle that moves or gives way leaves open whether it is at rest:
one that is at rest gains that much by chance in one of a hundred touches."""
_POSSIBLE = 5.0
"""By so much less, that of two obstacles leaves open where the point is."""
_HOPEFUL = 0.8
"""By so much less, after a few iterations, two obstacles are worth more of them."""
_WORSE = 3.5
"""By so many standard deviations may the sum of squared residuals exceed its expectation."""
POOR = 2.0
"""Beyond so many the explanation may be the wrong one: other kinds are tried, and the point gets
the interval that any force leaves it."""
_WORSE_LATER = 2.5
"""The same for what a longer record adds. Bounces make much of small errors of the model: where the
later ones are explained less well, what the first told is nearer to the truth."""

_RATES_M_PER_S = np.array([-1.5, -0.7, -0.3, -0.1, 0.1, 0.25, 0.5])
_MOBILITIES = np.array([0.01, 0.04, 0.15, 0.6])
_STIFFNESSES = np.array([300.0, 3000.0, 30000.0])
"""Starts of obstacles that move (m/s) or give way (m/s per N), and their stiffnesses."""


@dataclass(frozen=True, slots=True)
class Explanation:
    """The best that obstacles of one kind make of the record."""

    kind: str
    posterior: Posterior
    parameters: Real
    chi2: float


@dataclass(frozen=True, slots=True)
class Explained:
    """What may explain a record, and how far."""

    explanations: list[Explanation]
    """An obstacle at rest comes first."""
    window: WhitenedWindow
    """The part of the record that they explain."""
    later_doubtful: bool
    """Later samples, which are left out, speak against an obstacle at rest."""
    untried: bool
    """Another kind may be likelier, but none was tried."""


class Explainer:
    """Explains the record of one touch.

    Parameters
    ----------
    tables
        What depends on the model and the rate.
    record
        Samples from 0.3 s or more before the touch.
    noticed_s
        The touch was noticed at most so long after it.
    earlier
        What explained the beginning of the same record: its results are gone on from.
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
        """The first sample of the record that may hold the touch."""
        return self.begin + self.quiet

    @property
    def begins_too_late(self) -> bool:
        """Whether the touch seems to be before the samples that may hold it."""
        return bool(self.starts[0, 1] < self.motion.t[self.quiet] + 2.5 / self.rate)

    @property
    def seems_to_begin(self) -> int:
        """Sample of the record before which the likeliest touch of the first look begins."""
        after_s = float(self.starts[0, 1] - self.motion.t[self.quiet])
        return self.first + round(after_s * self.rate)

    @property
    def misfit(self) -> float:
        """What an obstacle at rest leaves of the first samples, by what noise would leave."""
        return float(self._descended.chi2.min() / self._first_samples.data.size)

    def explain(self, *, first: bool) -> Explained:
        """Explain the record by obstacles at rest and, unless it is the `first` time, by others."""
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

        Returns what the longest one tells that is explained, or else the first one that is not, and
        that part; two obstacles, if they explain one that a single one does not; and whether what
        follows speaks against it.
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
                # Of still later bounces the search may miss the minimum: they speak of no kind.
                doubtful = seconds <= _COVERED_S and self._changes(rest, window)
                return *before, None, doubtful
            before = rest, window
            self._at_rest = rest, seconds
            if self._enough(rest, window, seconds):
                break
            starts = self._further(rest)
        assert before is not None  # there is one stage at least, or one of before
        return *before, None, False

    def _enough(self, rest: Explanation, window: WhitenedWindow, seconds: float) -> bool:
        """Whether a longer part of the record would tell no more."""
        x_m = rest.posterior.mean(0)
        known = rest.posterior.std(0) < _WELL_KNOWN_M or x_m > _AT_TIP * self.edges[1]
        return seconds > FIRST_S and bool(known or not self.fits(rest, window))

    def _take_along(self, likeliest: Real, seconds: float) -> None:
        """Know what is uncertain of so long a part of the record."""
        if self._covered_s < seconds:
            self._covered_s = min(max(seconds, _COVERED_S), self.available / self.rate)
            whole = WhitenedWindow.of(self.motion, self.quiet, self.end(self._covered_s))
            self.deviations = deviations(self.tables, self.record, likeliest[:1], whole)

    def _further(self, rest: Explanation) -> Real:
        """Return starts for a longer part of the record."""
        return np.vstack([rest.parameters, self._cloud(rest.posterior)])

    @cached_property
    def blind(self) -> BlindScan:
        """Any force in the first samples: it takes as long as the rest of an estimate from them."""
        return self.tables.blind.scan(self.window(FIRST_S))

    # What candidates are compared with

    def window(self, seconds: float) -> WhitenedWindow:
        """Return the samples from before the touch to so long after the detection."""
        return WhitenedWindow.of(self.motion, self.quiet, self.end(seconds), self.deviations)

    def end(self, seconds: float) -> int:
        """Return the sample so long after the detection, or the end of the record."""
        return self.detected + min(self.available, round(seconds * self.rate))

    def space(self, width: int) -> Space:
        """Ranges of `PARAMETERS`."""
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
        """March with short steps, near the tip with half as long ones: contacts are shorter there.

        `first`: elsewhere twice as long ones to begin with.
        """
        tables = self.tables
        tip = bool(np.median(rows[:, 0]) > NEAR_TIP * tables.model.beam.length_m)
        kernels = tables.finest if tip else tables.coarse if first else tables.middle
        touching = Touching(kernels, tables.x_m, self.motion)
        return lambda candidates, window: touching.predicted(candidates, window)[0]

    # Springy obstacle at rest

    def _best_of_grid(self) -> Real:
        """Return the likeliest candidates of the grid, some of each place."""
        window = self.window(GRID_S)
        grid = self.tables.starts(window.end - window.first)
        starts, chi2 = grid.marched(self.motion, window, self.detected)
        starts = starts[np.lexsort((chi2, starts[:, 0]))]
        count = starts.shape[0] // np.unique(starts[:, 0]).size
        best: Real = starts.reshape(-1, count, 3)[:, :4].reshape(-1, 3)
        return best

    @cached_property
    def _first_samples(self) -> WhitenedWindow:
        """What candidates of the grid are compared with: nothing uncertain is known of by then."""
        return WhitenedWindow.of(self.motion, self.quiet, self.end(FIRST_S))

    @cached_property
    def starts(self) -> Real:
        """The likeliest candidates of the grid, after a second look."""
        coarse = Touching(self.tables.coarse, self.tables.x_m, self.motion)
        again = chi2_of(
            lambda rows, window: coarse.predicted(rows, window)[0],
            self._first_samples,
            self._gridded,
        )
        return self._gridded[np.argsort(again)[:12]]

    @cached_property
    def _descended(self) -> Descended:
        """Where they lead, in longer steps."""
        predict = self.predicting(self.starts, first=True)
        return descend(predict, self._first_samples, self.starts, self.space(3), rounds=7)

    def _with_neighbours(self, starts: Real) -> Real:
        """Add starts beside the best ones near the tip, where the minima stand close together."""
        if np.median(starts[:, 0]) <= NEAR_TIP * self.tables.model.beam.length_m:
            return starts
        nearby = np.repeat(starts[None, :2], _NEARBY_M.size, axis=0)
        nearby[:, :, 0] = np.clip(nearby[:, :, 0] + _NEARBY_M[:, None], *self.edges)
        return np.vstack([starts, nearby.reshape(-1, starts.shape[1])])

    def _cloud(self, posterior: Posterior) -> Real:
        """Candidates of a longer window, from what a shorter one leaves likely."""
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
        """Descend from starts, and sample around the minima."""
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
        """Sample around minima; `doubt` is what differences of chi² are divided by."""
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
        """Whether no more is left than noise leaves, which is itself known from few samples."""
        return bool(explanation.chi2 < self.most(window.data.size, worse))

    def most(self, degrees: int, worse: float = _WORSE) -> float:
        """Greatest sum of squared residuals that noise explains."""
        of_noise = 2 * degrees**2 / (self.quiet * self.motion.noise.size)
        return float(degrees + worse * np.sqrt(2 * degrees + of_noise))

    def _later_is_worse(
        self, longer: Explanation, over: WhitenedWindow, shorter: Explanation, until: WhitenedWindow
    ) -> bool:
        """Whether the shorter of two windows is explained, and not what the longer one adds."""
        added = over.data.size - until.data.size
        more = longer.chi2 - shorter.chi2
        return self.fits(shorter, until) and more > self.most(added, _WORSE_LATER)

    def _changes(self, rest: Explanation, window: WhitenedWindow) -> bool:
        """Whether the obstacle at rest becomes likelier if it may move or give way."""
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
        """Obstacles that move or give way, and a knock."""
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
        """Return what marches two obstacles on this record."""
        tables = self.tables
        touching = Touching(tables.coarse, tables.x_m, self.motion)
        return Pairing(touching, tables.coarse, tables.crossing)

    def _two(self, rest: Explanation, window: WhitenedWindow) -> Explanation | None:
        """Two obstacles, if they may explain more than one at rest does."""
        pairing = self.pairing()
        space = pairing.space(self.space(3))
        # The first samples tell in less time whether more iterations are worth while.
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
        """Direction in which the beam presses: against the force, whatever that comes from."""
        return -1.0 if self.blind.force_n.sum() > 0 else 1.0

    def _marching(self, kind: str, kernels: ContactKernels, side: float) -> Prediction:
        """March obstacles whose fourth parameter is their rate or their mobility."""
        touching = Touching(kernels, self.tables.x_m, self.motion)

        def predicted(candidates: Real, window: WhitenedWindow) -> Real:
            if kind == "yielding":
                candidates = np.insert(candidates, 3, 0.0, axis=1)
            return touching.predicted(candidates, window, side)[0]

        return predicted

    def _moving_space(self, kind: str) -> Space:
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
    """Minima that are not worth the same as a better one beside them, the best first."""
    order = np.argsort(found.chi2)
    distinct: list[Real] = []
    for row in found.parameters[order[found.chi2[order] < 2 * found.chi2.min() + 60]]:
        if all(np.any(np.abs(row - other)[:2] > (5e-4, 4e-5)) for other in distinct):
            distinct.append(row)
    return np.array(distinct)
