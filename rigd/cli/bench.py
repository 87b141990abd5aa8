"""``rigd bench``: how punctual the loop is on this computer."""

import contextlib
import json
import os
import signal
from typing import TYPE_CHECKING, Annotated

import typer

from rigd.cli.exits import EXIT_FAILED, fail
from rigd.cli.options import AsJson, ProfileName, profile_named
from rigd.interruption import raise_on

if TYPE_CHECKING:
    from rigd.bench import Results
    from rigd.profile import Profile


def bench(
    profile: ProfileName = "sim",
    rate: Annotated[
        float, typer.Option("--rate", min=100.0, max=16_000.0, help="Of the loop, Hz.")
    ] = 1000.0,
    seconds: Annotated[
        float, typer.Option("--seconds", min=1.0, max=3600.0, help="Of each measurement, s.")
    ] = 10.0,
    spin_us: Annotated[
        float,
        typer.Option(
            "--spin-us", min=0.0, max=200.0, help="Last part of each wait spent polling, µs."
        ),
    ] = 0.0,
    as_json: AsJson = False,
) -> None:
    """Measure how late the loop wakes up on this computer, and which rate it can hold.

    The loop of a session, with everything simulated: no hardware is touched. Alone and beside
    cyclictest in turn (package rt-tests, if installed); then with the recorder, the live view and
    a busy program on the other cores; then at higher rates. Of the profile only the real-time
    settings count. Some three minutes; leave the computer alone meanwhile.

    Example: rigd bench --seconds 10
    """
    raise_on(signal.SIGTERM, signal.SIGHUP)
    from rigd.engine.process import SINGLE_THREADED

    os.environ.update(SINGLE_THREADED)
    rig_profile = profile_named(profile)
    from rigd.bench import as_json as document_of
    from rigd.bench import report_lines

    results = _run(rig_profile, rate_hz=rate, seconds=seconds, spin_us=spin_us)
    with contextlib.suppress(BrokenPipeError):
        if as_json:
            typer.echo(json.dumps(document_of(results), ensure_ascii=False))
        else:
            typer.echo("\n".join(report_lines(results)))


def _run(profile: "Profile", *, rate_hz: float, seconds: float, spin_us: float) -> "Results":
    from rich.console import Console
    from rich.status import Status

    from rigd.bench import Bench
    from rigd.bench.loops import LoopError
    from rigd.devices.registry import Reality, reality
    from rigd.supervisor.lock import RigBusyError, RigLock

    hardware = reality(profile.rig) is Reality.HARDWARE
    console = Console(stderr=True)
    try:
        # Beside a session of this rig, the loops of both would be late.
        with (
            RigLock(profile.name, "rigd bench", hardware=hardware),
            Status("preparing", console=console) as status,
        ):

            def tell(what: str, left_s: float) -> None:
                status.update(f"{what}; {left_s // 60:.0f}:{left_s % 60:02.0f} left")

            bench = Bench(profile, rate_hz=rate_hz, seconds=seconds, spin_us=spin_us, tell=tell)
            return bench.run()
    except (RigBusyError, LoopError) as error:
        fail(str(error), EXIT_FAILED)
