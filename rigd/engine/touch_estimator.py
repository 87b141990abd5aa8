"""The touch process, which estimates the position and force of each detected touch.

It observes the ring of samples as the live publisher does, so it can neither delay the loop nor
take a sample from the recorder. The loop marks a detection by a status bit of the sample. A preview
uses the samples up to 25 ms after the detection, the first estimate 50 ms, and the final estimate
200 ms.
"""

import time
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigd.engine._ring import RingObserver
from rigd.engine.channels import attach_channels
from rigd.engine.messages import TouchJob, TouchReady, TouchReport
from rigd.engine.processes import SupervisorConnection
from rigd.engine.realtime import pin_off_loop_core
from rigd.engine.shared_state import StateField
from rigd.runtime import ignore_end_signals as ignore_signals
from rigd.session.layout import Status, decode_samples
from rigd.touch import GrowingEstimate, TouchEstimator, TouchRecord
from rigd.touch.samples import (
    FINAL_ESTIMATE_S,
    FIRST_ESTIMATE_S,
    MAX_CONTACT_S,
    PREVIEW_SEARCH_S,
    RECORD_BEFORE_DETECTION_S,
    around_touch,
    touch_record,
)

_MAX_BLOCK_SAMPLES = 250
"""Largest number of samples that are read from the ring at once."""
_IDLE_PAUSE_S, _PENDING_PAUSE_S = 0.005, 0.001
"""Pauses in s if there are no new samples: without a pending touch, and with a touch that waits for
its estimate."""


def main() -> None:
    """Run the touch process, started as ``python -m rigd.engine.touch_estimator``."""
    ignore_signals()
    parent = SupervisorConnection()
    job: TouchJob = parent.receive_job()
    if job.realtime is not None:
        pin_off_loop_core(job.realtime.cpu)
    channels = attach_channels(job.channels)
    sample_reader = RingObserver(channels.samples, job.first_index)
    estimator = TouchEstimator(job.model, job.rate_hz)
    parent.send(TouchReady())
    running_estimator = RunningTouchEstimator(estimator, job)
    while True:
        channels.shared_state.beat(StateField.TOUCH_BEAT)
        sample_bytes = sample_reader.take(_MAX_BLOCK_SAMPLES)
        if sample_bytes:
            running_estimator.add_samples(decode_samples(sample_bytes))
        else:
            time.sleep(_IDLE_PAUSE_S if running_estimator.idle else _PENDING_PAUSE_S)
        for touch_report in running_estimator.reports():
            parent.send(touch_report)
        try:
            if parent.poll(0.0) is not None:
                return
        except EOFError:
            return


@dataclass(slots=True)
class _PendingTouch:
    """Detected touch that waits for its final estimate."""

    touch_number: int
    """Number of the touch in its session, from 1 on."""
    tick: int
    """Tick at which the touch was detected."""
    contact_end_tick: int
    """First tick at which the beam is free again after the previous touch."""
    estimate: GrowingEstimate
    """Estimate of the touch, which improves as samples arrive."""
    is_previewed: bool = False
    """Whether the preview has been computed, so that the first estimate takes less time."""
    is_reported: bool = False
    """Whether the first estimate has been sent."""


