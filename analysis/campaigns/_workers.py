"""Sessions analysed in parallel: a pool of fresh processes on this machine, or a Dask cluster."""

from __future__ import annotations

import logging
import multiprocessing
import os
import platform
import signal
import socket
import threading
import time
import warnings
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, Protocol, TypeVar

from analysis.campaigns._experiment import CampaignError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class Lost:
    """In the place of a result: what became of the worker, each time the task was tried."""

    reason: str


class Workers(Protocol):
    """Processes that run tasks side by side."""

    def run(
        self,
        function: Callable[..., Result],
        arguments: Sequence[tuple[object, ...]],
        on_done: Callable[[int], None] = ...,
    ) -> list[Result | Lost]:
        """Call a function with every tuple of arguments.

        Parameters
        ----------
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
            There are no workers any more.
        """
        ...


def available_cores() -> int:
    """Cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on Linux
        return os.cpu_count() or 1


def unheard(_number: int) -> None:
    """Do without progress."""


# Processes of this machine

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
    """See `analysis.campaigns._workers.Workers`.

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
        """See `analysis.campaigns._workers.Workers.run`."""
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


# Dask cluster

_CONNECT_S: Final = 5.0
_WORKERS_S: Final = 10.0
_LOOK_S: Final = 2.0
_GONE_S: Final = 30.0
"""How long a cluster may be without any worker: its nannies start them anew in seconds."""


