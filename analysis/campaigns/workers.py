"""Sessions in parallel, wherever the workers are, and what becomes of one whose worker ends."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

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
