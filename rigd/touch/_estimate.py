"""Position, instant and force of a touch, from its record.

The touch began some time before its detection. The shortest possible time is assumed first. The
samples before the touch determine the motion of the free beam.
"""

import numpy as np

from rigd.touch._answer import answer
from rigd.touch._explanations import Explainer
from rigd.touch._free_motion import TouchRecord
from rigd.touch._model import TouchModel
from rigd.touch._results import TouchEstimate
from rigd.touch._tables import NOTICED_S, Tables

_LEAST_QUIET = 100
"""Smallest number of samples before a touch with which an estimate is possible."""
_HOPELESS = 3.0
"""Mean square residual of an obstacle at rest, over noise, above which the touch may have begun
earlier."""


def estimate_touch(record: TouchRecord, model: TouchModel) -> TouchEstimate:
    """Estimate position, instant, force and stiffness of one touch from its record.

    For several touches with one model, prepare a `TouchEstimator`.

    Parameters
    ----------
    record
        Samples from 0.3 s or more before the touch.
    model
        Model of the beam.
    """
    return TouchEstimator(model, record.rate_hz).estimate(record)


class TouchEstimator:
    """Estimator of touches with one model of the beam; its preparation takes a second.

    Parameters
    ----------
    model
        Model of the beam.
    rate_hz
        Samples a second.
    """

    __slots__ = ("_tables", "model")

    def __init__(self, model: TouchModel, rate_hz: float) -> None:
        self.model = model
        self._tables = Tables(model, rate_hz)

    def estimate(self, record: TouchRecord, *, scan: bool = True) -> TouchEstimate:
        """Return the estimate of one touch from the samples so far.

        Parameters
        ----------
        record
            Samples from 0.3 s or more before the touch. More samples after the detection, up to
            0.2 s, improve the estimate.
        scan
            Whether the estimate contains the likelihood of all positions; otherwise it is empty.
        """
        return self.follow().update(record, scan=scan)

    def follow(self) -> "GrowingEstimate":
        """Return an empty estimate of one touch, to be updated while its record grows."""
        return GrowingEstimate(self._tables)


class GrowingEstimate:
    """Estimation of one touch while its record grows; each estimate starts from the previous one.

    All records begin with the same sample.

    Parameters
    ----------
    tables
        Precomputed quantities of the model at the record's rate.
    """

    __slots__ = ("_earlier", "_explained_by", "_tables")

    def __init__(self, tables: Tables) -> None:
        self._tables = tables
        self._earlier: dict[float, Explainer] = {}
        self._explained_by: float | None = None

    def preview(self, record: TouchRecord) -> None:
        """Search the likely positions of the touch in advance, so that the first estimate is fast.

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
        """Return the estimate of the touch from the samples so far.

        Parameters
        ----------
        record
            Samples from 0.3 s or more before the touch.
        scan
            Whether the estimate contains the likelihood of all positions; otherwise it is empty.
        first
            Whether this is the first estimate. It then tries one and two obstacles at rest only,
            because other kinds take a second, and reports any other touch as of unknown kind.
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
        """Return whether there are enough samples before a touch `noticed_s` before detection."""
        return record.detected - round(noticed_s * self._tables.rate_hz) >= _LEAST_QUIET

    def _explainer(self, record: TouchRecord, noticed_s: float) -> Explainer:
        """Return the search for explanations of a record, for one time from touch to detection.

        It starts from the results with the previous, shorter record.
        """
        earlier = self._earlier.get(noticed_s)
        if earlier is None or earlier.given is not record:
            self._earlier[noticed_s] = Explainer(self._tables, record, noticed_s, earlier)
        return self._earlier[noticed_s]

    def _began_earlier(self, record: TouchRecord, noticed_s: float) -> bool:
        """Return whether the touch seems to begin more than `noticed_s` before its detection."""
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
        """Return the estimate without any result, for a record with too few samples."""
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
