"""Commands ``rigd check``, ``reset`` and ``bench``: check of rig and computer, reset of a fault."""

import contextlib
import json
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rigd.cli.daemon import DaemonProfile, reset_by_daemon
from rigd.cli.options import EXIT_FAILED, EXIT_WRONG_USE, AsJson, ProfileName, fail, profile_named
from rigd.runtime import raise_on_signals

if TYPE_CHECKING:
    from rigd.bench import BenchResults
    from rigd.check_rows import CheckRow
    from rigd.profile import Profile


def check(
    profile: Annotated[
        str | None,
        typer.Option("--profile", help="Name of a hardware profile, or its file (default: sim)."),
    ] = None,
    eds: Annotated[
        Path | None,
        typer.Option(
            "--eds",
            metavar="FILE",
            help="Check only the EDS or DCF file of a drive; connect to nothing.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Check profile, buses, devices and control loop, without torque.

    Exits with 0 if a session can be run (warnings allowed), and with 1 if not. With --eds, only the
    file of a drive is checked: by itself, or with --profile also against that profile.

    Example: rigd check --profile antenna_can
    """
    _interrupt_on_end_signals()
    if eds is not None:
        _print_result(_eds_file_rows(eds, profile), as_json=as_json, is_eds_only=True)
        return
    rig_profile = _openable_profile("sim" if profile is None else profile)
    from rigd.checks import check_rig

    _print_result(check_rig(rig_profile), as_json=as_json, is_eds_only=False)


def _eds_file_rows(eds_path: Path, profile_name: str | None) -> "list[CheckRow]":
    """Return the rows of an EDS file's check, by itself or against a profile."""
    from rigd.checks.offline import eds_rows

    if profile_name is None:
        return list(eds_rows(eds_path, None))
    rig_profile = profile_named(profile_name)
    if rig_profile.rig.cia402 is None:
        fail(
            f"{rig_profile.path}: has no section [cia402] to check the file against; "
            "omit --profile, or name a profile with a CiA 402 drive.",
            EXIT_WRONG_USE,
        )
    return list(eds_rows(eds_path, rig_profile.rig))


def _print_result(check_rows: "list[CheckRow]", *, as_json: bool, is_eds_only: bool) -> None:
    """Print the rows of a check as a table or JSON, and end with exit code 1 if it failed.

    `is_eds_only` states that only an EDS file was checked.
    """
    from rigd.check_rows import overall_verdict

    verdict = overall_verdict(check_rows)
    if as_json:
        json_document = {"verdict": verdict, "rows": [row.as_dict() for row in check_rows]}
        typer.echo(json.dumps(json_document, ensure_ascii=False))
    else:
        from rigd.check_rows import CheckResult
        from rigd.checks import ACCEPTABLE_ROW_NAMES
        from rigd.checks.rows import EDS_CONSEQUENCES, RIG_CONSEQUENCES, print_check_table

        print_check_table(check_rows, EDS_CONSEQUENCES if is_eds_only else RIG_CONSEQUENCES)
        failed_row_names = {row.name for row in check_rows if row.verdict is CheckResult.FAIL}
        if failed_row_names and failed_row_names.issubset(ACCEPTABLE_ROW_NAMES) and not is_eds_only:
            accept_options = " ".join(
                f"--accept {row_name}"
                for row_name in ACCEPTABLE_ROW_NAMES
                if row_name in failed_row_names
            )
            typer.echo(f"To accept that for one session: rigd run … {accept_options}")
    if verdict == "failed":
        raise typer.Exit(EXIT_FAILED)


def reset(profile: DaemonProfile = None) -> None:
    """Reset a fault after its cause is removed. No torque; the drive stays off.

    A daemon that owns the rig does it; without one, the fault of the drive is reset directly, and
    --profile is needed. Exits with 0 if the fault is reset or the drive has none, with 1 if it is
    not reset, and with 2 if no rig is named.

    Example: rigd reset --profile antenna_can
    """
    _interrupt_on_end_signals()
    if reset_by_daemon(profile):
        return
    assert profile is not None
    rig_profile = _openable_profile(profile)
    from rigd.devices import reset_drive

    try:
        typer.echo(reset_drive(rig_profile.rig))
    except OSError as error:
        fail(str(error), EXIT_FAILED)


def _openable_profile(profile_name: str) -> "Profile":
    """Load a profile, and check that this installation can open its devices."""
    from rigd.devices import check_selection

    profile = profile_named(profile_name)
    check_selection(profile.rig.devices, profile.path)
    return profile


def _interrupt_on_end_signals() -> None:
    """Make SIGTERM and SIGHUP raise KeyboardInterrupt, so that the devices are then closed."""
    raise_on_signals(signal.SIGTERM, signal.SIGHUP)


def bench(
    profile: ProfileName = "sim",
    rate: Annotated[
        float, typer.Option("--rate", min=100.0, max=16_000.0, help="Rate of the loop (Hz).")
    ] = 1000.0,
    seconds: Annotated[
        float,
        typer.Option("--seconds", min=1.0, max=3600.0, help="Duration of each measurement (s)."),
    ] = 10.0,
    spin_us: Annotated[
        float,
        typer.Option("--spin-us", min=0.0, max=200.0, help="Busy-wait before each deadline (µs)."),
    ] = 0.0,
    as_json: AsJson = False,
) -> None:
    """Test the real-time performance of this computer.

    Measures the wake-up latency of the loop, and the highest rate that this computer can hold. Runs
    the loop of a session with everything simulated; no hardware is touched. It runs in turn with
    cyclictest (package rt-tests, if installed), then with the recorder, the live view and a busy
    program on the other cores, then at higher rates. Only the real-time settings of the profile are
    used. Takes about three minutes; do not use the computer meanwhile.

    Example: rigd bench --seconds 10
    """
    raise_on_signals(signal.SIGTERM, signal.SIGHUP)
    rig_profile = profile_named(profile)
    from rigd.bench import as_json as document_of
    from rigd.bench import report_lines

    results = _run_bench(rig_profile, rate_hz=rate, measurement_duration_s=seconds, spin_us=spin_us)
    with contextlib.suppress(BrokenPipeError):
        if as_json:
            typer.echo(json.dumps(document_of(results), ensure_ascii=False))
        else:
            typer.echo("\n".join(report_lines(results)))


def _run_bench(
    profile: "Profile", *, rate_hz: float, measurement_duration_s: float, spin_us: float
) -> "BenchResults":
    """Run the series of latency measurements with progress on standard error."""
    from rich.console import Console
    from rich.status import Status

    from rigd.bench import Bench
    from rigd.devices import ActuationTarget, actuation_target
    from rigd.runtime.locks import RigLock

    moves_hardware = actuation_target(profile.rig) is ActuationTarget.HARDWARE
    console = Console(stderr=True)
    # A simultaneous session of this rig would make both loops late.
    with (
        RigLock(profile.name, "rigd bench", hardware=moves_hardware),
        Status("preparing", console=console) as status,
    ):

        def on_progress(measurement_name: str, remaining_s: float) -> None:
            status.update(
                f"{measurement_name}; {remaining_s // 60:.0f}:{remaining_s % 60:02.0f} left"
            )

        bench = Bench(
            profile,
            rate_hz=rate_hz,
            measurement_duration_s=measurement_duration_s,
            spin_us=spin_us,
            on_progress=on_progress,
        )
        return bench.run()
