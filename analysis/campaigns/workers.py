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
from collections import deque
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, TypeVar

from analysis.campaigns._experiment import CampaignError
from rigd.runtime import SINGLE_THREADED, use_one_thread

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

Result = TypeVar("Result")

_POLL_S: Final = 2.0
"""Interval of checks for the presence of workers."""

_HOPELESS: Final = 2
"""Tasks that end their processes, none being done, from which it is not the tasks' doing."""


@dataclass(frozen=True, slots=True)
class Lost:
    """Result of a task whose worker ended each time it was tried.

    Attributes
    ----------
    reason : str
        End of the worker.
    """

    reason: str


def available_cores() -> int:
    """Cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on Linux
        return os.cpu_count() or 1


def _unheard(_number: int) -> None:
    """Ignore progress."""


class Workers:
    """Processes that run tasks side by side, behind an executor of `concurrent.futures`.

    A process that ends by itself (killed for lack of memory, mostly) takes other tasks with it:
    all that are under way in a pool, or those that wait at the same worker of a cluster. They are
    tried once more, each alone, so that only the one that ends its process is lost.

    Parameters
    ----------
    executor : Executor
        Runs the tasks.
    """

    _died: type[Exception] = BrokenExecutor
    """Exceptions by which the executor reports that a task's process ended."""
    _limit: int | None = None
    """Tasks under way at once: the fewer, the fewer are tried again."""
    _lost: str
    """Reason for a task whose process ended twice."""
    _hopeless: str | None = None
    """Message if that is so for all tasks; None: that for each."""

    def __init__(self, executor: Executor) -> None:
        self._executor = executor

    def run(
        self,
        function: Callable[..., Result],
        arguments: Sequence[tuple[Any, ...]],
        on_done: Callable[[int], None] = _unheard,
    ) -> list[Result | Lost]:
        """Call a function with every tuple of arguments.

        Parameters
        ----------
        function : callable
            Importable, as are its arguments and what it returns.
        arguments : sequence of tuple
        on_done : callable, optional
            Called with the index of each finished task, in order of completion.

        Returns
        -------
        list
            In the order of the arguments.

        Raises
        ------
        CampaignError
            There are no workers any more.
        """
        results: dict[int, Result | Lost] = {}

        def submit(number: int) -> Future[Result]:
            return self._executor.submit(function, *arguments[number])

        def done(number: int, result: Result | Lost) -> None:
            results[number] = result
            on_done(number)

        waiting = deque(range(len(arguments)))
        while waiting:
            with self._explaining():
                suspects = self._try(waiting, submit, done)
                for number in suspects:
                    self._renew(alone=True)
                    if self._try(deque([number]), submit, done):
                        done(number, Lost(self._lost))
            if suspects:
                others = any(not isinstance(result, Lost) for result in results.values())
                if self._hopeless and not others and (len(results) >= _HOPELESS or not waiting):
                    raise CampaignError(self._hopeless)
                self._renew()
        return [results[number] for number in range(len(arguments))]

    def _try(
        self,
        waiting: deque[int],
        submit: Callable[[int], Future[Result]],
        done: Callable[[int, Result], None],
    ) -> list[int]:
        """Run waiting tasks until a worker process dies; return those in progress then."""
        under_way: dict[Future[Result], int] = {}
        suspects: list[int] = []
        seen = time.monotonic()
        while under_way or (waiting and not suspects):
            while waiting and not suspects and len(under_way) != self._limit:
                try:
                    under_way[submit(waiting[0])] = waiting[0]
                except BrokenExecutor:
                    if not under_way:  # a process that had nothing to do has ended
                        self._renew()
                    break
                waiting.popleft()
            for future in wait(under_way, _POLL_S, FIRST_COMPLETED).done:
                number = under_way.pop(future)
                try:
                    result = future.result()
                except self._died:
                    suspects.append(number)
                else:
                    done(number, result)
            seen = self._still_there(seen)
        return suspects

    def _renew(self, *, alone: bool = False) -> None:
        """Start processes instead of those that ended, or one for one task."""

    def _explaining(self) -> AbstractContextManager[None]:
        """Convert other errors from a loss of all workers to `CampaignError`."""
        return nullcontext()

    def _still_there(self, seen: float) -> float:
        """Return when workers were last seen; raise if they have been lost for too long."""
        return seen


