"""Whether sessions are of one specimen: by metadata, and by the modes of the records."""

import math
import xml.etree.ElementTree as ET
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from analysis.campaigns import SessionFailure, campaign, specimen_sentences
from analysis.record_part import RecordSource
from analysis.report import campaign_document
from analysis.report.campaign_report import campaign_page, campaign_text, write_campaign
from rigd.beam import undamped_frequencies_rad_s

pytestmark = pytest.mark.fit

STIFFER = 1.03


def with_modes(estimate, *modes):
    return replace(estimate, fit=replace(estimate.fit, modes=modes))


@pytest.fixture
def of_frequencies(make_session, make_estimate, campaign_of):
    """Sessions whose first mode has these frequencies in Hz, each of its own std."""

    def found(values, std):
        sessions = []
        for number, (value, own) in enumerate(np.broadcast(values, std)):
            estimate = make_estimate("I", {"zeta": 1e-4}, [[1e-4]], ("zeta",))
            mode = replace(estimate.fit.modes[0], frequency_hz=value, frequency_std_hz=own)
            sessions.append(make_session(f"{number}.mcap", estimates=[with_modes(estimate, mode)]))
        return campaign_of(sessions).homogeneity

    return found


def test_scatter_by_hand(of_frequencies):
    """Two at -5 and two at 5 standard deviations: Q is 100 of 3, tau² = (100 - 3) / 3."""
    found = of_frequencies([2.45, 2.55, 2.45, 2.55], 0.01)
    frequency = found.leading_scatter
    assert frequency.quantity == "frequency_hz_1"
    assert frequency.cochran_q == pytest.approx(100.0)
    assert frequency.relative_between_session_std == pytest.approx(math.sqrt(97 / 3))
    assert frequency.between_session_std == pytest.approx(0.01 * math.sqrt(97 / 3))
    assert frequency.i_squared == pytest.approx(0.97)
    assert frequency.session_groups == (("0.mcap", "2.mcap"), ("1.mcap", "3.mcap"))
    assert found.is_mixture
    assert not found.is_mixed("damping_ratio_1")  # the same of all
    assert not found.scatter_of("damping_ratio_1").is_mixture
    sentence, where = specimen_sentences.describe_specimens(found)
    assert sentence.startswith(
        "The sessions are not of one specimen in one state: frequency of mode 1"
    )
    assert "5.69 of its own standard deviations" in sentence
    assert "2.450 Hz in 2 files (0.mcap, 2.mcap); 2.550 Hz in 2 files" in where


def test_repeatable_sessions_are_of_one_specimen(of_frequencies):
    """Of 100 campaigns of five: one false alarm in a hundred, and as many more as chance has it."""
    rng = np.random.default_rng(3)
    alarms = sum(of_frequencies(rng.normal(2.5, 0.01, 5), 0.01).is_mixture for _ in range(100))
    assert alarms <= 3


def test_scatter_within_uncertainty_is_no_mixture(of_frequencies):
    """The case of the random-effects model: significant in many, but no other specimen."""
    rng = np.random.default_rng(4)
    found = [of_frequencies(rng.normal(2.5, 0.015, 20), 0.01) for _ in range(20)]
    assert sum(each.scatter_of("frequency_hz_1").p_value < 0.01 for each in found) > 10
    assert not any(each.is_mixture for each in found)


def test_one_different_session_of_twenty_is_reported(of_frequencies):
    """Its fraction of the variance is small, the gap is not."""
    values = np.random.default_rng(5).normal(2.5, 0.01, 20)
    values[7] = 2.62
    found = of_frequencies(values, 0.01)
    assert found.leading_scatter.i_squared < 0.9
    assert found.leading_scatter.session_groups[1] == ("7.mcap",)
    assert "1 file (7.mcap)" in specimen_sentences.describe_specimens(found)[1]


@pytest.mark.parametrize(("distance_hz", "slight"), [(0.002, True), (0.02, False)])
def test_many_standard_deviations_may_be_a_slight_change(of_frequencies, distance_hz, slight):
    """Both differ by 20 standard deviations, but by 0.08 % and 0.8 % of the frequency."""
    values = [2.5, 2.5, 2.5 + distance_hz, 2.5 + distance_hz]
    found = of_frequencies(values, distance_hz / 20)
    assert found.is_mixture
    sentences = " ".join(specimen_sentences.describe_specimens(found))
    assert ("temperature or clamp changes" in sentences) == slight