@contextmanager
def dask_cluster(address: str) -> Iterator[DaskWorkers]:
    """Workers of a Dask cluster.

    They need this package, of the same version, and the session files under the same paths.

    Parameters
    ----------
    address : str
        Address of the scheduler, such as ``tcp://10.0.0.5:8786``.

    Raises
    ------
    CampaignError
        Dask is not installed, nobody answers at the address, the cluster has no workers, or they
        are not of these versions.
    """
    try:
        distributed = _distributed()
    except ImportError as error:
        raise CampaignError(
            "--dask needs the optional packages: pip install 'rigd[dask]'."
        ) from error
    with _quiet():
        try:
            _knock(address)
            client = distributed.Client(address, timeout=_CONNECT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise CampaignError(
                f"No Dask scheduler answers at {address} within {_CONNECT_S:g} s; start one with "
                "'dask scheduler' and its workers with 'dask worker ADDRESS', or leave --dask out."
            ) from error
        try:
            _check_workers(client, address)
            with client.as_current():
                yield DaskWorkers(client, address)
        finally:
            client.close()


class DaskWorkers:
    """See `analysis.campaigns._workers.Workers`."""

    def __init__(self, client: Any, address: str) -> None:  # noqa: ANN401 - Dask has no types
        self._client, self._address = client, address

    def run(
        self,
        function: Callable[..., Result],
        arguments: Sequence[tuple[Any, ...]],
        on_done: Callable[[int], None] = unheard,
    ) -> list[Result | Lost]:
        """See `analysis.campaigns._workers.Workers.run`.

        The scheduler gives a task whose worker ended to another one, and gives it up when it has
        lost several so; with it those that happened to wait at the same workers. So what it gives
        up is tried once more, each task by itself.
        """
        results: dict[int, Result | Lost] = {}

        def done(number: int, result: Result) -> None:
            results[number] = result
            on_done(number)

        for number in self._round(function, dict(enumerate(arguments)), done):
            if self._round(function, {number: arguments[number]}, done):
                results[number] = Lost(
                    "every Dask worker that had it ended by itself: most often for lack of memory; "
                    "see the workers' logs"
                )
                on_done(number)
        return [results[number] for number in range(len(arguments))]

    def _round(
        self,
        function: Callable[..., Result],
        arguments: Mapping[int, tuple[Any, ...]],
        done: Callable[[int, Result], None],
    ) -> list[int]:
        """Run tasks and tell what they return; return the numbers of those that were given up."""
        # Each call counts, though arguments may be the same.
        with self._there():
            futures = {
                self._client.submit(function, *each, pure=False): i for i, each in arguments.items()
            }
        given_up = []
        seen = time.monotonic()
        while futures:
            finished, seen = self._finished(list(futures), seen)
            for future in finished:
                number = futures.pop(future)
                try:
                    with self._there():
                        result = future.result()
                except _distributed().KilledWorker:
                    given_up.append(number)
                else:
                    done(number, result)
        return given_up

    def _finished(self, futures: Sequence[Any], seen: float) -> tuple[set[Any], float]:
        """Wait for some, but not for long; return them, and when workers were last seen."""
        with self._there():
            try:
                done = _distributed().wait(futures, _LOOK_S, return_when="FIRST_COMPLETED").done
            except TimeoutError:
                done = set()
            return done, self._still_there(seen)

    @contextmanager
    def _there(self) -> Iterator[None]:
        """Tell in a sentence that the scheduler went away, which Dask does in many ways."""
        try:
            yield
        except (CancelledError, _distributed().comm.CommClosedError) as error:
            raise CampaignError(self._gone("went away")) from error
        except Exception as error:
            if self._client.status == "running" or isinstance(error, CampaignError):
                raise
            raise CampaignError(self._gone("went away")) from error

    def _still_there(self, seen: float) -> float:
        """Return when workers were last seen; raise if that is too long ago."""
        now = time.monotonic()
        if self._client.status != "running":
            raise CampaignError(self._gone("went away"))
        if self._client.scheduler_info(n_workers=-1)["workers"]:
            return now
        if now - seen > _GONE_S:
            raise CampaignError(self._gone(f"has had no workers for {_GONE_S:g} s"))
        return seen

    def _gone(self, what: str) -> str:
        return (
            f"The Dask scheduler at {self._address} {what}; look at its log and the workers', and "
            "start the campaign again, or leave --dask out."
        )


def versions() -> dict[str, str]:
    """Versions on which results depend, and whether objects can be passed on."""
    import numpy as np

    import rigd

    python = ".".join(platform.python_version_tuple()[:2])
    return {
        "rigd": rigd.__version__, "Python": python, "numpy": np.__version__,
        "distributed": _distributed().__version__,
    }  # fmt: skip


def _check_workers(client: Any, address: str) -> None:  # noqa: ANN401 - Dask has no types
    """Raise if there are no workers, or one that lacks this package or has other versions."""
    try:
        client.wait_for_workers(1, timeout=_WORKERS_S)
    except TimeoutError as error:
        raise CampaignError(
            f"The Dask scheduler at {address} has no workers; start some with "
            f"'dask worker {address} --nthreads 1'."
        ) from error
    found: Mapping[str, dict[str, str] | Exception] = client.run(versions, on_error="return")
    here = versions()
    for worker, there in found.items():
        if isinstance(there, ModuleNotFoundError):
            raise CampaignError(
                f"The Dask worker at {worker} has no module {there.name}: install rigd "
                f"{here['rigd']} with its extra 'dask' there, and start it again."
            )
        if isinstance(there, Exception):
            raise CampaignError(f"The Dask worker at {worker} cannot be used: {there}.")
        other = [f"{name} {there[name]} and not {here[name]}" for name in here
                 if there[name] != here[name]]  # fmt: skip
        if other:
            raise CampaignError(
                f"The Dask worker at {worker} has {', '.join(other)}: install the versions of this "
                "machine there, and start it again."
            )


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep from Dask what is told here in a sentence: what goes wrong, and versions that differ."""
    log = logging.getLogger("distributed.client")
    level = log.level
    log.setLevel(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="(?s).*Mismatched versions")
            yield
    finally:
        log.setLevel(level)


def _knock(address: str) -> None:
    """Raise an OSError if nobody listens; Dask's client would go on trying after it has failed."""
    name = address.rsplit("://", maxsplit=1)[-1]
    if "://" in address and not address.startswith(("tcp://", "tls://")):
        return
    host, _, port = name.rpartition(":")
    if not (host and port.isdecimal()):
        raise ValueError("no host and port")
    socket.create_connection((host.strip("[]"), int(port)), _CONNECT_S).close()


def _distributed() -> Any:  # noqa: ANN401 - Dask has no types
    return import_module("distributed")
