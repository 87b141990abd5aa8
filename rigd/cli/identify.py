"""Command ``rigd identify``: estimates of the rig's parameters from dedicated sessions."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rigd.cli.options import (
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    SESSIONS_FOLDER,
    AsJson,
    Fast,
    Hardware,
    Meta,
    Note,
    Operator,
    Output,
    ProfileName,
    Seed,
    Specimen,
    profile_named,
    session_notes,
)
from rigd.cli.start import SessionCommands, start_processes

if TYPE_CHECKING:
    from collections.abc import Callable

    from rigd.excitation import Excitation
    from rigd.identification import Proposal
    from rigd.identification.estimate import MotorEstimate
    from rigd.profile import Profile

    ExcitationBuilder = Callable[..., Excitation]
    PrepareProfile = Callable[[Profile], Profile]

identify_app = typer.Typer(
    cls=SessionCommands,
    help="Measure parameters of the rig for its profile.",
    no_args_is_help=True,
    rich_markup_mode=None,
)


@identify_app.callback()
def identify() -> None:
    """Measure parameters of the rig for its profile.

    Example: rigd identify motor --profile sim --fast
    """


@identify_app.command()
def motor(
    profile: ProfileName = "sim",
    output: Output = SESSIONS_FOLDER,
    torque_percent: Annotated[
        float,
        typer.Option("--torque-percent", help="Largest predicted torque (% of the rated torque)."),
    ] = 40.0,
    stroke_rad: Annotated[
        float,
        typer.Option("--stroke-rad", help="Largest angle to either side of the start (rad)."),
    ] = 0.8,
    from_files: Annotated[
        list[Path] | None,
        typer.Option(
            "--from",
            metavar="FILE",
            readable=False,
            help="Estimate from a recorded file and move nothing; repeat for each file.",
        ),
    ] = None,
    seed: Seed = None,
    operator: Operator = "",
    specimen: Specimen = "",
    note: Note = "",
    meta: Meta = None,
    fast: Fast = False,
    hardware: Hardware = False,
    as_json: AsJson = False,
) -> None:
    """Measure the motor's inertia, friction, torque constant and delay.

    Each value comes with its uncertainty.

    Three sessions of 25, 60 and 75 s: the shaft goes to and fro at constant speed, with a small
    multisine added, with a larger one, then at four speeds. The first only serves to design the
    controller of the others. Proposes lines for the profile and changes nothing itself. The torque
    constant is identifiable only with the antenna mounted.

    Example: rigd identify motor --profile sim --fast
    """
    if from_files:
        files = from_files
    else:
        files = _run_sessions(
            profile,
            output,
            torque_percent,
            stroke_rad,
            seed,
            session_notes(operator, specimen, note, meta),
            uses_virtual_clock=fast,
            force_hardware=hardware,
            quiet_stdout=as_json,
        )
    _, proposal = _estimate_motor(files, profile)
    if as_json:
        json_document = {"files": [str(file_path) for file_path in files], **proposal.as_dict()}
        typer.echo(json.dumps(json_document))
        return
    typer.echo("\n".join(["", *proposal.table(), ""]))
    for note in proposal.notes:
        typer.echo(f"Note: {note}")
    typer.echo("\n".join(["", "For the profile:", "", *proposal.toml()]))


def _run_sessions(
    profile_name: str,
    folder: Path,
    torque_percent: float,
    stroke_rad: float,
    seed: int | None,
    notes: dict[str, str],
    *,
    uses_virtual_clock: bool,
    force_hardware: bool,
    quiet_stdout: bool,
) -> list[Path]:
    """Run a trial session and two sessions for the estimate; return the files of the latter two.

    An incomplete session ends the command. The file of the trial is not used for the estimate,
    because the controller is too slow in the trial.
    """
    stop_request, process_group = start_processes(with_live_view=False)
    from rigd.identification import with_cautious_controller, with_tuned_controller
    from rigd.identification.experiments import (
        constant_speeds_excitation,
        multisine_excitation,
        trial_excitation,
    )
    from rigd.runner import ProcessGroup, run_in_foreground
    from rigd.runtime import ignore_end_signals

    def run_numbered_session(
        excitation_builder: "ExcitationBuilder",
        prepare_profile: "PrepareProfile",
        session_number: int,
        process_group: ProcessGroup,
    ) -> Path:
        def build_excitation(profile: "Profile") -> "Excitation":
            return excitation_builder(profile, torque_percent=torque_percent, stroke_rad=stroke_rad)

        session_results = run_in_foreground(
            build_excitation,
            process_group,
            stop_request,
            profile_name=profile_name,
            folder=folder,
            session_count=1,
            seed=None if seed is None else seed + session_number,
            notes=notes,
            uses_virtual_clock=uses_virtual_clock,
            with_live_view=False,
            allows_saturation=False,
            quiet_stdout=quiet_stdout,
            force_hardware=force_hardware,
            prepare_profile=prepare_profile,
            identifies_motor=True,
        )
        if stop_request.requested and not any(
            session_result.fault for session_result in session_results
        ):
            raise typer.Exit(EXIT_INTERRUPTED)
        file_path = session_results[0].path if session_results else None
        if file_path is None or not session_results[0].is_successful:
            raise typer.Exit(EXIT_FAILED)
        return file_path

    try:
        trial_path = run_numbered_session(
            trial_excitation, with_cautious_controller, 0, process_group
        )
        motor_estimate = _estimate_motor([trial_path], profile_name)[0]

        def tune_profile(profile: "Profile") -> "Profile":
            return with_tuned_controller(profile, motor_estimate)

        return [
            run_numbered_session(
                excitation_builder, tune_profile, session_number, ProcessGroup(with_live_view=False)
            )
            for session_number, excitation_builder in enumerate(
                (multisine_excitation, constant_speeds_excitation), start=1
            )
        ]
    finally:
        ignore_end_signals()  # nothing is left to stop; another Ctrl-C must not change the code


def _estimate_motor(files: list[Path], profile_name: str) -> "tuple[MotorEstimate, Proposal]":
    """Estimate the motor from session files, and propose values for the profile."""
    from rigd.identification import propose, read_recording
    from rigd.identification.estimate import estimate_motor

    profile = profile_named(profile_name)
    motor_recording = read_recording(files, profile.rig.actuation.delay_s)
    motor_estimate = estimate_motor(
        motor_recording.windows,
        motor_recording.timing,
        tool_inertia_kg_m2=motor_recording.tool_inertia_kg_m2,
    )
    return motor_estimate, propose(
        motor_estimate, profile, unusable_count=motor_recording.unusable_pass_count
    )
