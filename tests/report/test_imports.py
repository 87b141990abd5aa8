"""What writes no page needs nothing of pages: notebooks and clusters start without them."""

import subprocess
import sys

import pytest

PAGES = ("jinja2", "analysis.report._page", "analysis.report._record_page",
         "analysis.report._campaign_page")  # fmt: skip
ASK = "import sys; from analysis.report import {names}; print(*sys.modules)"


def imported(names):
    result = subprocess.run(
        [sys.executable, "-c", ASK.format(names=names)], capture_output=True, text=True, check=True
    )
    return set(result.stdout.split())


@pytest.mark.parametrize(
    "names",
    [
        "analysis_tables, record_text, summary_table, campaign_tables",
        "document, document_text, campaign_document",
        "write_rerun_file, check_rerun_file",
        "illustrations, frf_figure",
        "write_report, write_campaign",
    ],
)
def test_text_json_figures_and_rrd_need_no_pages(names):
    modules = imported(names)
    assert modules.intersection(("analysis.report._table", "analysis.report._style"))
    assert not modules.intersection(PAGES)
