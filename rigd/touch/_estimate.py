"""Position, instant and force of a touch, from its record.

The touch began some time before its detection. The shortest possible time is tried first: the
samples before it determine the motion of the free beam.
"""

import numpy as np

from rigd.touch._answer import answer
from rigd.touch._explanations import Explainer
from rigd.touch._free_motion import TouchRecord
from rigd.touch._model import TouchModel
from rigd.touch._results import TouchEstimate
from rigd.touch._tables import NOTICED_S, Tables

_LEAST_QUIET = 100
"""Samples before a touch without which no estimate is possible."""
_HOPELESS = 3.0
"""Above this misfit per sample of an obstacle at rest, the touch may have begun earlier."""


def estimate_touch(record: TouchRecord, model: TouchModel) -> TouchEstimate:
    """Estimate one touch; for several with one model, prepare a `TouchEstimator`.

    Parameters
    ----------
    record
        Samples from 0.3 s or more before the touch.
    model
        The beam.
    """
    return TouchEstimator(model, record.rate_hz).estimate(record)


class TouchEstimator:
    """Estimates touches with one model; its preparation takes a second.

    Parameters
    ----------
    model
        The beam.
    rate_hz
        Samples a second.
    """

    __slots__ = ("_tables", "model")

    def __init__(self, model: TouchModel, rate_hz: float) -> None:
        self.model = model
        self._tables = Tables(model, rate_hz)

    def estimate(self, record: TouchRecord, *, scan: bool = True) -> TouchEstimate:
        """Estimate one touch from the samples so far.

        Parameters
        ----------
        record
            Samples from 0.3 s or more before the touch; more samples after the detection improve
            the answer, up to 0.2 s.
        scan
            Whether to return the likelihood of all positions; else it is empty.
        """
        return self.follow().update(record, scan=scan)

    def follow(self) -> "GrowingEstimate":
        """Return an estimate of one touch that is updated while its record grows."""
        return GrowingEstimate(self._tables)


class GrowingEstimate:
    """Successive estimates of one touch, each of which continues from the previous one.

    All its records begin with the same sample.

    Parameters
    ----------
    tables
        Tables of the model at this rate.
    """

    __slots__ = ("_earlier", "_explained_by", "_tables")

    def __init__(self, tables: Tables) -> None:
        self._tables = tables
        self._earlier: dict[float, Explainer] = {}
        self._explained_by: float | None = None

    def preview(self, record: TouchRecord) -> None:
        """Search the possible positions in advance, as part of the first estimate.

        Parameters
        ----------
        record
            Samples until `PREVIEW_S` after the detection, or some more.
        """
        for noticed_s in NOTICED_S[:-1]:  # the last one takes long, and is hardly ever needed
            if not self._reaches(record, noticed_s):
                return
            if not self._explainer(record, noticed_s).begins_too_late:
                return

    def update(
        self, record: TouchRecord, *, scan: bool = True, first: bool = False
    ) -> TouchEstimate:
        """Estimate the touch from the samples so far.

        Parameters
        ----------
        record
            Samples from 0.3 s or more before the touch.
        scan
            Whether to return the likelihood of all positions; else it is empty.
        first
            Whether this is the first answer: it tries one and two obstacles at rest only, and
            reports any other touch as of unknown kind, since other kinds take a second.
        """
        result = None
        searched = record.angle_rad.size
        # The start that explained the beginning comes first.
        for noticed_s in sorted(NOTICED_S, key=lambda each: each != self._explained_by):
            if not self._reaches(record, noticed_s):
                continue
            here = self._explainer(record, noticed_s)
            if noticed_s != self._explained_by and (
                # After an unexplained one, only if the touch may have begun before.
                here.seems_to_begin >= searched or self._began_earlier(record, noticed_s)
            ):
                continue
            found = answer(here, here.explain(first=first), scan=scan)
            if result is None or found.explained:
                result = found
            if found.explained:
                self._explained_by = noticed_s
            if found.explained or first:
                break
            searched = here.first
        return result or self._without_answer(record)

    def _reaches(self, record: TouchRecord, noticed_s: float) -> bool:
        """Return whether there are enough samples of the free beam."""
        return record.detected - round(noticed_s * self._tables.rate_hz) >= _LEAST_QUIET

    def _explainer(self, record: TouchRecord, noticed_s: float) -> Explainer:
        """Return the explainer of a record, which continues from that of the previous record."""
        earlier = self._earlier.get(noticed_s)
        if earlier is None or earlier.given is not record:
            self._earlier[noticed_s] = Explainer(self._tables, record, noticed_s, earlier)
        return self._earlier[noticed_s]

    def _began_earlier(self, record: TouchRecord, noticed_s: float) -> bool:
        """Return whether the touch seems to begin before the samples that may contain it."""
        if noticed_s == NOTICED_S[-1]:
            return False
        here = self._explainer(record, noticed_s)
        if here.begins_too_late:
            return True
        longer_s = NOTICED_S[NOTICED_S.index(noticed_s) + 1]
        if here.misfit < _HOPELESS or not self._reaches(record, longer_s):
            return False
        longer = self._explainer(record, longer_s)
        return longer.seems_to_begin < here.first and longer.misfit < 0.5 * here.misfit

    def _without_answer(self, record: TouchRecord) -> TouchEstimate:
        """Return the empty estimate for too few samples before the touch."""
        nothing = np.zeros(0)
        channels = 1 if record.shear_n is None else 2
        return TouchEstimate(
            x_m=None,
            time_s=None,
            force_n=None,
            stiffness_n_per_m=None,
            kind="unknown",
            model=self._tables.model.source,
            channels=channels,
            samples=record.angle_rad.size - record.detected,
            chi2_per_degree=np.nan,
            positions_m=nothing,
            log_likelihood=nothing,
            innovations=np.zeros((channels, 0)),
            innovation_times_s=nothing,
            force_history_n=nothing,
            force_times_s=nothing,
        )
