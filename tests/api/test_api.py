"""The analyser from Python: each step is the command's own, and the document's example runs."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import analysis
from analysis import api
from analysis.identify import Measurement, fit_record
from analysis.models import STRUCTURES, WelchSettings
from analysis.paper import estimate
from analysis.record import RecordError, load_record
from rigd.session import SessionError

pytestmark = pytest.mark.process

DOCUMENT = (Path(__file__).parents[2] / "docs" / "python_api.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def record(workspace):
    return api.load(str(workspace / "session.mcap"))


@pytest.mark.further  # each of its steps is tested below
def test_example_of_the_document_runs_as_written(workspace, monkeypatch, capsys):
    monkeypatch.chdir(workspace)
    blocks = re.findall(r"^```python\n(.*?)^```$", DOCUMENT, re.MULTILINE | re.DOTALL)
    assert len(blocks) == 8
    exec("\n".join(blocks), {"__name__": "__main__"})
    printed = capsys.readouterr().out
    assert "21500 samples at 1000 Hz, outcome complete" in printed
    peak_hz = float(re.search(r"highest peak at ([\d.]+) Hz", printed)[1])
    assert peak_hz == pytest.approx(2.57, abs=0.05)  # first mode of the paper's antenna
    modes_hz = [
        float(hertz) for hertz in re.findall(r"^([\d.]+) Hz, damping", printed, re.MULTILINE)
    ]
    assert modes_hz == pytest.approx([2.57, 16.01, 44.8], rel=5e-3)
    for kind in ("III", "VI", "VII"):
        assert re.search(rf"^type {kind}: zeta = [\d.e-]+ ± [\d.e-]+, cost", printed, re.MULTILINE)
    assert "2 sessions, 0 failed" in printed
    assert "PooledParameter(name='zeta'" in printed
    assert "(16, 16)" in printed


def test_load_and_frf_match_the_command(record, workspace):
    own = load_record(workspace / "session.mcap")
    np.testing.assert_array_equal(record.torque_nm, own.torque_nm)
    np.testing.assert_array_equal(
        api.frf(record).response, estimate(own, WelchSettings())[0].response
    )
    whole = api.frf(record, WelchSettings(estimator="fft"))
    assert whole.estimator == "fft"


@pytest.mark.fit
def test_fit_by_either_method(record):
    fixed, band_hz = ("delay_s",), (0.0, 30.0)
    (found,) = api.fit(record, ["III"], fixed=fixed, band_hz=band_hz).fits
    measurement = Measurement.from_record(record)
    (own,) = fit_record(
        measurement, [STRUCTURES["III"]], fixed_settings=fixed, band_hz=band_hz
    ).fits
    assert found.parameters == own.parameters
    assert "delay_s" not in found.interval
    paper = api.fit(record, ["I", "III"], method="welch", weightings=["omega"], band_hz=(1.0, 40.0))
    assert [model.fit.structure.name for model in paper.models] == ["I", "III"]
    assert {model.fit.weighting for model in paper.models} == {"omega"}
    assert paper.response.frequency_hz[-1] <= 40.0


def test_wrong_use_is_reported(record, workspace):
    with pytest.raises(ValueError, match="no model type 'VIII', 'x'; choose from I, II"):
        api.fit(record, ["III", "VIII", "x"])
    with pytest.raises(ValueError, match="no method 'bayes'; choose 'record' or 'welch'"):
        api.fit(record, method="bayes")
    with pytest.raises(ValueError, match="cannot be fixed"):
        api.fit(record, ["I"], fixed=("alpha",))
    with pytest.raises((SessionError, RecordError), match=r"none\.mcap"):
        api.load(workspace / "none.mcap")


def test_names_are_imported_lazily_at_the_top():
    for name in analysis.__all__:
        assert getattr(analysis, name) is getattr(api, name)
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = analysis.nothing
    code = (
        "import sys, analysis.api; from analysis import campaign, load, fit; "
        "heavy = {'numpy', 'matplotlib', 'rigd.session', 'analysis.campaigns'}; "
        "assert not heavy & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=300)
