"""The touch process: from the samples around a detected touch to where and how hard it was.

It watches the ring of samples as the live publisher does, so that it can neither delay the loop nor
take a sample from the recorder, and looks for the bit by which the loop marks a detection. It
answers as soon as there are 50 ms of data after it, and again when there is more.
"""

import time
from collections import deque

import numpy as np
from numpy.typing import NDArray

from rigd.engine._ipc import Parent
from rigd.engine._messages import TouchJob, TouchReady, TouchTold
from rigd.engine._realtime import keep_off_loop
from rigd.engine._ring import Observer
from rigd.engine._shared_state import Word
from rigd.engine._topics import attach_channels
from rigd.runtime import ignore as ignore_signals
from rigd.session import Status, decode_samples
from rigd.touch import (
    CONTACT_S,
    FINAL_S,
    FIRST_S,
    HISTORY_S,
    TouchEstimator,
    around_touch,
    touch_record,
)

_BLOCK = 250
_IDLE_S = 0.005


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
            time.sleep(_IDLE_S)
        for told in touches.told():
            parent.send(told)
        try:
            if parent.poll(0.0) is not None:
                return
        except EOFError:
            return


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
        self._history = round(HISTORY_S * job.rate_hz)
        self._first, self._final = (round(s * job.rate_hz) for s in (FIRST_S, FINAL_S))
        self._samples: NDArray[np.void] | None = None
        self._waiting: deque[tuple[int, int, int]] = deque()
        """Number and tick of the touches whose last estimate is to come, and the tick from which
        the beam was free before."""
        self._contact = round(CONTACT_S * job.rate_hz)
        self._free_from = 0
        self._told_of = 0
        self._count = 0
        self._over = False

    def take(self, samples: NDArray[np.void]) -> None:
        """Take the next samples of the record, shape (n,)."""
        kept = self._samples
        self._samples = samples if kept is None else np.concatenate([kept, samples])
        for tick in samples["tick"][(samples["status"] & Status.TOUCHED) != 0].tolist():
            self._count += 1
            self._waiting.append((self._count, tick, self._free_from))
            self._free_from = tick + self._contact
        self._over |= bool(samples["status"][-1] & Status.TORQUE_OFF)
        if not self._waiting:
            self._samples = self._samples[-self._history :]

    def told(self) -> list[TouchTold]:
        """Return the estimates that can be made by now."""
        if self._samples is None or not self._waiting:
            return []
        number, tick, free_from = self._waiting[0]
        there = int(self._samples["tick"][-1]) - tick
        final = self._over or there >= self._final
        if final:
            self._waiting.popleft()
        elif self._told_of >= number or there < self._first:
            return []
        self._told_of = number
        return [self._estimated(number, tick, free_from, final=final)]

    def _estimated(self, number: int, tick: int, free_from: int, *, final: bool) -> TouchTold:
        assert self._samples is not None
        job = self._job
        part = around_touch(self._samples, tick, job.rate_hz, free_from)
        record = touch_record(part, tick, job.rate_hz, job.shear_projection)
        began_s = time.monotonic()
        told = self._estimator.estimate(record, scan=False)
        document = told.as_dict(int(part["tick"][0]) / job.rate_hz)
        return TouchTold(number, tick, final, document, time.monotonic() - began_s)


if __name__ == "__main__":
    main()
