"""``rigd recover``: what is intact of a torn session file, as a sound one."""

import contextlib
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from rigd.cli.exits import EXIT_FAILED
from rigd.cli.options import AsJson

_QUIET_S = 2.0
"""A recovery that takes no longer than this shows no progress."""


def recover(
    paths: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...", readable=False, help="Torn .mcap.part or damaged .mcap files."
        ),
    ],
    as_json: AsJson = False,
) -> None:
    """Save what is intact of torn or damaged session files.

    Writes X.mcap beside X.mcap.part, and X.recovered.mcap beside a damaged X.mcap: every sample up
    to the damage, marked as recovered. Nothing is overwritten or removed.

    Example: rigd recover sessions/20261120-101500-chirp.mcap.part
    """
    from rigd.session import SessionError
    from rigd.session import recover as recover_file

    documents: list[dict[str, Any]] = []
    failed = False
    for path in paths:
        try:
            with _progress(path) as on_progress:
                recovery = recover_file(path, on_progress)
        except SessionError as error:
            failed = True
            typer.echo(f"Error: {error}", err=True)
            documents.append({"source": str(path), "path": None, "error": str(error)})
        else:
            documents.append(recovery.as_dict())
            if not as_json:
                typer.echo("\n".join(recovery.lines()))
    if as_json:
        typer.echo(json.dumps({"files": documents}))
    if failed:
        raise typer.Exit(EXIT_FAILED)


@contextlib.contextmanager
def _progress(path: Path) -> Iterator[Callable[[float], None]]:
    """Show a line with the time left as soon as the work has taken `_QUIET_S`."""
    started = time.monotonic()
    with contextlib.ExitStack() as stack:
        show: Callable[[float], None] | None = None

        def on_progress(share: float) -> None:
            nonlocal show
            if show is None and time.monotonic() - started > _QUIET_S:
                show = stack.enter_context(_bar(path.name))
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
