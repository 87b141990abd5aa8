"""A campaign from the command line: progress with the time left, the folder, the tables."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final

from analysis.cli.standard_streams import print_readable
from analysis.results import DEFAULT_FORMATS

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from analysis.campaigns import CampaignResult
    from analysis.cli.sessions import Outputs
    from analysis.identify import Setting
    from analysis.models import WelchSettings
    from analysis.results import FigureFormat

_NAME: Final = "campaign"
_FIGURES: Final = 8
"""At most; each takes about as long as half a session."""


def campaign_command(
    files: Sequence[Path],
    settings: WelchSettings,
    outputs: Outputs,
    *,
    structures: Sequence[str],
    fixed: Sequence[Setting] = (),
    band_hz: tuple[float, float] | None = None,
    jobs: int | None = None,
    dask: str | None = None,
    uniformity: float | None = None,
    with_paper: bool = False,
    formats: Sequence[FigureFormat] = DEFAULT_FORMATS,
) -> int:
    """Analyse a campaign, write its folder and its JSON, and print its tables.

    Parameters
    ----------
    files : sequence of Path
    settings : WelchSettings
        Settings of the Welch fits.
    outputs : Outputs
        Its folder is by default ``campaign.report`` next to the first file, or if that exists
        ``campaign.report-2`` and so on.
    structures : sequence of str
        Types fitted to the whole records.
    fixed : sequence of str
        Settings that those fits take from the files.
    band_hz : tuple of float, optional
        Band of all fits; by default what suits each record.
    jobs : int, optional
        Worker processes, by default one per core.
    dask : str, optional
        Address of a Dask scheduler to use instead.
    uniformity : float, optional
        Relative standard deviation of each mode's frequency from that of a uniform beam, instead of
        that stated in the files.
    with_paper : bool
        Whether the paper's numbers are included.
    formats : sequence of str
        Formats of the figures.

    Returns
    -------
    int
        Exit code: 1 if a file could not be used or predicted from the others, 0 otherwise.

    Raises
    ------
    CampaignError
        None of the files could be used, or the workers could not be had.
    SingleSessionError
        Only one of the files could be used, which makes no campaign: nothing was written.
    OutputExistsError, OutputError
        Something cannot be written.
    """
    from analysis.campaigns import campaign
    from analysis.report import campaign_document, document_text
    from analysis.report.campaign_report import campaign_tables
    from analysis.report.folder import report_folders, write_new

    first = files[0] if outputs.report is not None else files[0].with_name(_NAME)
    (folder,) = report_folders([first], outputs.report, overwrite=outputs.overwrite)
    run = partial(
        campaign, files, settings, structures=structures, fixed=fixed, band_hz=band_hz, jobs=jobs,
        dask=dask, uniformity=uniformity,
    )  # fmt: skip
    found = _analysed(run, len(files), folder, outputs, with_paper=with_paper, formats=formats)
    lines = [f"Report of the campaign: {folder / 'report.html'}"]
    if outputs.json is not None and not outputs.json_to_stdout:
        # Before any output: the streams may be closed.
        text = document_text(campaign_document(found, with_paper=with_paper))
        write_new(outputs.json, text, overwrite=outputs.overwrite)
        lines.insert(0, f"All results as JSON: {outputs.json}")
    console = outputs.console()
    console.print(campaign_tables(found, with_paper=with_paper, verbose=outputs.verbose))
    console.print("\n".join(lines), markup=False, soft_wrap=True)
    if outputs.json_to_stdout:
        content = campaign_document(found, with_paper=with_paper)
        print(document_text(content, ascii_only=True), end="")  # noqa: T201 - the requested output
    return 1 if found.failures or found.lost_trials else 0


def _analysed(
    run: Callable[..., CampaignResult],
    files: int,
    folder: Path,
    outputs: Outputs,
    *,
    with_paper: bool,
    formats: Sequence[FigureFormat],
) -> CampaignResult:
    """Analyse and write, with progress on a terminal; print the errors."""
    from analysis.campaigns import SingleSessionError
    from analysis.report.campaign_report import write_campaign
    from analysis.report.folder import new_folder
    from rigd.printable import progress_bar

    with progress_bar("{task.completed:.0f}/{task.total:.0f}") as progress:
        bar = progress.add_task("starting", total=2 * files + _FIGURES)

        def on_progress(done: int, total: int, name: str) -> None:
            progress.update(bar, completed=done, total=total + _FIGURES, description=name)

        with new_folder(folder, overwrite=outputs.overwrite) as part:
            found = run(on_progress=on_progress)
            if len(found.sessions) == 1:
                raise SingleSessionError(found.sessions[0].path, found.failures)
            write_campaign(
                found, part, with_paper=with_paper, formats=formats,
                on_step=lambda done: progress.update(bar, advance=1, description=done),
            )  # fmt: skip
    report_error = partial(print_readable, progress.console)
    for failure in found.failures:
        report_error(f"Error: {failure.message}")
    for lost in found.lost_trials:
        report_error(f"Error: {lost.path} is not predicted from the others: {lost.reason}")
    return found