@contextmanager
def process_pool(jobs: int) -> Iterator[Workers]:
    """Pool of fresh processes, whose linear algebra has one thread each.

    Fresh, because a process with threads (a progress bar is one) cannot be forked safely. They
    ignore Ctrl-C, which is the caller's to handle, and end with the caller however he ends. Work
    that is under way is dropped when the context is left by an exception.
    """
    before = {name: os.environ.get(name) for name in SINGLE_THREADED}
    use_one_thread()
    others = set(multiprocessing.active_children())
    workers = _LocalWorkers(jobs)
    try:
        yield workers
    except BaseException:
        workers.close(wait=False)
        for worker in set(multiprocessing.active_children()) - others:
            worker.terminate()
        raise
    finally:
        workers.close()
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


class _LocalWorkers(Workers):
    _lost = "its worker process ended by itself twice, most often for lack of memory"
    _hopeless = (
        "The worker processes ended by themselves, most often for lack of memory: use fewer "
        "--jobs. A script that calls campaign() must do so under if __name__ == '__main__':"
    )

    def __init__(self, jobs: int) -> None:
        super().__init__(_pool(jobs))
        self._limit = jobs

    def _renew(self, *, alone: bool = False) -> None:
        self.close()
        self._executor = _pool(1 if alone else self._limit)

    def close(self, *, wait: bool = True) -> None:
        """Start no more tasks, and end the processes after the present ones."""
        self._executor.shutdown(wait, cancel_futures=True)


def _pool(jobs: int | None) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(
        jobs, mp_context=multiprocessing.get_context("spawn"), initializer=_begin
    )


def _begin() -> None:
    """Make a worker ignore Ctrl-C, and end with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()

    def follow() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


_CONNECT_S: Final = 5.0
_WORKERS_S: Final = 10.0
_GONE_S: Final = 30.0
"""How long a cluster may be without any worker: its nannies restart them in seconds."""


@contextmanager
def dask_cluster(address: str) -> Iterator[Workers]:
    """Workers of a Dask cluster.

    They need this package, of the same version, and the session files under the same paths.

    Parameters
    ----------
    address : str
        Address of its scheduler, such as ``tcp://10.0.0.5:8786``.

    Raises
    ------
    CampaignError
        Dask is not installed, no scheduler answers at the address, the cluster has no workers, or
        their versions differ.
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
            yield _DaskWorkers(client, address)
        finally:
            client.close()


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress messages of Dask that are reported here: failures, and different versions."""
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
    """Raise an OSError if no scheduler listens; Dask's client would retry even after failing."""
    name = address.rsplit("://", maxsplit=1)[-1]
    if "://" in address and not address.startswith(("tcp://", "tls://")):
        return
    host, _, port = name.rpartition(":")
    if not (host and port.isdecimal()):
        raise ValueError("no host and port")
    socket.create_connection((host.strip("[]"), int(port)), _CONNECT_S).close()


class _DaskWorkers(Workers):
    """The scheduler tries a task whose worker ended at others, and gives it up after several."""

    _lost = (
        "every Dask worker that ran it ended by itself, most often for lack of memory; see the "
        "workers' logs"
    )

    def __init__(self, client: Any, address: str) -> None:  # noqa: ANN401 - Dask has no types
        # Each call counts, though arguments may be the same.
        super().__init__(client.get_executor(pure=False))
        self._client, self._address = client, address
        self._died = _distributed().KilledWorker

    @contextmanager
    def _explaining(self) -> Iterator[None]:
        try:
            yield
        except CampaignError:
            raise
        except Exception as error:  # Dask has many for a scheduler that went away
            expected = isinstance(error, CancelledError | _distributed().comm.CommClosedError)
            if self._client.status == "running" and not expected:
                raise
            raise CampaignError(self._gone("went away")) from error

    def _still_there(self, seen: float) -> float:
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
            f"The Dask scheduler at {self._address} {what}; check its log and the workers', and "
            "start the campaign again, or leave --dask out."
        )


def _distributed() -> Any:  # noqa: ANN401 - Dask has no types
    return import_module("distributed")


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
