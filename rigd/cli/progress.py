"""Progress of a command that may take long, with the time left."""

import contextlib
import time
from collections.abc import Callable, Iterator

_QUIET_S = 2.0
"""What takes no longer than this shows no progress."""


@contextlib.contextmanager
def progress(name: str) -> Iterator[Callable[[float], None]]:
    """Give a function that is told the share that is done.

    A line appears as soon as the work has taken `_QUIET_S`, on a terminal only.
    """
    started = time.monotonic()
    with contextlib.ExitStack() as stack:
        show: Callable[[float], None] | None = None

        def on_progress(share: float) -> None:
            nonlocal show
            if show is None and time.monotonic() - started > _QUIET_S:
                show = stack.enter_context(_bar(name))
            if show is not None:
                show(share)

        yield on_progress


@contextlib.contextmanager
def _bar(name: str) -> Iterator[Callable[[float], None]]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    with Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    ) as bar:
        task = bar.add_task(name, total=1.0)
        yield lambda share: bar.update(task, completed=share)
