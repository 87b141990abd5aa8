"""The touch process: from the samples around a detected touch to where and how hard it was.

It watches the ring of samples as the live publisher does, so that it can neither delay the loop nor
take a sample from the recorder, and looks for the bit by which the loop marks a detection. It
begins with the samples that are there 25 ms after it, answers from 50 ms, and again from 200 ms.
"""

import time
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigd.engine._ring import Observer
from rigd.engine.channels import attach_channels
from rigd.engine.messages import TouchJob, TouchReady, TouchTold
from rigd.engine.processes import Parent
from rigd.engine.realtime import keep_off_loop
from rigd.engine.shared_state import Word
from rigd.runtime import ignore as ignore_signals
from rigd.session.layout import Status, decode_samples
from rigd.touch import GrowingEstimate, TouchEstimator, TouchRecord
from rigd.touch.samples import (
    CONTACT_S,
    FINAL_S,
    FIRST_S,
    HISTORY_S,
    LOOK_S,
    around_touch,
    touch_record,
)

_BLOCK = 250
_IDLE_S, _WAITING_S = 0.005, 0.001
"""Pause where nothing has come: while nothing has been touched, and while somebody waits."""


def main() -> None:
    """Run as ``python -m rigd.engine.touch_estimator``."""
    ignore_signals()
    parent = Parent()
    job: TouchJob = parent.receive_job()
    if job.realtime is not None:
        keep_off_loop(job.realtime.cpu)
    channels = attach_channels(job.channels)
    reader = Observer(channels.samples, job.first)
    estimator = TouchEstimator(job.model, job.rate_hz)
    parent.send(TouchReady())
    touches = TouchFollower(estimator, job)
    while True:
        channels.board.beat(Word.TOUCH_BEAT)
        block = reader.take(_BLOCK)
        if block:
            touches.take(decode_samples(block))
        else:
            time.sleep(_IDLE_S if touches.idle else _WAITING_S)
        for told in touches.told():
            parent.send(told)
        try:
            if parent.poll(0.0) is not None:
                return
        except EOFError:
            return


@dataclass(slots=True)
class _Waiting:
    """A touch whose last estimate is to come."""

    number: int
    tick: int
    free_from: int
    """Tick from which the beam was free before."""
    estimate: GrowingEstimate
    looked: bool = False
    told: bool = False


class TouchFollower:
    """Follows the samples of a record, and estimates each touch as soon as there is enough of it.

    Parameters
    ----------
    estimator
        Prepared for the model and the rate.
    job
        What the process was told.
    """

    def __init__(self, estimator: TouchEstimator, job: TouchJob) -> None:
        self._estimator = estimator
        self._job = job
        self._history, self._look, self._first, self._final, self._contact = (
            round(seconds * job.rate_hz)
            for seconds in (HISTORY_S, LOOK_S, FIRST_S, FINAL_S, CONTACT_S)
        )
        self._samples: NDArray[np.void] | None = None
        self._waiting: deque[_Waiting] = deque()
        self._free_from = 0
        self._count = 0
        self._over = False

    @property
    def idle(self) -> bool:
        """Whether there is no touch to estimate."""
        return not self._waiting

    def take(self, samples: NDArray[np.void]) -> None:
        """Take the next samples of the record, shape (n,)."""
        kept = self._samples
        self._samples = samples if kept is None else np.concatenate([kept, samples])
        for tick in samples["tick"][(samples["status"] & Status.TOUCHED) != 0].tolist():
            self._count += 1
            estimate = self._estimator.follow()
            self._waiting.append(_Waiting(self._count, tick, self._free_from, estimate))
            self._free_from = tick + self._contact
        self._over |= bool(samples["status"][-1] & Status.TORQUE_OFF)
        if not self._waiting:
            self._samples = self._samples[-self._history :]

    def told(self) -> list[TouchTold]:
        """Return the estimates that can be made by now."""
        if self._samples is None or not self._waiting:
            return []
        touch = self._waiting[0]
        there = int(self._samples["tick"][-1]) - touch.tick + 1
        final = self._over or there >= self._final
        # In real time somebody waits for the first one, even if the record is whole after a look.
        first = self._job.realtime is not None or not final
        if there >= self._first and first and not touch.told:
            touch.told = True
            return [self._told(touch, self._first, final=False)]
        if final:
            self._waiting.popleft()
            return [self._told(touch, self._final, final=True)]
        if there >= self._look and not touch.looked:
            touch.looked = True
            record, _ = self._record(touch, self._look)
            touch.estimate.look(record)
        return []

    def _told(self, touch: _Waiting, after: int, *, final: bool) -> TouchTold:
        record, start_s = self._record(touch, after)
        found = touch.estimate.told(record, scan=False, first=not final)
        document = found.as_dict(start_s)
        return TouchTold(touch.number, touch.tick, final, document)

    def _record(self, touch: _Waiting, after: int) -> tuple[TouchRecord, float]:
        """Return the record with so many ticks from the detection on, and when it begins."""
        assert self._samples is not None
        job = self._job
        # Soon after another touch nothing before this one may be free: then it is told as unknown.
        free_from = min(touch.free_from, touch.tick)
        part = around_touch(self._samples, touch.tick, job.rate_hz, free_from)
        record = touch_record(part, touch.tick, job.rate_hz, job.shear_projection)
        return record.until(record.detected + after), int(part["tick"][0]) / job.rate_hz


if __name__ == "__main__":
    main()
