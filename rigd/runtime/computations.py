"""Computations in a copy of this process, which has all of its objects and imports."""

import copyreg
import os
import pickle
import signal
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from types import MappingProxyType
from typing import Any, Generic, Self, TypeVar

ValueT = TypeVar("ValueT")
"""Type of the value that is computed."""


class ComputationError(Exception):
    """Raised if the copy of the process has ended without a value."""


def _read_only_mapping(items: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    """Return a read-only mapping; a pickle refers to this function, as it cannot to the type."""
    return MappingProxyType(items)


class ValuePickler(pickle.Pickler):
    """Pickler that can also pickle read-only mappings."""

    dispatch_table = copyreg.dispatch_table | {
        MappingProxyType: lambda mapping: (_read_only_mapping, (dict(mapping),))
    }


class ForkedComputation(Generic[ValueT]):
    """Computation that has been started in a copy of this process (fork).

    A copy is used because a thread would block the interpreter. Of the threads, the copy has only
    the one that creates it. As a context manager, this object kills the copy if it is still
    computing at the end of the context.

    Parameters
    ----------
    compute
        Function that returns the value, which can be pickled.
    """

    def __init__(self, compute: Callable[[], ValueT]) -> None:
        import tempfile  # imported late, because few sessions need it

        self._value_file = tempfile.TemporaryFile()  # noqa: SIM115 - closed when it was read
        with warnings.catch_warnings():
            # Of threads, such as that of a progress bar, which the copy does not have.
            warnings.simplefilter("ignore", DeprecationWarning)
            self._process_id = os.fork()
        if self._process_id == 0:
            has_failed = True
            with suppress(BaseException):
                ValuePickler(self._value_file, protocol=5).dump(compute())
                self._value_file.flush()
                has_failed = False
            os._exit(has_failed)
        self._exit_status: int | None = None

    def has_ended(self) -> bool:
        """Return whether the copy has ended, without waiting for it."""
        return self._wait(os.WNOHANG)

    def value(self) -> ValueT:
        """Wait for the end of the computation, and return its value; can be called once only.

        Raises
        ------
        ComputationError
            If the copy has failed.
        """
        self._wait()
        with self._value_file:
            if self._exit_status != 0:
                raise ComputationError
            self._value_file.seek(0)
            computed_value: ValueT = pickle.load(self._value_file)
        return computed_value

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._exit_status is None:
            os.kill(self._process_id, signal.SIGKILL)
            self._wait()
        self._value_file.close()

    def _wait(self, wait_options: int = 0) -> bool:
        """Call `os.waitpid` with `wait_options` for the copy, and return whether it has ended."""
        if self._exit_status is None:
            process_id, exit_status = os.waitpid(self._process_id, wait_options)
            if process_id:
                self._exit_status = exit_status
        return self._exit_status is not None


@contextmanager
def computed_in_parallel(compute: Callable[[], ValueT]) -> Iterator[Callable[[], ValueT]]:
    """Compute a value in a copy of this process, if this computer has two processors for it.

    If not, or if the copy fails, this process computes the value when the caller requests it. An
    error of the computation is raised by that request.

    Parameters
    ----------
    compute
        Function that returns the value, which can be pickled.

    Yields
    ------
    callable
        Function that returns the value, and waits for it if necessary.
    """
    if not _may_use_two_processors():
        yield cache(compute)
        return
    with ForkedComputation(compute) as copy:

        @cache
        def value() -> ValueT:
            try:
                return copy.value()
            except ComputationError:
                return compute()

        yield value


def _may_use_two_processors() -> bool:
    """Return whether a copy of this process would have a processor of its own."""
    # Not on macOS, whose libraries cannot be used in a copy of a process.
    return hasattr(os, "sched_getaffinity") and len(os.sched_getaffinity(0)) > 1
