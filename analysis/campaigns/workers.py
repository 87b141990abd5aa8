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
from rigd.runtime.background import SINGLE_THREADED, use_one_thread

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

TaskResult = TypeVar("TaskResult")
"""Type of a task's result."""

_PRESENCE_CHECK_INTERVAL_S: Final = 2.0
"""Interval in seconds at which the presence of worker processes is checked."""

_MIN_FAILED_TASKS: Final = 2
"""Number of lost tasks at which, if none has finished, the workers and not the tasks are at fault.
"""


@dataclass(frozen=True, slots=True)
class FailedTask:
    """Result of a task whose worker process ended each time it ran the task.

    Attributes
    ----------
    reason : str
        Why the worker process ended.
    """

    reason: str


def available_cores() -> int:
    """Return the number of processor cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on Linux
        return os.cpu_count() or 1


def _ignore_progress(_task_index: int) -> None:
    """Ignore the number of a finished task."""


class Workers:
    """Processes that run tasks in parallel, behind an executor of `concurrent.futures`.

    A worker process that ends by itself (mostly killed for lack of memory) takes other tasks with
    it: all tasks in progress of a pool, or those that wait at the same worker of a cluster. Each of
    these tasks runs once more, alone, so that only the task that ends its process is lost.

    Parameters
    ----------
    executor : Executor
        Executor that runs the tasks.
    """

    _process_end_error: type[Exception] = BrokenExecutor
    """Exception by which the executor reports that the process of a task ended."""
    _max_tasks_in_progress: int | None = None
    """Largest number of tasks in progress at once, all of which may have to run again if a process
    ends; None for no limit."""
    _failed_task_reason: str
    """Reason reported for a task whose process ended twice."""
    _no_workers_message: str | None = None
    """Message of the error raised if all tasks are lost; None to report each task separately."""

    def __init__(self, executor: Executor) -> None:
        self._executor = executor

    def run(
        self,
        function: Callable[..., TaskResult],
        argument_tuples: Sequence[tuple[Any, ...]],
        on_done: Callable[[int], None] = _ignore_progress,
    ) -> list[TaskResult | FailedTask]:
        """Call a function with every tuple of arguments, in parallel.

        Parameters
        ----------
        function : callable
            Function that worker processes can import; arguments and result must be picklable.
        argument_tuples : sequence of tuple
            Arguments of each call.
        on_done : callable, optional
            Called with the index of each finished task, in order of completion.

        Returns
        -------
        list
            Results in the order of the arguments; `FailedTask` if a task's process ended each time.

        Raises
        ------
        CampaignError
            All workers are lost.
        """
        task_results: dict[int, TaskResult | FailedTask] = {}

        def submit_task(task_index: int) -> Future[TaskResult]:
            """Start a task by its index."""
            return self._executor.submit(function, *argument_tuples[task_index])

        def store_result(task_index: int, task_result: TaskResult | FailedTask) -> None:
            """Store the result of a task and report its completion."""
            task_results[task_index] = task_result
            on_done(task_index)

        task_queue = deque(range(len(argument_tuples)))
        while task_queue:
            with self._convert_executor_errors():
                interrupted_tasks = self._run_until_process_ends(
                    task_queue, submit_task, store_result
                )
                for task_index in interrupted_tasks:
                    self._replace_executor(is_single_process=True)
                    if self._run_until_process_ends(deque([task_index]), submit_task, store_result):
                        store_result(task_index, FailedTask(self._failed_task_reason))
            if interrupted_tasks:
                is_any_task_finished = any(
                    not isinstance(task_result, FailedTask) for task_result in task_results.values()
                )
                if (
                    self._no_workers_message
                    and not is_any_task_finished
                    and (len(task_results) >= _MIN_FAILED_TASKS or not task_queue)
                ):
                    raise CampaignError(self._no_workers_message)
                self._replace_executor()
        return [task_results[task_index] for task_index in range(len(argument_tuples))]

    def _run_until_process_ends(
        self,
        task_queue: deque[int],
        submit_task: Callable[[int], Future[TaskResult]],
        store_result: Callable[[int, TaskResult], None],
    ) -> list[int]:
        """Run queued tasks until a worker process ends.

        Return the indices of the tasks that the end of the process interrupted; the list is empty
        if all tasks finished.
        """
        task_index_by_future: dict[Future[TaskResult], int] = {}
        interrupted_tasks: list[int] = []
        workers_last_seen_s = time.monotonic()
        while task_index_by_future or (task_queue and not interrupted_tasks):
            while (
                task_queue
                and not interrupted_tasks
                and len(task_index_by_future) != self._max_tasks_in_progress
            ):
                try:
                    task_index_by_future[submit_task(task_queue[0])] = task_queue[0]
                except BrokenExecutor:
                    if not task_index_by_future:  # an idle process has ended
                        self._replace_executor()
                    break
                task_queue.popleft()
            for future in wait(
                task_index_by_future, _PRESENCE_CHECK_INTERVAL_S, FIRST_COMPLETED
            ).done:
                task_index = task_index_by_future.pop(future)
                try:
                    task_result = future.result()
                except self._process_end_error:
                    interrupted_tasks.append(task_index)
                else:
                    store_result(task_index, task_result)
            workers_last_seen_s = self._check_presence(workers_last_seen_s)
        return interrupted_tasks

    def _replace_executor(self, *, is_single_process: bool = False) -> None:
        """Replace the executor after a worker process ended.

        `is_single_process` states that the new executor shall have a single process.
        """

    def _convert_executor_errors(self) -> AbstractContextManager[None]:
        """Convert an executor's own errors on the loss of all workers to `CampaignError`."""
        return nullcontext()

    def _check_presence(self, workers_last_seen_s: float) -> float:
        """Return the time in s at which workers were last present.

        The time is that of `time.monotonic`. Raise `CampaignError` if there have been no workers
        for too long.
        """
        return workers_last_seen_s


