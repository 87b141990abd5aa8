"""The beam of an analysis, from its JSON document."""

import pytest

from rigd.identified_beam import IdentifiedBeamError, read_identified_beam
from rigd.profile import load_profile


@pytest.fixture
def profile():
    return load_profile("sim")


def test_the_beam_of_an_analysis_is_read(analysed, profile):
    found = read_identified_beam(analysed(), profile.rig.beam.length_m)
    assert found.damping == profile.rig.damping
    assert found.beam.density_kg_per_m == pytest.approx(profile.rig.beam.density_kg_per_m)
    assert found.frequency_uncertainty == pytest.approx(1e-4)
    undamped = read_identified_beam(analysed(zeta=None, alpha=None), 0.98)
    assert undamped.damping.zeta == 0.0


@pytest.mark.parametrize(
    ("other", "says"),
    [
        ({"density_over_stiffness": None}, "density_over_stiffness is missing"),
        ({"zeta": {"value": -1.0, "std": 0.0}}, r"zeta\.value = -1\.0 must be"),
        ({"alpha": {"value": 2.5, "std": 0.0}}, r"alpha\.value = 2\.5 must be .* below 2"),
        ({"bending_stiffness_n_m2": {"value": 0, "std": 0}}, "more than 0 N·m²"),
        ({"gamma": 3}, r"gamma\.value = null"),
        ({"gamma": {"value": 10**400, "std": 0.0}}, r"gamma\.value = 1000.* must be"),
    ],
)
def test_what_is_wrong_with_the_document_is_said(analysed, other, says):
    with pytest.raises(IdentifiedBeamError, match=says) as refused:
        read_identified_beam(analysed(**other), 0.98)
    assert "model.json" in str(refused.value)


@pytest.mark.parametrize(
    "text", ["", "[]", '{"headlines": []}', '{"headlines": [{}]}', '{"headlines": 3}', "\x00"]
)
def test_a_file_that_is_no_document_is_refused(tmp_path, text):
    path = tmp_path / "model.json"
    path.write_text(text)
    with pytest.raises(IdentifiedBeamError, match="analyze session"):
        read_identified_beam(path, 0.98)
    with pytest.raises(IdentifiedBeamError, match="cannot be read"):
        read_identified_beam(tmp_path / "none.json", 0.98)