@pytest.mark.parametrize(
    ("values", "parts"),
    [
        ([0.0, 50.0], ()),  # which of two is the other one?
        ([0.0, 1.0, 50.0], ((0, 1), (2,))),
        ([100.0, 0.0, 50.0, 51.0, 1.0, 101.0], ((1, 4), (2, 3), (0, 5))),
        ([0.0, 10.0, 20.0, 30.0, 40.0, 50.0], ()),
    ],
)
def test_groups_are_reported_only_with_clear_gaps(of_frequencies, values, parts):
    found = of_frequencies(2.5 + 1e-3 * np.array(values), 1e-3)
    names = tuple(tuple(f"{number}.mcap" for number in part) for part in parts)
    assert found.scatter_of("frequency_hz_1").session_groups == names


def test_files_of_one_name_in_two_folders_are_distinct(make_session, make_estimate, campaign_of):
    sessions = []
    for folder, value in zip("abcd", (2.5, 2.6, 2.5, 2.6), strict=True):
        estimate = make_estimate("I", {"zeta": 1e-4}, [[1e-4]], ("zeta",))
        mode = replace(estimate.fit.modes[0], frequency_hz=value, frequency_std_hz=1e-3)
        sessions.append(make_session(f"/{folder}/x.mcap", estimates=[with_modes(estimate, mode)]))
    found = campaign_of(sessions).homogeneity
    _, where, *_ = specimen_sentences.describe_specimens(found)
    assert "2.500 Hz in 2 files (a/x.mcap, c/x.mcap); 2.600 Hz in 2 files" in where


def test_files_are_grouped_by_stated_specimen(make_session, make_experiment, campaign_of):
    results = [
        replace(make_session(name), experiment=make_experiment(name, tool_inertia_kg_m2=inertia))
        for name, inertia in (("a", 0.0), ("b", 1e-5), ("c", 0.0))
    ]
    torn = SessionFailure(RecordSource(Path("torn")), "torn is incomplete.")
    found = campaign_of([*results[:2], torn, results[2]]).homogeneity
    first, second = found.specimens
    assert (first.file_names, second.file_names) == (("a", "c"), ("b",))
    (sentences,) = specimen_sentences.describe_specimens(found)
    assert (
        "2 different specimens: tool_inertia_kg_m2 0 kg·m² in 2 files (a, c); tool_inertia_kg_m2 "
        in sentences
    )
    assert "1e-05 kg·m² in 1 file (b)" in sentences


@pytest.fixture(scope="module")
def mixture(
    short_sessions, other_beam, make_file, truth, settings, tmp_path_factory, in_this_process
):
    """Two of one beam, two of a stiffer one that states to be the same, one that states another."""
    folder = tmp_path_factory.mktemp("stiffer")
    link, damping = truth
    stiffness = link.bending_stiffness_n_m2
    stiff = replace(link, bending_stiffness_n_m2=STIFFER * stiffness)
    others = [
        make_file(
            folder / f"stiff{seed}.mcap", seed, stiff, damping,
            beam_bending_stiffness_n_m2=repr(stiffness),
        )
        for seed in (20, 21)
    ]  # fmt: skip
    paths = [*short_sessions[:2], *others, other_beam]
    with in_this_process():
        return campaign(
            paths, replace(settings, types=("I",)), structures=("III", "IV"), uniformity=0.0
        )


@pytest.mark.further  # as made by hand above
def test_verdict_begins_with_several_specimens(mixture):
    stated, differing, where, _, structure, *_ = mixture.verdict.sentences
    assert "2 different specimens: beam_length_m 0.98 m in 4 files (0.mcap, 1.mcap" in stated
    assert "beam_length_m 1 m in 1 file (longer.mcap)" in stated
    assert "all results below are for beam_length_m 0.98 m" in stated
    assert differing.startswith("The sessions are not of one specimen in one state: frequency of")
    assert "in 2 files (0.mcap, 1.mcap)" in where
    assert "in 2 files (stiff20.mcap, stiff21.mcap)" in where
    assert structure.startswith("The numbers are those of type VI")
    assert "Type III has the lowest BIC" in structure
    assert not any("between-session variance (Coch" in each for each in mixture.verdict.sentences)
    assert campaign_text(mixture).startswith("The files state 2 different specimens")


