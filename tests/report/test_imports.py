"""What writes no page needs nothing of pages: notebooks and clusters start without them."""

import subprocess
import sys

import pytest
from cases import further

pytestmark = pytest.mark.process

PAGES = ("jinja2", "analysis.report._page")
ASK = "import sys; from analysis.report import {names}; print(*sys.modules)"


def modules_after(code, *arguments):
    """Modules that a program has imported when it ends."""
    result = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=True
    )
    return set(result.stdout.split())


def imported(names):
    return modules_after(ASK.format(names=names))


@pytest.mark.parametrize(
    "names",
    [
        "result_text, summary_table",
        further("document, document_text, campaign_document"),
        further("write_rerun_file, check_rerun_file"),
        further("illustrations, frf_figure"),
        "campaign_report, record_report",
    ],
)
def test_text_json_figures_and_rrd_need_no_pages(names):
    modules = imported(names)
    assert modules.intersection(("analysis.report.table", "analysis.report._style"))
    assert not modules.intersection(PAGES)


MOST = 30
ESTIMATORS = ("analysis.identify", "analysis.paper", "analysis.decimation")
ANALYZE = """
import sys
from pathlib import Path
from analysis.cli.sessions import Outputs, session_command
from analysis.models import WelchSettings
from analysis.results import AnalysisOptions
from contextlib import redirect_stdout
from matplotlib.figure import Figure
Figure.savefig = lambda *_, **__: None  # drawing takes longer than all the rest
settings = WelchSettings(types=("I",), weightings=("const",), estimator="fft", band_hz=(1.0, 20.0))
routes = AnalysisOptions(settings, paper=True, whole_record=True, fixed=())
with redirect_stdout(sys.stderr):
    assert session_command([Path(sys.argv[1])], routes, Outputs(Path(sys.argv[2]))) == 0
print(*sys.modules)
"""


def test_the_way_from_file_to_page_is_short(write_session, make_signals, tmp_path):
    """Beside the estimators, and without a campaign."""
    signals = make_signals(rest_s=0.2, sweep_s=5.0, ring_down_s=0.3)
    path = write_session(tmp_path / "session.mcap", signals)
    modules = modules_after(ANALYZE, str(path), str(tmp_path / "report"))
    assert (tmp_path / "report" / "report.html").exists()
    ours = {name for name in modules if name.partition(".")[0] == "analysis"}
    estimators = {name for name in ours if name.startswith(ESTIMATORS)}
    assert {"analysis.results", "analysis.report.record_report"} <= ours
    assert len(ours - estimators) <= MOST
    assert not [name for name in ours if "campaign" in name]
