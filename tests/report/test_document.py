import json
import math
from dataclasses import replace

import pytest

from analysis.report import document, document_text
from analysis.results import RecordResult

pytestmark = pytest.mark.fit


def by_welch(analysis):
    return RecordResult(analysis.record, welch=analysis)


@pytest.fixture(scope="module")
def content(paper_analysis):
    return document([by_welch(paper_analysis)], {"bad.mcap": "bad.mcap is empty."})


def test_fits_have_the_keys_of_the_format(content, paper_file):
    assert len(content["fits"]) == 6
    for fit in content["fits"]:
        assert fit["file"] == str(paper_file)
        assert fit["estimator"] == "welch"
        assert fit["weighting"] in ("const", "omega")
        assert set(fit["parameters"]) == {"zeta", "alpha", "gamma", "lambda"}
        assert fit["std"] is None or set(fit["std"]) == set(fit["parameters"])
        assert set(fit["indices"]) == {"mse", "wmse", "md"}
        assert fit["cost"] > 0
    assert [fit["type"] for fit in content["fits"]] == ["I", "I", "III", "III", "VI", "VI"]


def test_numbers_are_those_of_the_analysis(content, paper_analysis):
    for fit, model in zip(content["fits"], paper_analysis.models, strict=True):
        assert fit["parameters"] == model.fit.parameters
        assert fit["indices"]["wmse"] == model.indices.wmse


def test_modes_and_peaks(content):
    assert len(content["modes"]) == 18
    third = [m for m in content["modes"] if m["type"] == "VI" and m["mode"] == 3]
    assert {m["weighting"] for m in third} == {"const", "omega"}
    for mode in third:
        assert mode["frequency_hz"] == pytest.approx(44.8, abs=0.2)
        assert mode["damping_ratio"] == pytest.approx(0.01, rel=0.2)
        assert mode["natural_frequency_rad_s"] == pytest.approx(281.6, abs=1.0)
        assert mode["peak_frequency_deviation_rad_s"] < 1.0
    assert [peak["mode"] for peak in content["peaks"]] == [1, 2, 3]
    assert [peak["frequency_hz"] for peak in content["peaks"]] == pytest.approx(
        [2.57, 16.01, 44.8], rel=5e-3
    )
    assert content["peaks"][1]["magnitude_db"] == pytest.approx(30.6, abs=0.3)


def test_files_versions_and_errors(content):
    (file,) = content["files"]
    assert file["settings"]["segments"] == 8
    assert file["settings"]["bins"] == 7907
    assert file["settings"]["nfft"] == 160_000
    assert (file["samples"], file["rate_hz"]) == (136_000, 1000.0)
    assert (file["sweep_first"], file["sweep_end"]) == (1000, 121_000)
    assert file["beam_length_m"] == 0.98
    assert file["gaps"]["missing_ticks"] == 0
    assert file["warnings"] == []
    assert set(content["versions"]) >= {"rigd", "python", "numpy"}
    assert content["errors"] == [{"file": "bad.mcap", "message": "bad.mcap is empty."}]


def test_document_is_json_without_nan(content, paper_analysis):
    assert json.loads(document_text(content)) == content
    model = paper_analysis.models[0]
    fit = replace(model.fit, std={**model.fit.parameters, "zeta": math.nan}, cost=math.inf)
    broken = replace(
        paper_analysis, peaks=(None,) * 3,
        models=(replace(model, fit=fit, modes=(), peaks=(None,) * 3, deviations=(None,) * 3),),
    )  # fmt: skip

    def refuse(constant):
        raise AssertionError(constant)

    read = json.loads(document_text(document([by_welch(broken)])), parse_constant=refuse)
    assert read["fits"][0]["std"]["zeta"] is None
    assert read["fits"][0]["cost"] is None
    assert all(mode["frequency_hz"] is None for mode in read["modes"])
    assert all(peak["magnitude_db"] is None for peak in read["peaks"])
