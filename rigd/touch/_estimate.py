"""Estimation of a touch's position, instant and force from its record.

The time from touch to detection is unknown: the shortest assumed time is tried first, longer ones
if it fails. The samples before the touch determine the motion of the free beam.
"""

import numpy as np

from rigd.touch._combined_estimate import estimate_from_explanations
from rigd.touch._explanations import ExplanationSearch
from rigd.touch._free_motion import TouchRecord
from rigd.touch._model import TouchModel
from rigd.touch._results import TouchEstimate
from rigd.touch._tables import DETECTION_DELAYS_S, TouchTables

_MIN_SAMPLES_BEFORE_TOUCH = 100
"""Smallest number of samples before a touch that an estimate requires."""
_MAX_RESTING_MISFIT = 3.0
"""Mean square residual of an obstacle at rest, divided by the noise variance, above which the touch
may have begun earlier."""


def estimate_touch(touch_record: TouchRecord, model: TouchModel) -> TouchEstimate:
    """Estimate position, instant, force and stiffness of one touch from its record.

    For several touches with the same model, create a `TouchEstimator` once.

    Parameters
    ----------
    touch_record
        Samples from 0.3 s or more before the touch.
    model
        Model of the beam.
    """
    return TouchEstimator(model, touch_record.rate_hz).estimate(touch_record)


class TouchEstimator:
    """Estimator of touches for one model of the beam; its construction takes a second.

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
        self._tables = TouchTables(model, rate_hz)

    def estimate(
        self, touch_record: TouchRecord, *, includes_likelihoods: bool = True
    ) -> TouchEstimate:
        """Return the estimate of one touch from its record.

        Parameters
        ----------
        touch_record
            Samples from 0.3 s or more before the touch. More samples after the detection, up to
            0.2 s, improve the estimate.
        includes_likelihoods
            Whether the estimate contains the likelihood of each position; otherwise that is empty.
        """
        return self.growing_estimator().update(
            touch_record, includes_likelihoods=includes_likelihoods
        )

    def growing_estimator(self) -> "GrowingEstimate":
        """Return an estimator of one touch for records that grow from call to call."""
        return GrowingEstimate(self._tables)


class GrowingEstimate:
    """Estimator of one touch whose record grows; each estimate starts from the previous one.

    All records must begin with the same sample.

    Parameters
    ----------
    touch_tables
        Precomputed quantities of the model at the record's rate.
    """

    __slots__ = ("_explaining_delay_s", "_searches", "_tables")

    def __init__(self, touch_tables: TouchTables) -> None:
        self._tables = touch_tables
        self._searches: dict[float, ExplanationSearch] = {}
        self._explaining_delay_s: float | None = None

    def preview(self, touch_record: TouchRecord) -> None:
        """Search the likely positions of the touch in advance, so that the first update is fast.

        Parameters
        ----------
        touch_record
            Samples up to `PREVIEW_SEARCH_S` after the detection or somewhat later.
        """
        for detection_delay_s in DETECTION_DELAYS_S[
            :-1
        ]:  # the last one takes long, and is hardly ever needed
            if not self._has_enough_samples(touch_record, detection_delay_s):
                return
            if not self._search_at_delay(touch_record, detection_delay_s).begins_before_window:
                return

    def update(
        self, record: TouchRecord, *, includes_likelihoods: bool = True, is_first: bool = False
    ) -> TouchEstimate:
        """Return the estimate of the touch from the samples so far.

        Parameters
        ----------
        record
            Samples from 0.3 s or more before the touch.
        includes_likelihoods
            Whether the estimate contains the likelihood of each position; otherwise that is empty.
        is_first
            Whether this is the first estimate. Only one and two obstacles at rest are then tried,
            because other kinds take a second; a touch of another kind is reported as unknown.
        """
        latest_estimate = None
        first_searched_sample = record.angle_rad.size
        # The delay with which an earlier record was explained comes first.
        for detection_delay_s in sorted(
            DETECTION_DELAYS_S, key=lambda delay_s: delay_s != self._explaining_delay_s
        ):
            if not self._has_enough_samples(record, detection_delay_s):
                continue
            explanation_search = self._search_at_delay(record, detection_delay_s)
            if detection_delay_s != self._explaining_delay_s and (
                # A longer delay only if the touch may begin before the window of the shorter one.
                explanation_search.likely_first_sample >= first_searched_sample
                or self._touch_began_earlier(record, detection_delay_s)
            ):
                continue
            touch_estimate = estimate_from_explanations(
                explanation_search,
                explanation_search.explain(is_first=is_first),
                includes_likelihoods=includes_likelihoods,
            )
            if latest_estimate is None or touch_estimate.is_explained:
                latest_estimate = touch_estimate
            if touch_estimate.is_explained:
                self._explaining_delay_s = detection_delay_s
            if touch_estimate.is_explained or is_first:
                break
            first_searched_sample = explanation_search.fit.first_touch_sample
        return latest_estimate or self._empty_estimate(record)

    def _has_enough_samples(self, touch_record: TouchRecord, detection_delay_s: float) -> bool:
        """Return whether 100 samples precede a touch `detection_delay_s` before its detection."""
        return (
            touch_record.detection_index - round(detection_delay_s * self._tables.rate_hz)
            >= _MIN_SAMPLES_BEFORE_TOUCH
        )

    def _search_at_delay(
        self, touch_record: TouchRecord, detection_delay_s: float
    ) -> ExplanationSearch:
        """Return the search for explanations of a record, for one longest delay of the detection.

        A new search starts from the results of the search in the previous, shorter record.
        """
        previous_search = self._searches.get(detection_delay_s)
        if previous_search is None or previous_search.given_record is not touch_record:
            self._searches[detection_delay_s] = ExplanationSearch(
                self._tables, touch_record, detection_delay_s, previous_search
            )
        return self._searches[detection_delay_s]

    def _touch_began_earlier(self, touch_record: TouchRecord, detection_delay_s: float) -> bool:
        """Return whether a touch probably began more than `detection_delay_s` before detection."""
        if detection_delay_s == DETECTION_DELAYS_S[-1]:
            return False
        explanation_search = self._search_at_delay(touch_record, detection_delay_s)
        if explanation_search.begins_before_window:
            return True
        longer_delay_s = DETECTION_DELAYS_S[DETECTION_DELAYS_S.index(detection_delay_s) + 1]
        if explanation_search.misfit < _MAX_RESTING_MISFIT or not self._has_enough_samples(
            touch_record, longer_delay_s
        ):
            return False
        longer_search = self._search_at_delay(touch_record, longer_delay_s)
        return (
            longer_search.likely_first_sample < explanation_search.fit.first_touch_sample
            and longer_search.misfit < 0.5 * explanation_search.misfit
        )

    def _empty_estimate(self, touch_record: TouchRecord) -> TouchEstimate:
        """Return an estimate of unknown kind without values, for a record with too few samples."""
        empty_array = np.zeros(0)
        channel_count = 1 if touch_record.shear_n is None else 2
        return TouchEstimate(
            x_m=None,
            time_s=None,
            force_n=None,
            stiffness_n_per_m=None,
            kind="unknown",
            model=self._tables.model.source,
            channels=channel_count,
            samples=touch_record.angle_rad.size - touch_record.detection_index,
            chi2_per_degree=np.nan,
            positions_m=empty_array,
            log_likelihood=empty_array,
            innovations=np.zeros((channel_count, 0)),
            innovation_times_s=empty_array,
            force_history_n=empty_array,
            force_times_s=empty_array,
        )