@pytest.mark.further  # as made by hand above
def test_distance_of_groups_is_that_of_their_frequencies(mixture, truth):
    """Frequencies go with the root of the stiffness: the truth, not the estimate, is the peer."""
    link, _ = truth
    (first_rad_s,) = undamped_frequencies_rad_s(link, 1)
    distance_hz = first_rad_s / (2 * np.pi) * (math.sqrt(STIFFER) - 1)
    frequency = mixture.homogeneity.scatter_of("frequency_hz_1")
    values = {name: value for name, value, _ in frequency.session_estimates}
    soft, stiff = (np.mean([values[name] for name in part]) for part in frequency.session_groups)
    # The difference of two means of two: as uncertain as one session.
    own_hz = math.sqrt(np.mean([std**2 for _, _, std in frequency.session_estimates]))
    assert stiff - soft == pytest.approx(distance_hz, abs=3 * own_hz)
    # Of two equal groups at a distance d the variance of four is d²/3, nearly all between sessions.
    assert frequency.between_session_std == pytest.approx((stiff - soft) / math.sqrt(3), rel=0.01)
    assert frequency.relative_between_session_std > 8


@pytest.mark.further  # as made by hand above
def test_agreeing_quantities_are_not_marked_as_a_mixture(mixture, tmp_path):
    """Both beams are damped alike; their stiffness is not the same."""
    rows = [row for row in campaign_document(mixture)["pooled"] if row["type"] == "III"]
    mixed = {row["parameter"] for row in rows if row["mixture"]}
    assert "density_over_stiffness" in mixed
    assert not mixed & {"zeta", "gamma", "delay_s"}
    text = campaign_text(mixture)
    assert "ρ/EI (10⁻³ s²/m⁴) ‡" in text
    assert "ζ (10⁻⁵ s^α) ‡" not in text
    assert "(Table 3), of a mixture" in text
    write_campaign(mixture, tmp_path / "report", with_paper_values=False)
    texts = ET.parse(tmp_path / "report" / "figures" / "pooled.svg").iter(
        "{http://www.w3.org/2000/svg}text"
    )
    titles = {"".join(text.itertext()).split(" ")[0] for text in texts}
    assert titles >= {"ρ/EI‡", "ζ", "γ"}


@pytest.mark.further  # as made by hand above
def test_page_and_json_report_the_mixture(mixture):
    content = campaign_document(mixture)
    assert content["one_specimen"] is False
    assert content["groups"]["files"] == [["0.mcap", "1.mcap"], ["stiff20.mcap", "stiff21.mcap"]]
    assert [row["files"] for row in content["specimens"]] == [4, 1]
    assert {row["mixture"] for row in content["table3"]} == {True}
    page = campaign_page(mixture, (), datetime.now(UTC), with_paper_values=False)
    assert page.index("The files state") < page.index("type VI: internal damping")
    for name in ("specimens", "homogeneity"):
        assert f'id="{name}"' in page
        assert content[name]


@pytest.mark.further  # as made by hand above
def test_unselected_structure_has_its_row(mixture):
    """Type IV has no external damping: the internal one is driven to the edge of its range."""
    rows = {each.name: each for each in mixture.structures}
    four = rows["IV"]
    assert (four.fitted_sessions, four.selecting_sessions, four.is_pooled) == (4, 0, False)
    assert four.determining_sessions < 2
    assert four.bic_above_lowest > 1000
    assert sum(each.selecting_sessions for each in mixture.structures) == 4
    tables = campaign_document(mixture)
    (written,) = (row for row in tables["structures"] if row["type"] == "IV")
    assert (written["fitted"], written["selected_alone"]) == (4, 0)
    pooled = [row for row in tables["pooled"] if row["type"] == "IV"]
    assert [row["parameter"] for row in pooled] == ["zeta", "alpha"]
    assert {(row.get("value"), row["reported"]) for row in pooled} == {(None, False)}
    (line,) = (each for each in campaign_text(mixture).splitlines() if each.startswith("IV "))
    assert line.split()[1:3] == ["4", str(four.determining_sessions)]
