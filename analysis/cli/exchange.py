"""Commands `analyze import` and `analyze export` for files of other programs."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer
from typer.models import OptionInfo

from analysis.cli.standard_streams import print_error
from analysis.cli.welch_options import (
    Band,
    Estimator,
    Nfft,
    Overlap,
    Segment,
    band_hz,
    parse_option_choice,
    welch_settings,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from analysis.exchange import ChannelChoice
    from analysis.linear_model import LinearModel

export_app = typer.Typer(
    help="Write a session's record, frequency response or model for another program.",
    no_args_is_help=True,
    rich_markup_mode=None,
)
"""Application of the commands `analyze export …`."""

IMPORT_EPILOG = """\
Example: analyze import log.tdms session.mcap --angle "Rig/Angle:deg" --torque "Rig/Tz:mN.m"
--rate-hz 1000 --profile rig.toml --rest 0,1 --sweep 1,121

Exit code: 0 done, 1 the file cannot be imported, 2 usage error, 130 stopped by Ctrl-C."""
"""Text at the end of the help of the command that imports records."""

_EXPORT_EPILOG = "Exit code: 0 done, 1 it cannot be exported, 2 usage error, 130 stopped by Ctrl-C."
"""Text at the end of the help of the commands that export records and responses."""

_MODEL_EPILOG = """\
Example: analyze export model session.mcap beam.mat --rate 1000