class RunningTouchEstimator:
    """Estimator of the detected touches of a running record, as soon as samples suffice.

    Parameters
    ----------
    estimator
        Estimator for the model and the sample rate of the job.
    job
        Job of the touch process.
    """

    def __init__(self, estimator: TouchEstimator, job: TouchJob) -> None:
        self._estimator = estimator
        self._job = job
        (
            self._history_ticks,
            self._preview_ticks,
            self._first_ticks,
            self._final_ticks,
            self._contact_ticks,
        ) = (
            round(duration_s * job.rate_hz)
            for duration_s in (
                RECORD_BEFORE_DETECTION_S,
                PREVIEW_SEARCH_S,
                FIRST_ESTIMATE_S,
                FINAL_ESTIMATE_S,
                MAX_CONTACT_S,
            )
        )
        self._samples: NDArray[np.void] | None = None
        self._pending_touches: deque[_PendingTouch] = deque()
        self._contact_end_tick = 0
        self._count = 0
        self._record_ended = False

    @property
    def idle(self) -> bool:
        """Whether all detected touches have their final estimate."""
        return not self._pending_touches

    def add_samples(self, new_samples: NDArray[np.void]) -> None:
        """Add the next samples of the record, shape (n,), and register the touches in them."""
        earlier_samples = self._samples
        self._samples = (
            new_samples
            if earlier_samples is None
            else np.concatenate([earlier_samples, new_samples])
        )
        for tick in new_samples["tick"][(new_samples["status"] & Status.TOUCHED) != 0].tolist():
            self._count += 1
            estimate = self._estimator.growing_estimator()
            self._pending_touches.append(
                _PendingTouch(self._count, tick, self._contact_end_tick, estimate)
            )
            self._contact_end_tick = tick + self._contact_ticks
        self._record_ended |= bool(new_samples["status"][-1] & Status.TORQUE_OFF)
        if not self._pending_touches:
            self._samples = self._samples[-self._history_ticks :]

    def reports(self) -> list[TouchReport]:
        """Return a list with the next estimate of the oldest pending touch, if samples suffice.

        The list is empty if no estimate is due.
        """
        if self._samples is None or not self._pending_touches:
            return []
        pending_touch = self._pending_touches[0]
        available_ticks = int(self._samples["tick"][-1]) - pending_touch.tick + 1
        is_final = self._record_ended or available_ticks >= self._final_ticks
        # In real time the operator waits for the first estimate, even if the record is complete.
        sends_first_estimate = self._job.realtime is not None or not is_final
        if (
            available_ticks >= self._first_ticks
            and sends_first_estimate
            and not pending_touch.is_reported
        ):
            pending_touch.is_reported = True
            return [self._touch_report(pending_touch, self._first_ticks, is_final=False)]
        if is_final:
            self._pending_touches.popleft()
            return [self._touch_report(pending_touch, self._final_ticks, is_final=True)]
        if available_ticks >= self._preview_ticks and not pending_touch.is_previewed:
            pending_touch.is_previewed = True
            record, _ = self._record_around_touch(pending_touch, self._preview_ticks)
            pending_touch.estimate.preview(record)
        return []

    def _touch_report(
        self, pending_touch: _PendingTouch, ticks_after_touch: int, *, is_final: bool
    ) -> TouchReport:
        """Return the estimate of a touch from the samples up to a number of ticks after it."""
        record, start_s = self._record_around_touch(pending_touch, ticks_after_touch)
        touch_estimate = pending_touch.estimate.update(
            record, includes_likelihoods=False, is_first=not is_final
        )
        estimate_document = touch_estimate.as_dict(start_s)
        return TouchReport(
            pending_touch.touch_number, pending_touch.tick, is_final, estimate_document
        )

    def _record_around_touch(
        self, pending_touch: _PendingTouch, ticks_after_touch: int
    ) -> tuple[TouchRecord, float]:
        """Return the samples around a touch, up to `ticks_after_touch` after its detection.

        Also returns their start time in s since the start of the session's record.
        """
        assert self._samples is not None
        job = self._job
        # Soon after another touch the beam may not have been free: the estimate is then unknown.
        contact_end_tick = min(pending_touch.contact_end_tick, pending_touch.tick)
        samples = around_touch(self._samples, pending_touch.tick, job.rate_hz, contact_end_tick)
        record = touch_record(samples, pending_touch.tick, job.rate_hz, job.shear_projection)
        return record.first_samples(record.detection_index + ticks_after_touch), int(
            samples["tick"][0]
        ) / job.rate_hz


if __name__ == "__main__":
    main()