@contextmanager
def process_pool(jobs: int) -> Iterator[Workers]:
    """Provide a pool of fresh processes, each with single-threaded linear algebra.

    The processes are fresh because a process with threads (a progress bar is one) cannot be forked
    safely. They ignore Ctrl-C, which the caller handles, and end together with the caller. Tasks in
    progress are abandoned when an exception leaves the context.
    """
    saved_environment = {
        variable_name: os.environ.get(variable_name) for variable_name in SINGLE_THREADED
    }
    use_one_thread()
    other_processes = set(multiprocessing.active_children())
    workers = _LocalWorkers(jobs)
    try:
        yield workers
    except BaseException:
        workers.close(wait=False)
        for worker in set(multiprocessing.active_children()) - other_processes:
            worker.terminate()
        raise
    finally:
        workers.close()
        for variable_name, saved_value in saved_environment.items():
            if saved_value is None:
                os.environ.pop(variable_name, None)
            else:
                os.environ[variable_name] = saved_value


class _LocalWorkers(Workers):
    """Worker processes of a pool on this machine."""

    _failed_task_reason = "its worker process ended by itself twice, most often for lack of memory"
    _no_workers_message = (
        "The worker processes ended by themselves, most often for lack of memory: use fewer "
        "--jobs. A script that calls campaign() must do so under if __name__ == '__main__':"
    )

    def __init__(self, jobs: int) -> None:
        super().__init__(_spawn_pool(jobs))
        self._max_tasks_in_progress = jobs

    def _replace_executor(self, *, is_single_process: bool = False) -> None:
        """Start a new pool after a worker process ended, of one process if `is_single_process`."""
        self.close()
        self._executor = _spawn_pool(1 if is_single_process else self._max_tasks_in_progress)

    def close(self, *, wait: bool = True) -> None:
        """Start no more tasks, and end the processes after their present tasks."""
        self._executor.shutdown(wait, cancel_futures=True)


def _spawn_pool(jobs: int | None) -> ProcessPoolExecutor:
    """Return a pool of processes that are started afresh, not forked."""
    return ProcessPoolExecutor(
        jobs, mp_context=multiprocessing.get_context("spawn"), initializer=_initialize_worker
    )


def _initialize_worker() -> None:
    """Make a worker process ignore Ctrl-C and end together with its parent process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent_process = multiprocessing.parent_process()

    def end_with_parent() -> None:
        """End this process when its parent process ends."""
        if parent_process is not None:
            parent_process.join()
            os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


_CONNECTION_TIMEOUT_S: Final = 5.0
"""Longest wait in seconds for a connection to the Dask scheduler."""
_FIRST_WORKER_TIMEOUT_S: Final = 10.0
"""Longest wait in seconds for the first worker of a Dask cluster."""
_NO_WORKERS_TIMEOUT_S: Final = 30.0
"""Longest time in seconds without any Dask worker; a cluster restarts its workers within
seconds."""


@contextmanager
def dask_cluster(scheduler_address: str) -> Iterator[Workers]:
    """Provide the workers of a Dask cluster.

    The workers need the same version of this package, and the session files under the same paths.

    Parameters
    ----------
    scheduler_address : str
        Address of its scheduler, such as ``tcp://10.0.0.5:8786``.

    Raises
    ------
    CampaignError
        Dask is not installed, no scheduler answers at the address, the cluster has no workers, or
        their versions differ.
    """
    try:
        distributed = _import_distributed()
    except ImportError as error:
        raise CampaignError(
            "--dask needs the optional packages: pip install 'rigd[dask]'."
        ) from error
    with _suppress_dask_messages():
        try:
            _check_scheduler(scheduler_address)
            dask_client = distributed.Client(
                scheduler_address, timeout=_CONNECTION_TIMEOUT_S, set_as_default=False
            )
        except (OSError, ValueError) as error:
            raise CampaignError(
                f"No Dask scheduler answers at {scheduler_address} within "
                f"{_CONNECTION_TIMEOUT_S:g} s; start one with 'dask scheduler' and its workers "
                "with 'dask worker ADDRESS', or leave --dask out."
            ) from error
        try:
            _check_workers(dask_client, scheduler_address)
            yield _DaskWorkers(dask_client, scheduler_address)
        finally:
            dask_client.close()


@contextmanager
def _suppress_dask_messages() -> Iterator[None]:
    """Suppress Dask's messages on failures and different versions, as this module reports them."""
    dask_logger = logging.getLogger("distributed.client")
    log_level = dask_logger.level
    dask_logger.setLevel(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="(?s).*Mismatched versions")
            yield
    finally:
        dask_logger.setLevel(log_level)