Exit code: 0 done, 1 it cannot be exported, 2 usage error, 130 stopped by Ctrl-C."""
"""Text at the end of the help of the command that exports models."""

_Session = Annotated[
    Path, typer.Argument(metavar="SESSION", readable=False, help="Session file (.mcap).")
]
"""Argument SESSION of the export commands."""
_Target = Annotated[
    Path,
    typer.Argument(metavar="OUT", readable=False, help="New file: .csv, .mat, .uff, .unv, .uf58."),
]
"""Argument OUT of the commands that export records and responses."""
_Binary = Annotated[
    bool, typer.Option("--binary", help="Write 8-byte floats instead of text (universal files).")
]
"""Option --binary."""


def _channel_option(help_text: str) -> OptionInfo:
    """Return an option that takes a channel and its unit, with a help text."""
    channel_option: OptionInfo = typer.Option(metavar="CHANNEL:UNIT", help=help_text)
    return channel_option


def import_command(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="SOURCE",
            readable=False,
            help="File of measurements: .csv, .txt, .dat, .tsv, .asc, .lvm, .mat, .tdms, .uff, "
            ".unv, .uf58.",
        ),
    ],
    session: Annotated[
        Path, typer.Argument(metavar="SESSION", readable=False, help="New session file (.mcap).")
    ],
    angle: Annotated[str, _channel_option("Motor angle at the output shaft; rad, mrad, deg, …")],
    torque: Annotated[str, _channel_option("Coupling torque; N.m, mN.m, N.mm, …")],
    profile: Annotated[
        Path,
        typer.Option(metavar="FILE", readable=False, help="TOML with [beam] and the tool inertia."),
    ],
    time: Annotated[
        str | None,
        _channel_option("Time of the samples; s, ms, us, ns. Times of day are read in s."),
    ] = None,
    rate_hz: Annotated[
        float | None,
        typer.Option(metavar="HZ", help="Instead of --time: samples per second, without gaps."),
    ] = None,
    reference: Annotated[str | None, _channel_option("Reference of the motor angle.")] = None,
    torque_command: Annotated[str | None, _channel_option("Torque commanded to the motor.")] = None,
    fx: Annotated[
        str | None, _channel_option("Force along x, sensor frame; N, mN, kN, lbf.")
    ] = None,
    fy: Annotated[str | None, _channel_option("Force along y, sensor frame.")] = None,
    fz: Annotated[str | None, _channel_option("Force along z, sensor frame.")] = None,
    tx: Annotated[str | None, _channel_option("Torque about x, sensor frame.")] = None,
    ty: Annotated[str | None, _channel_option("Torque about y, sensor frame.")] = None,
    tz: Annotated[str | None, _channel_option("Torque about z, sensor frame.")] = None,
    rest: Annotated[
        str | None, typer.Option(metavar="T0,T1", help="Rest before the sweep, s from the start.")
    ] = None,
    sweep: Annotated[
        str | None,
        typer.Option(
            metavar="T0,T1", help="Sweep, s from the first sample.  [default: the whole record]"
        ),
    ] = None,
    ring_down: Annotated[
        str | None,
        typer.Option(metavar="T0,T1", help="Ring-down after the sweep, s from the start."),
    ] = None,
    angle_delay_s: Annotated[
        float, typer.Option(metavar="S", help="Latency of the angle at its time stamp.")
    ] = 0.0,
    torque_delay_s: Annotated[
        float, typer.Option(metavar="S", help="Latency of the torque at its time stamp.")
    ] = 0.0,
    reverse_torque: Annotated[
        bool,
        typer.Option("--reverse-torque", help="The torque is the reaction: change its sign."),
    ] = False,
    ignore_file_metadata: Annotated[
        bool,
        typer.Option(
            "--ignore-file-metadata",
            help="Your options override the rate, start, unit or scale that the file states.",
        ),
    ] = False,
    operator: Annotated[
        str, typer.Option(metavar="TEXT", help="Operator name, stored in the session file.")
    ] = "",
    specimen: Annotated[
        str,
        typer.Option(metavar="TEXT", help="Label of the specimen; campaigns compare it."),
    ] = "",
    note: Annotated[
        str, typer.Option(metavar="TEXT", help="Note, stored in the session file.")
    ] = "",
) -> None:
    """Convert a record of another program to a session file.

    Channels and units are stated, never guessed. A channel is named as the file names it (its
    title in text and UFF58, Group/Channel in TDMS, struct.field or matrix#column in MATLAB), or #3
    for the third of a text or UFF58 file. In text, lines above the titles and a line of units below
    them are found; any other line that does not fit the table is refused with its number.

    What the file states of units, rate, times, start times and scales is used or compared with what
    you state, and a contradiction is refused; --ignore-file-metadata lets you insist.
    """
    from analysis.exchange import QUANTITIES, ImportPlan, import_record, read_specimen

    if (time is None) == (rate_hz is None):
        raise typer.BadParameter(
            "state either the channel of times or the rate.", param_hint="--time, --rate-hz"
        )
    _check_delay("--angle-delay-s", angle_delay_s)
    _check_delay("--torque-delay-s", torque_delay_s)
    if session.suffix != ".mcap":
        raise typer.BadParameter(
            f"'{session}' does not end in .mcap, as a session file does.", param_hint="SESSION"
        )
    channel_options = {
        "angle_rad": ("--angle", angle),
        "coupling_torque_nm": ("--torque", torque),
        "angle_reference_rad": ("--reference", reference),
        "torque_command_nm": ("--torque-command", torque_command),
        "fx_n": ("--fx", fx),
        "fy_n": ("--fy", fy),
        "fz_n": ("--fz", fz),
        "tx_nm": ("--tx", tx),
        "ty_nm": ("--ty", ty),
        "tz_nm": ("--tz", tz),
    }
    channel_choices = {
        field_name: _parse_channel(option_name, option_text, QUANTITIES[field_name])
        for field_name, (option_name, option_text) in channel_options.items()
        if option_text is not None
    }
    time_choice = None if time is None else _parse_channel("--time", time, "time")
    segments_s = {
        name: _parse_interval(option_name, option_text)
        for name, option_name, option_text in (
            ("rest", "--rest", rest),
            ("sweep", "--sweep", sweep),
            ("ring_down", "--ring-down", ring_down),
        )
        if option_text is not None
    }

    def import_session() -> None:
        import_plan = ImportPlan(
            channel_choices,
            read_specimen(profile),
            time_choice,
            rate_hz,
            segments_s,
            angle_delay_s,
            torque_delay_s,
            reverse_torque,
            note,
            specimen,
            operator,
            ignore_file_metadata,
        )
        imported_record = import_record(source, session, import_plan)
        for warning_text in imported_record.warnings:
            typer.echo(f"Warning: {warning_text}", err=True)
        typer.echo(
            f"{imported_record.samples} samples at {imported_record.rate_hz:g} Hz from {source}: "
            f"{session}"
            + (
                ""
                if "sweep" in imported_record.segments
                else "; the whole record counts as the sweep"
            )
        )

    raise typer.Exit(_run_for_exit_code(import_session))


@export_app.command("record", epilog=_EXPORT_EPILOG)
def export_record_command(
    session: _Session,
    target: _Target,
    binary: _Binary = False,
    from_s: Annotated[
        float | None,
        typer.Option("--from", metavar="S", help="First time of the part to be written (s)."),
    ] = None,
    to_s: Annotated[
        float | None,
        typer.Option("--to", metavar="S", help="End of the part to be written (s)."),
    ] = None,
) -> None:
    """Write the samples as recorded.

    Writes time, angles, torques, wrench and status bits.
    """
    from analysis.exchange import export_record

    def export_samples() -> None:
        part_s = None if from_s is None and to_s is None else (from_s, to_s)
        export_table = export_record(session, target, binary=binary, part_s=part_s)
        typer.echo(f"{len(export_table.axis.values)} samples of {session}: {target}")

    raise typer.Exit(_run_for_exit_code(export_samples))


@export_app.command("frf", epilog=_EXPORT_EPILOG)
def export_frf_command(
    session: _Session,
    target: _Target,
    binary: _Binary = False,
    frf: Estimator = "h1",
    band: Band = None,
    segment: Segment = None,
    overlap: Overlap = None,
    nfft: Nfft = None,
) -> None:
    """Write the estimated frequency response.

    The response is from angle to coupling torque, estimated as in an analysis.
    """
    from analysis.exchange import export_frf

    estimate_settings = welch_settings("I", "const", frf, segment, overlap, nfft)
    requested_band_hz = band_hz(band)

    def export_response() -> None:
        export_table = export_frf(
            session, target, estimate_settings, requested_band_hz, binary=binary
        )
        typer.echo(f"{len(export_table.axis.values)} frequencies of {session}: {target}")

    raise typer.Exit(_run_for_exit_code(export_response))


@export_app.command("model", epilog=_MODEL_EPILOG)
def export_model_command(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="SESSION|MODEL.json",
            readable=False,
            help="Session file (.mcap), which is analysed, or JSON of analyze.",
        ),
    ],
    target: Annotated[
        Path,
        typer.Argument(metavar="OUT", readable=False, help="New file: .json, .npz, .mat."),
    ],
    beam: Annotated[
        bool,
        typer.Option("--beam", help="The beam's model, even if the beam failed its test."),
    ] = False,
    input_kind: Annotated[
        str,
        typer.Option(
            "--input",
            metavar="acceleration|angle",
            help="angle: three inputs, angle, velocity and acceleration of the motor.",
        ),
    ] = "acceleration",
    order: Annotated[
        str,
        typer.Option(metavar="N|auto", help="Number of states; auto: fewest for an error of 1e-3."),
    ] = "auto",
    rate: Annotated[
        str,
        typer.Option(metavar="HZ|continuous", help="Sample with the input held (zero-order hold)."),
    ] = "continuous",
    samples: Annotated[
        int | None,
        typer.Option(metavar="N", min=0, max=1000, help="Samples of the posterior.  [default: 50]"),
    ] = None,
) -> None:
    """Write a linear model from the motor's motion to the coupling torque.

    Writes the modal model (poles, residues, background), and matrices A, B, C, D: those of the beam
    where a uniform beam predicts the modes or with --beam, else those of the modal model. The delay
    is a number of its own, and not in the matrices. Error and standard deviation of the response
    are stated over the band.
    """
    from analysis.exchange import export_model
    from analysis.linear_model import DEFAULT_POSTERIOR_SAMPLES, INPUT_KINDS, ModelOptions
    from rigd.printable import progress_bar

    model_options = ModelOptions(
        beam,
        parse_option_choice(input_kind, INPUT_KINDS, "--input"),
        _parse_order(order),
        _parse_rate(rate),
        DEFAULT_POSTERIOR_SAMPLES if samples is None else samples,
    )

    def export_linear_model() -> None:
        with progress_bar() as step_progress:
            progress_task = step_progress.add_task("", total=None)
            linear_model = export_model(
                source,
                target,
                model_options,
                lambda step: step_progress.update(
                    progress_task, description=f"{source.name}: {step}"
                ),
            )
        for summary_line in _model_lines(linear_model, source, target):
            typer.echo(summary_line)

    raise typer.Exit(_run_for_exit_code(export_linear_model))


def _model_lines(model: LinearModel, source: Path, target: Path) -> list[str]:
    """Return the printed summary of an exported model, one statement per line."""
    state_space, accuracy = model.system, model.accuracy
    uniform_beam_test = model.identified.uniform_beam_test
    uniformity_text = uniform_beam_test.status
    if uniform_beam_test.p_value is not None:
        uniformity_text += f", p = {uniform_beam_test.p_value:.2g}"
    model_name = "exact beam" if model.kind == "beam" else "modal model"
    relaxation_count = sum(
        state_name.startswith("relaxation") for state_name in state_space.states.names
    )
    time_text = "continuous time"
    if state_space.period_s:
        time_text = f"{1 / state_space.period_s:g} Hz, input held between samples"
    low_hz, high_hz = accuracy.band_hz
    band_text = f"{low_hz:g} to {high_hz:g} Hz"
    inputs_text = ", ".join(
        map("{} ({})".format, state_space.inputs.names, state_space.inputs.units)
    )
    text_lines = [
        f"Model: {model_name} of {source} (uniform beam: {uniformity_text}): {target}",
        f"Order: {state_space.order} states ({model.structure.pair_count} pairs of poles, "
        f"{relaxation_count} real poles); {time_text}",
        f"Input: {inputs_text}",
        f"Output: coupling_torque (N.m), delayed by {1e3 * state_space.delay_s:.4g} ms; the delay "
        "is not in the matrices",
        f"Error: at most {accuracy.max_relative_error:.1e} of the response, median "
        f"{accuracy.median_relative_error:.1e}, {band_text}",
    ]
    if math.isnan(accuracy.max_relative_std):
        text_lines.append("Data: the standard deviation is not known without a covariance")
    else:
        text_lines.append(
            f"Data: standard deviation at most {accuracy.max_relative_std:.1e} of the response, "
            f"median {accuracy.median_relative_std:.1e}, {band_text}"
        )
    text_lines.append(
        f"Samples: {len(model.posterior.systems)} of the posterior, with the same states"
    )
    return [*text_lines, *(f"Note: {note_text}" for note_text in model.notes)]


def _parse_order(option_text: str) -> int | None:
    """Return the number of states in --order, or None for auto; raise if invalid."""
    if option_text == "auto":
        return None
    if not (
        option_text.isascii()
        and option_text.isdecimal()
        and 1 <= int(option_text[:6]) <= _MAX_ORDER_STATES
    ):
        raise typer.BadParameter(
            f"'{option_text}' is neither auto nor a number of states from 1 to "
            f"{_MAX_ORDER_STATES}.",
            param_hint="--order",
        )
    return int(option_text)


def _parse_rate(option_text: str) -> float | None:
    """Return the sampling rate of --rate in Hz, or None for continuous time; raise if invalid."""
    if option_text == "continuous":
        return None
    try:
        rate_hz = float(option_text)
    except ValueError:
        rate_hz = math.nan
    if not _SAMPLING_RATE_RANGE_HZ[0] <= rate_hz <= _SAMPLING_RATE_RANGE_HZ[1]:
        raise typer.BadParameter(
            f"'{option_text}' is neither continuous nor a rate from "
            f"{_SAMPLING_RATE_RANGE_HZ[0]:g} to {_SAMPLING_RATE_RANGE_HZ[1]:g} Hz.",
            param_hint="--rate",
        )
    return rate_hz


_MAX_ORDER_STATES: Final = 200
"""Largest number of states that --order accepts."""
_SAMPLING_RATE_RANGE_HZ: Final = (1.0, 1e6)
"""Range of sampling rates in Hz that --rate accepts."""


def _run_for_exit_code(run_command: Callable[[], None]) -> int:
    """Run the function of a command; print an error that it raises, and return the exit code."""
    from numpy.linalg import LinAlgError

    from analysis.exchange import ExchangeError, TargetError
    from analysis.identify import MeasurementError
    from analysis.linear_model import LinearModelError
    from analysis.paper import FrequencyResponseError, SettingsError
    from analysis.record import RecordError
    from analysis.report.folder import OutputError, OutputExistsError
    from rigd.identified_beam import IdentifiedBeamError
    from rigd.session import SessionError, SessionExistsError

    try:
        run_command()
    except (SettingsError, TargetError, OutputExistsError, SessionExistsError) as error:
        print_error(str(error))
        return 2
    except (
        ExchangeError, SessionError, RecordError, FrequencyResponseError, MeasurementError,
        OutputError, IdentifiedBeamError, LinearModelError,
    ) as error:  # fmt: skip
        print_error(str(error))
        return 1
    except LinAlgError as error:
        print_error(f"The estimate failed ({error}); is this a record of the rig?")
        return 1
    except KeyboardInterrupt:
        typer.echo("Stopped.", err=True)
        return 130
    return 0


def _parse_channel(option_name: str, option_text: str, quantity: str) -> ChannelChoice:
    """Return the channel and unit in an option's text; raise a usage error if it is invalid."""
    from analysis.exchange import ExchangeError, parse_choice

    try:
        return parse_choice(option_text, quantity)
    except ExchangeError as error:
        raise typer.BadParameter(str(error), param_hint=option_name) from error


_MAX_SEGMENT_END_S: Final = 1e6
"""Latest end of a segment in seconds: longer than any record that can be imported."""


def _parse_interval(option_name: str, option_text: str) -> tuple[float, float]:
    """Return begin and end of a segment in seconds from an option's text; raise if invalid."""
    try:
        begin_s, end_s = (float(number_text) for number_text in option_text.split(","))
    except ValueError:
        begin_s = end_s = math.nan
    if not 0.0 <= begin_s < end_s <= _MAX_SEGMENT_END_S:
        raise typer.BadParameter(
            f"'{option_text}' is not two times in s with 0 <= T0 < T1 <= 1e6, such as 1,121.",
            param_hint=option_name,
        )
    return begin_s, end_s


def _check_delay(option_name: str, delay_s: float) -> None:
    """Raise a usage error if a channel's delay exceeds one second."""
    if not abs(delay_s) <= 1.0:
        raise typer.BadParameter(
            f"{delay_s} s cannot be the delay of a sample.", param_hint=option_name
        )
