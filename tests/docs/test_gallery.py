"""The gallery of faults is whole, and its script still draws it."""

import re
import subprocess
import sys
from pathlib import Path

import matplotlib.image
import pytest

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "fault_gallery.md").read_text("utf-8")
SECTIONS = re.findall(r"^## .*?(?=^## |\Z)", PAGE, re.MULTILINE | re.DOTALL)


def test_fifteen_faults_are_shown_quoted_and_explained():
    assert len(SECTIONS) == 15
    for section in SECTIONS:
        picture = re.search(r"\]\((gallery/\w+\.png)\)", section)[1]
        assert matplotlib.image.imread(DOCS / picture).shape[1] > 800
        assert len(re.findall(r"^> \* \w.*\.$", section, re.MULTILINE)) >= 2, section
        assert "**What to do.** " in section
    assert len(list((DOCS / "gallery").glob("*.png"))) == 15


@pytest.mark.further
@pytest.mark.process
@pytest.mark.fit
def test_script_reproduces_figure_and_quotation_of_a_fault(tmp_path, runtime_folder):
    script = DOCS / "gallery" / "make.py"
    command = [sys.executable, script, tmp_path, "--only", "wrong_unit"]
    subprocess.run(command, check=True, capture_output=True)
    drawn = matplotlib.image.imread(tmp_path / "wrong_unit.png")
    assert drawn.shape == matplotlib.image.imread(DOCS / "gallery" / "wrong_unit.png").shape
    without_numbers = re.compile(r"[\d.e-]+")
    written = (tmp_path / "fault_gallery.md").read_text("utf-8")
    assert without_numbers.sub("", written) == without_numbers.sub("", PAGE)
