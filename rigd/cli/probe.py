"""Command ``rigd probe``: a small move that verifies scales and signs of the rig."""

import json
from functools import partial

import typer

from rigd.cli.options import EXIT_FAILED, AsJson, Fast, Hardware, ProfileName
from rigd.cli.start import start_processes


def probe(
    profile: ProfileName = "sim",
    fast: Fast = False,
    hardware: Hardware = False,
    as_json: AsJson = False,
) -> None:
    """Verify the rig's scales and signs by a small move.

    Compares motor, encoder and sensor with each other and with the beam. The shaft makes strokes of
    0.3 rad at 0.4 and 0.8 rad/s under tight bounds; about eight seconds. Sessions on hardware begin
    with this move by themselves, unless the profile states that motor and encoder were measured.
    Exits with 1 if the rig contradicts the profile.

    Example: rigd probe --profile sim --fast
    """
    stop_request, process_group = start_processes(with_live_view=False)
    from rigd.runner import probe_in_foreground
    from rigd.runtime import ignore_end_signals

    try:
        rig_profile, probe_result = probe_in_foreground(
            process_group,
            stop_request,
            profile_name=profile,
            uses_virtual_clock=fast,
            force_hardware=hardware,
            report_line=partial(typer.echo, err=True),
        )
    finally:
        ignore_end_signals()
    contradiction_text = probe_result.contradiction_text(rig_profile)
    if as_json:
        json_document = {"end": probe_result.end.name.lower(), **probe_result.estimate.as_dict()}
        typer.echo(json.dumps(json_document | {"contradiction": contradiction_text}))
    else:
        typer.echo("\n".join(probe_result.text_lines(rig_profile)))
        typer.echo(contradiction_text or "The rig agrees with its profile.")
    if contradiction_text:
        raise typer.Exit(EXIT_FAILED)