def _check_scheduler(scheduler_address: str) -> None:
    """Raise an OSError if no scheduler listens at an address.

    Dask's client would keep trying to connect even after it has reported its failure.
    """
    host_and_port = scheduler_address.rsplit("://", maxsplit=1)[-1]
    if "://" in scheduler_address and not scheduler_address.startswith(("tcp://", "tls://")):
        return
    host, _, port = host_and_port.rpartition(":")
    if not (host and port.isdecimal()):
        raise ValueError("no host and port")
    socket.create_connection((host.strip("[]"), int(port)), _CONNECTION_TIMEOUT_S).close()


class _DaskWorkers(Workers):
    """Workers of a Dask cluster.

    The scheduler repeats a task at another worker if its worker ended, and drops the task after
    several workers ended.
    """

    _failed_task_reason = (
        "every Dask worker that ran it ended by itself, most often for lack of memory; see the "
        "workers' logs"
    )

    def __init__(self, client: Any, scheduler_address: str) -> None:  # noqa: ANN401 - Dask has no types
        # With pure=False, Dask also repeats a call with the same arguments.
        super().__init__(client.get_executor(pure=False))
        self._client, self._address = client, scheduler_address
        self._process_end_error = _import_distributed().KilledWorker

    @contextmanager
    def _convert_executor_errors(self) -> Iterator[None]:
        """Convert errors that mean the loss of the scheduler to `CampaignError`."""
        try:
            yield
        except CampaignError:
            raise
        except Exception as error:  # Dask raises many types if a scheduler is lost
            is_expected = isinstance(
                error, CancelledError | _import_distributed().comm.CommClosedError
            )
            if self._client.status == "running" and not is_expected:
                raise
            raise CampaignError(self._cluster_lost_message("went away")) from error

    def _check_presence(self, workers_last_seen_s: float) -> float:
        """Return the time in s (`time.monotonic`) at which workers were last present.

        Raise `CampaignError` if the scheduler is lost, or if there have been no workers for too
        long.
        """
        now_s = time.monotonic()
        if self._client.status != "running":
            raise CampaignError(self._cluster_lost_message("went away"))
        if self._client.scheduler_info(n_workers=-1)["workers"]:
            return now_s
        if now_s - workers_last_seen_s > _NO_WORKERS_TIMEOUT_S:
            raise CampaignError(
                self._cluster_lost_message(f"has had no workers for {_NO_WORKERS_TIMEOUT_S:g} s")
            )
        return workers_last_seen_s

    def _cluster_lost_message(self, loss_phrase: str) -> str:
        """Return the message of an error that concerns the whole cluster."""
        return (
            f"The Dask scheduler at {self._address} {loss_phrase}; check its log and the workers', "
            "and start the campaign again, or leave --dask out."
        )


def _import_distributed() -> Any:  # noqa: ANN401 - Dask has no types
    """Return Dask's package `distributed`."""
    return import_module("distributed")


def package_versions() -> dict[str, str]:
    """Return the versions of the packages that must agree between this process and the workers."""
    import numpy as np

    import rigd

    python_version = ".".join(platform.python_version_tuple()[:2])
    return {
        "rigd": rigd.__version__, "Python": python_version, "numpy": np.__version__,
        "distributed": _import_distributed().__version__,
    }  # fmt: skip


def _check_workers(client: Any, scheduler_address: str) -> None:  # noqa: ANN401 - Dask has no types
    """Raise if a cluster has no workers, or a worker lacks the versions installed here."""
    try:
        client.wait_for_workers(1, timeout=_FIRST_WORKER_TIMEOUT_S)
    except TimeoutError as error:
        raise CampaignError(
            f"The Dask scheduler at {scheduler_address} has no workers; start some with "
            f"'dask worker {scheduler_address} --nthreads 1'."
        ) from error
    versions_by_worker: Mapping[str, dict[str, str] | Exception] = client.run(
        package_versions, on_error="return"
    )
    own_versions = package_versions()
    for worker, worker_versions in versions_by_worker.items():
        if isinstance(worker_versions, ModuleNotFoundError):
            raise CampaignError(
                f"The Dask worker at {worker} has no module {worker_versions.name}: install rigd "
                f"{own_versions['rigd']} with its extra 'dask' there, and start it again."
            )
        if isinstance(worker_versions, Exception):
            raise CampaignError(f"The Dask worker at {worker} cannot be used: {worker_versions}.")
        version_differences = [f"{name} {worker_versions[name]} and not {own_versions[name]}"
                       for name in own_versions
                       if worker_versions[name] != own_versions[name]]  # fmt: skip
        if version_differences:
            raise CampaignError(
                f"The Dask worker at {worker} has {', '.join(version_differences)}: install the "
                "versions of this machine there, and start it again."
            )
