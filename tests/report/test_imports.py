"""Output without pages imports nothing of pages: notebooks and clusters start without them."""

import pickle
import subprocess
import sys

import pytest

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


def test_text_json_figures_and_rrd_need_no_pages():
    modules = imported(
        "result_text, summary_table, document, document_text, campaign_document, write_rerun_file, "
        "check_rerun_file, illustrations, frf_figure, campaign_report, record_report"
    )
    assert modules.intersection(("analysis.report.table", "analysis.report._style"))
    assert not modules.intersection(PAGES)


MOST = 30
ESTIMATORS = ("analysis.identify", "analysis.paper", "analysis.decimation")
ANALYZE = """
import pickle, sys
from dataclasses import replace
from pathlib import Path
import analysis.results
from analysis.cli.sessions import OutputOptions, session_command
from analysis.models import WelchSettings
from analysis.results import AnalysisOptions
from contextlib import redirect_stdout
from matplotlib.figure import Figure
Figure.savefig = lambda *_, **__: None  # drawing takes longer than all the rest
def whole_record(record, *_):  # as does the search of a structure
    from analysis.identify import Measurement, select
    return replace(pickle.loads(Path(sys.argv[3]).read_bytes()), record=record)
analysis.results.whole_record = whole_record
settings = WelchSettings(types=("I",), weightings=("const",), estimator="fft", band_hz=(1.0, 20.0))
options = AnalysisOptions(settings, with_welch_fits=True, whole_record=True, fixed_parameters=())
with redirect_stdout(sys.stderr):
    assert session_command([Path(sys.argv[1])], options, OutputOptions(Path(sys.argv[2]))) == 0
print(*sys.modules)
"""


def test_page_needs_few_imports(record_result, tmp_path):
    """In addition to the estimators, and without a campaign."""
    whole = tmp_path / "whole.pickle"
    whole.write_bytes(pickle.dumps(record_result.whole))
    path = record_result.record.path
    modules = modules_after(ANALYZE, str(path), str(tmp_path / "report"), str(whole))
    assert (tmp_path / "report" / "report.html").exists()
    ours = {name for name in modules if name.partition(".")[0] == "analysis"}
    estimators = {name for name in ours if name.startswith(ESTIMATORS)}
    assert {"analysis.results", "analysis.report.record_report"} <= ours
    assert len(ours - estimators) <= MOST
    assert not [name for name in ours if "campaign" in name]
