"""Sessions in parallel: one pool of processes on this machine, or a Dask cluster."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final, TypeVar

from analysis.campaigns.errors import CampaignError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

Result = TypeVar("Result")

_ONE_THREAD: Final = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
_CONNECT_S: Final = 10.0


def available_cores() -> int:
    """Cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on Linux
        return os.cpu_count() or 1


@contextmanager
def process_pool(jobs: int) -> Iterator[Executor]:
    """Pool of fresh processes, whose linear algebra has one thread each.

    Fresh, because a process with threads (a progress bar is one) cannot be forked safely. They
    ignore Ctrl-C, which is the caller's to handle, and end with the caller however he ends. Work
    that is under way is dropped when the context is left by an exception.
    """
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    pool = ProcessPoolExecutor(
        jobs, mp_context=multiprocessing.get_context("spawn"), initializer=_begin
    )
    others = set(multiprocessing.active_children())
    try:
        yield pool
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for worker in set(multiprocessing.active_children()) - others:
            worker.terminate()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextmanager
def dask_cluster(address: str) -> Iterator[Executor]:
    """Workers of a Dask cluster that runs already, as an executor.

    They need this package, of the same version, and the session files under the same paths.

    Parameters
    ----------
    address : str
        Of its scheduler, such as ``tcp://10.0.0.5:8786``.

    Raises
    ------
    CampaignError
        Dask is not installed, or nobody answers at the address.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise CampaignError(
            "--dask needs the optional packages: pip install 'rigd[dask]'."
        ) from error
    try:
        client: Any = Client(address, timeout=_CONNECT_S)
    except (OSError, ValueError) as error:
        raise CampaignError(
            f"No Dask scheduler answers at {address} within {_CONNECT_S:g} s; start one with "
            "'dask scheduler' and its workers with 'dask worker ADDRESS', or leave --dask out."
        ) from error
    try:
        yield client.get_executor(pure=False)
    finally:
        client.close()


def run_all(
    executor: Executor,
    function: Callable[..., Result],
    arguments: Sequence[tuple[Any, ...]],
    on_done: Callable[[int], None] = lambda _number: None,
) -> list[Result]:
    """Call a function with every tuple of arguments, in parallel.

    Parameters
    ----------
    executor : Executor
    function : callable
        Importable, as are its arguments and what it returns.
    arguments : sequence of tuple
    on_done : callable, optional
        Called with the place of each that is done, as they come.

    Returns
    -------
    list
        In the order of the arguments.

    Raises
    ------
    CampaignError
        A worker ended by itself.
    """
    try:
        futures = {executor.submit(function, *each): i for i, each in enumerate(arguments)}
        results: dict[int, Result] = {}
        for future in as_completed(futures):
            number = futures.pop(future)
            results[number] = future.result()
            on_done(number)
    except BrokenExecutor as error:
        raise CampaignError(
            "A worker process ended by itself, most often for lack of memory: use fewer --jobs. "
            "A script that calls campaign() must do so under if __name__ == '__main__':"
        ) from error
    return [results[number] for number in range(len(arguments))]


def _begin() -> None:
    """Make a worker deaf to Ctrl-C, and mortal with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()

    def follow() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=follow, daemon=True).start()
