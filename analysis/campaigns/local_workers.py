"""Workers on this machine: a pool of fresh processes."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

from analysis.campaigns.errors import CampaignError
from analysis.campaigns.workers import Lost, unheard

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from analysis.campaigns.workers import Result

_ONE_THREAD: Final = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


@contextmanager
def process_pool(jobs: int) -> Iterator[LocalWorkers]:
    """Pool of fresh processes, whose linear algebra has one thread each.

    Fresh, because a process with threads (a progress bar is one) cannot be forked safely. They
    ignore Ctrl-C, which is the caller's to handle, and end with the caller however he ends. Work
    that is under way is dropped when the context is left by an exception.
    """
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    workers = LocalWorkers(jobs)
    try:
        yield workers
    except BaseException:
        workers.drop()
        raise
    finally:
        workers.close()
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


class LocalWorkers:
    """See `analysis.campaigns.workers.Workers`.

    A process that ends by itself (killed for lack of memory, mostly) breaks its pool, which does
    not tell by which task. So no more tasks are under way than there are processes, and those are
    tried once more, each in a pool of its own.
    """

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs
        self._others = set(multiprocessing.active_children())
        self._pool = _pool(jobs)

    def run(
        self,
        function: Callable[..., Result],
        arguments: Sequence[tuple[Any, ...]],
        on_done: Callable[[int], None] = unheard,
    ) -> list[Result | Lost]:
        """See `analysis.campaigns.workers.Workers.run`."""
        results: dict[int, Result | Lost] = {}
        waiting = list(reversed(range(len(arguments))))

        def done(number: int, result: Result | Lost) -> None:
            results[number] = result
            on_done(number)

        under_way: dict[Future[Result], int] = {}
        while waiting or under_way:
            suspects = []
            while waiting and len(under_way) < self._jobs:
                number = waiting.pop()
                try:
                    under_way[self._pool.submit(function, *arguments[number])] = number
                except BrokenExecutor:
                    waiting.append(number)
                    if not under_way:  # a process that had nothing to do has ended
                        self._renew(self._jobs)
                    break
            for future in wait(under_way, return_when=FIRST_COMPLETED).done:
                number = under_way.pop(future)
                try:
                    done(number, future.result())
                except BrokenExecutor:
                    suspects.append(number)
            if suspects:
                # The others of a broken pool end as this one did.
                suspects += under_way.values()
                under_way.clear()
                for number in suspects:
                    done(number, self._again(function, arguments[number]))
                if all(isinstance(result, Lost) for result in results.values()):
                    raise CampaignError(
                        "The worker processes ended by themselves, most often for lack of memory: "
                        "use fewer --jobs. A script that calls campaign() must do so under "
                        "if __name__ == '__main__':"
                    )
                self._renew(self._jobs)
        return [results[number] for number in range(len(arguments))]

    def _again(self, function: Callable[..., Result], arguments: tuple[Any, ...]) -> Result | Lost:
        """Try a task alone."""
        self._renew(1)
        try:
            return self._pool.submit(function, *arguments).result()
        except BrokenExecutor:
            return Lost("its worker process ended by itself, twice: most often for lack of memory")

    def _renew(self, jobs: int) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)
        self._pool = _pool(jobs)

    def drop(self) -> None:
        """End the processes at once."""
        self._pool.shutdown(wait=False, cancel_futures=True)
        for worker in set(multiprocessing.active_children()) - self._others:
            worker.terminate()

    def close(self) -> None:
        """End the processes when they have done what is under way."""
        self._pool.shutdown(wait=True, cancel_futures=True)


def _pool(jobs: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(
        jobs, mp_context=multiprocessing.get_context("spawn"), initializer=_begin
    )


def _begin() -> None:
    """Make a worker deaf to Ctrl-C, and mortal with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()

    def follow() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=follow, daemon=True).start()
