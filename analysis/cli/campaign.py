"""Analysis of a campaign from the command line: progress bar, report folder, printed tables."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final

from analysis.cli.standard_streams import print_readable
from analysis.results import DEFAULT_FORMATS

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from analysis.campaigns import CampaignResult
    from analysis.cli.sessions import OutputOptions
    from analysis.identify import Setting
    from analysis.models import WelchSettings
    from analysis.results import FigureFormat

_DEFAULT_CAMPAIGN_NAME: Final = "campaign"
"""Default name of a campaign, for its report folder."""
_MAX_CAMPAIGN_FIGURES: Final = 8
"""Number of progress steps for drawing: the largest number of a campaign's figures."""


def campaign_command(
    files: Sequence[Path],
    settings: WelchSettings,
    outputs: OutputOptions,
    *,
    structures: Sequence[str],
    fixed: Sequence[Setting] = (),
    band_hz: tuple[float, float] | None = None,
    jobs: int | None = None,
    dask: str | None = None,
    uniformity: float | None = None,
    with_paper: bool = False,
    formats: Sequence[FigureFormat] = DEFAULT_FORMATS,
    block_s: float | None = None,
) -> int:
    """Analyse a campaign, write its folder and its JSON, and print its tables.

    Parameters
    ----------
    files : sequence of Path
        Session files.
    settings : WelchSettings
        Settings of the Welch fits.
    outputs : OutputOptions
        Files to be written. The default report folder is ``campaign.report`` next to the first
        file, or ``campaign.report-2`` and so on if that exists.
    structures : sequence of str
        Structures fitted to the whole records.
    fixed : sequence of str
        Parameters of beam and rig that stay at the files' values in the whole-record fits.
    band_hz : tuple of float, optional
        Frequency band of all fits; by default chosen for each record.
    jobs : int, optional
        Number of worker processes, by default one per core.
    dask : str, optional
        Address of a Dask scheduler whose workers are used instead.
    uniformity : float, optional
        Relative standard deviation of mode frequencies from those of a uniform beam, instead of the
        value stated in the files.
    with_paper : bool
        Whether the tables also show the paper's values.
    formats : sequence of str
        File formats of the figures.
    block_s : float, optional
        Length in seconds of the blocks into which the only session is divided.

    Returns
    -------
    int
        Exit code: 1 if a file could not be used or predicted from the others, 0 otherwise.

    Raises
    ------
    CampaignError
        None of the files could be used, or no workers are available.
    SingleSessionError
        Only one of the files could be used. Nothing was written.
    SessionError, RecordError
        The session cannot be divided into blocks.
    OutputExistsError, OutputError
        An output file cannot be written.
    """
    from analysis.campaigns import campaign
    from analysis.report import campaign_document, document_text
    from analysis.report.campaign_report import campaign_tables
    from analysis.report.folder import report_folders, write_new_file

    report_folder_source = (
        files[0]
        if outputs.report is not None or block_s is not None
        else files[0].with_name(_DEFAULT_CAMPAIGN_NAME)
    )
    (report_folder,) = report_folders(
        [report_folder_source], outputs.report, overwrite=outputs.overwrite
    )
    run_campaign = partial(
        campaign, files, settings, structures=structures, fixed_parameters=fixed, band_hz=band_hz,
        jobs=jobs, dask_address=dask, uniformity=uniformity, block_s=block_s,
    )  # fmt: skip
    campaign_result = _analyse_and_write(
        run_campaign, len(files), report_folder, outputs, with_paper=with_paper, formats=formats
    )
    text_lines = [f"Report of the campaign: {report_folder / 'report.html'}"]
    if outputs.json is not None and not outputs.json_to_stdout:
        # The file is written before any output, because the streams may be closed.
        json_text = document_text(campaign_document(campaign_result, with_paper_values=with_paper))
        write_new_file(outputs.json, json_text, overwrite=outputs.overwrite)
        text_lines.insert(0, f"All results as JSON: {outputs.json}")
    console = outputs.console()
    console.print(
        campaign_tables(campaign_result, with_paper_values=with_paper, verbose=outputs.verbose)
    )
    console.print("\n".join(text_lines), markup=False, soft_wrap=True)
    if outputs.json_to_stdout:
        json_content = campaign_document(campaign_result, with_paper_values=with_paper)
        print(document_text(json_content, ascii_only=True), end="")  # noqa: T201 - the requested output
    return 1 if campaign_result.failures or campaign_result.failed_predictions else 0


def _analyse_and_write(
    run_campaign: Callable[..., CampaignResult],
    file_count: int,
    report_folder: Path,
    outputs: OutputOptions,
    *,
    with_paper: bool,
    formats: Sequence[FigureFormat],
) -> CampaignResult:
    """Analyse a campaign and write its report, with a progress bar; print the errors."""
    from analysis.campaigns import SingleSessionError
    from analysis.report.campaign_report import write_campaign
    from analysis.report.folder import new_report_folder
    from rigd.printable import progress_bar

    with progress_bar("{task.completed:.0f}/{task.total:.0f}") as progress:
        progress_task = progress.add_task("starting", total=2 * file_count + _MAX_CAMPAIGN_FIGURES)

        def on_progress(done_steps: int, total_steps: int, file_name: str) -> None:
            progress.update(
                progress_task,
                completed=done_steps,
                total=total_steps + _MAX_CAMPAIGN_FIGURES,
                description=file_name,
            )

        with new_report_folder(report_folder, overwrite=outputs.overwrite) as partial_folder:
            campaign_result = run_campaign(on_progress=on_progress)
            if len(campaign_result.sessions) == 1:
                raise SingleSessionError(campaign_result.sessions[0].path, campaign_result.failures)
            write_campaign(
                campaign_result, partial_folder, with_paper_values=with_paper, formats=formats,
                on_step=lambda step_text: progress.update(
                    progress_task, advance=1, description=step_text
                ),
            )  # fmt: skip
    print_error_line = partial(print_readable, progress.console)
    for session_failure in campaign_result.failures:
        print_error_line(f"Error: {session_failure.message}")
    for lost_trial in campaign_result.failed_predictions:
        print_error_line(
            f"Error: {lost_trial.source} is not predicted from the others: {lost_trial.reason}"
        )
    return campaign_result
