"""Out of a session and into one again: the same numbers, and the same analysis."""

import numpy as np
import pytest
import scipy  # whose parts come on first use
from cases import further
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from analysis.exchange import (
    QUANTITIES,
    ImportPlan,
    export_frf,
    export_record,
    import_record,
    parse_choice,
    read_source,
    read_specimen,
)
from analysis.models import WelchSettings
from analysis.paper import estimate
from analysis.paper.welch_analysis import analyse
from analysis.record import RecordError, load_record
from rigd.session import read_session

pytestmark = pytest.mark.process

FIELDS = tuple(QUANTITIES)
SI = {"angle": "rad", "torque": "N.m", "force": "N"}
SETTINGS = WelchSettings(types=("I",), weightings=("const",), segment_length=6000, nfft=20_000)


@pytest.fixture(scope="module")
def specimen(profile):
    return read_specimen(profile)


def plan_for(specimen, time="time_s:s", segments_s=()):
    channels = {field: parse_choice(f"{field}:{SI[q]}", q) for field, q in QUANTITIES.items()}
    return ImportPlan(channels, specimen, parse_choice(time, "time"), segments_s=dict(segments_s))


@st.composite
def sessions(draw):
    """Samples with any finite numbers, and with gaps."""
    length = draw(st.integers(21, 60))
    number = st.floats(-1e6, 1e6)
    steps = np.ones(length, dtype=np.int64)
    steps[draw(st.integers(1, length - 1))] += draw(st.integers(0, 40))
    columns = {field: draw(arrays(np.float64, length, elements=number)) for field in FIELDS[:4]}
    columns["tx_nm"] = draw(arrays(np.float64, length, elements=number))
    return {"tick": np.cumsum(steps) - 1, **columns}


def regular(length):
    """Samples without gaps, all 0."""
    return {"tick": np.arange(length), **{field: np.zeros(length) for field in FIELDS}}


# The folder is the same for every example, and every file in it a new one.
@settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
    max_examples=20,
)
@example(samples=regular(40), rate_hz=333.3)  # six digits of the period are too few
@given(samples=sessions(), rate_hz=st.sampled_from([1000.0, 1024.0, 333.3, 5e4]))
@pytest.mark.parametrize("suffix", [".csv", further(".mat"), further(".uff")])
def test_exported_record_is_imported_unchanged(
    make_session, specimen, tmp_path, suffix, samples, rate_hz
):
    if suffix == ".uff":
        pytest.importorskip("pyuff", reason="UFF58 needs pyuff")
    for path in tmp_path.iterdir():
        path.unlink()
    session = make_session(metadata={"rate_hz": repr(rate_hz)}, **samples)
    exported = tmp_path / f"a{suffix}"
    export_record(session, exported, binary=suffix == ".uff")
    time = "abscissa:s" if suffix == ".uff" else "time_s:s"
    import_record(exported, tmp_path / "again.mcap", plan_for(specimen, time))
    before, after = read_session(session), read_session(tmp_path / "again.mcap")
    for field in ("t_ns", "tick", *FIELDS):
        np.testing.assert_array_equal(after.samples[field], before.samples[field], err_msg=field)
    assert after.metadata["rate_hz"] == before.metadata["rate_hz"]
    for key in ("beam_length_m", "beam_density_kg_per_m", "beam_bending_stiffness_n_m2"):
        assert after.metadata[key] == before.metadata[key]


@pytest.mark.fit
def test_imported_record_has_the_same_analysis(simulated, specimen, tmp_path):
    record = load_record(simulated)
    export_record(str(simulated), str(tmp_path / "a.csv"))
    segments_s = {"rest": (0, 0.5), "sweep": (0.5, 20.5), "ring_down": (20.5, 21.5)}
    import_record(
        tmp_path / "a.csv", tmp_path / "a.mcap", plan_for(specimen, segments_s=segments_s)
    )
    again = load_record(tmp_path / "a.mcap")
    for one, other in zip(estimate(record, SETTINGS), estimate(again, SETTINGS), strict=True):
        np.testing.assert_array_equal(one.frequency_hz, other.frequency_hz)
        np.testing.assert_array_equal(one.response, other.response)
    one, other = (analyse(each, SETTINGS) for each in (record, again))
    assert one.models[0].fit.parameters == other.models[0].fit.parameters


def test_record_in_other_units_agrees_to_rounding(simulated, specimen, tmp_path):
    record = load_record(simulated)
    samples = read_session(simulated).samples
    source = tmp_path / "a.csv"
    columns = (
        1e3 * np.arange(len(samples)) / record.rate_hz,
        np.degrees(samples["angle_rad"]),
        -1e3 * samples["coupling_torque_nm"],
    )
    np.savetxt(source, np.column_stack(columns), "%.17g", ";", header="t;q;T", comments="")
    plan = ImportPlan(
        {
            "angle_rad": parse_choice("q:deg", "angle"),
            "coupling_torque_nm": parse_choice("T:N.mm", "torque"),
        },
        specimen,
        parse_choice("t:ms", "time"),
        segments_s={"rest": (0, 0.5), "sweep": (0.5, 20.5)},
        reverse_torque=True,
    )
    done = import_record(source, tmp_path / "a.mcap", plan)
    assert done.warnings == ()
    (one, _), (other, _) = (
        estimate(each, SETTINGS) for each in (record, load_record(tmp_path / "a.mcap"))
    )
    np.testing.assert_allclose(one.response, other.response, rtol=1e-9)


@pytest.fixture
def response(simulated):
    return estimate(load_record(simulated), SETTINGS)[0]


def test_response_as_csv(simulated, response, tmp_path):
    export_frf(str(simulated), str(tmp_path / "f.csv"), SETTINGS)
    names = (
        "frequency_hz", "response_real_nm_per_rad", "response_imaginary_nm_per_rad", "coherence"
    )  # fmt: skip
    assert (tmp_path / "f.csv").read_text().splitlines()[0] == ",".join(names)
    _, channels = read_source(tmp_path / "f.csv", names)
    frequency, real, imaginary, _ = (channels[name].values for name in names)
    np.testing.assert_array_equal(frequency, response.frequency_hz)
    np.testing.assert_array_equal(real + 1j * imaginary, response.response)


def test_response_as_mat(simulated, response, tmp_path):
    export_frf(simulated, tmp_path / "f.mat", SETTINGS)
    contents = scipy.io.loadmat(tmp_path / "f.mat", squeeze_me=True)
    np.testing.assert_array_equal(contents["frequency_hz"], response.frequency_hz)
    np.testing.assert_array_equal(contents["response_nm_per_rad"], response.response)
    information = contents["information"]
    assert information["estimator"] == "h1"
    assert information["segment_length_samples"] == 6000
    assert information["session_file"] == simulated.name


def test_one_transform_of_the_whole_record_has_no_coherence(simulated, tmp_path):
    table = export_frf(simulated, tmp_path / "f.csv", WelchSettings(estimator="fft"))
    assert [column.name for column in table.columns] == ["response_nm_per_rad"]
    assert "nfft_samples" not in table.information


def test_mat_preserves_integers_and_metadata(simulated, tmp_path):
    export_record(simulated, tmp_path / "r.mat")
    contents = scipy.io.loadmat(tmp_path / "r.mat", squeeze_me=True)
    samples = read_session(simulated).samples
    for field in ("tick", "status", *FIELDS):
        np.testing.assert_array_equal(contents[field], samples[field])
    assert contents["tick"].dtype == np.uint32
    assert contents["information"]["excitation"] == "chirp"
    information, stated = contents["information"], read_session(simulated).metadata
    assert information["segment_sweep_ticks"].item().tolist() == [500, 20500]
    assert information["beam_density_kg_per_m"] == float(stated["beam_density_kg_per_m"])
    assert information["start_utc_ns"] == int(stated["start_utc_ns"])
    assert information["id"] == stated["id"]


def test_user_metadata_stay_texts_in_mat(make_session, tmp_path):
    added = {"note": "12", "specimen": "7", "meta_batch": "007", "meta_length_m": "0.98"}
    path = make_session("a.mcap", metadata=added, **regular(3))
    export_record(path, tmp_path / "r.mat")
    information = scipy.io.loadmat(tmp_path / "r.mat", squeeze_me=True)["information"]
    metadata = {key: information[key].item() for key in added}
    assert metadata == {"note": "12", "specimen": "7", "meta_batch": "007", "meta_length_m": 0.98}


def test_part_of_a_record(paper_file, tmp_path):
    """Also one that contains nothing of the sweep."""
    whole = read_session(paper_file).samples
    for part_s, ticks in (((None, 0.5), slice(0, 500)), ((130.0, None), slice(130_000, None))):
        table = export_record(paper_file, tmp_path / f"{ticks.start}.csv", part_s=part_s)
        columns = {column.name: column.values for column in table.columns}
        np.testing.assert_array_equal(columns["tick"], whole["tick"][ticks])
        np.testing.assert_array_equal(columns["angle_rad"], whole["angle_rad"][ticks])
    with pytest.raises(RecordError, match="beyond the record"):
        export_record(paper_file, tmp_path / "c.csv", part_s=(100.0, 200.0))
    assert not (tmp_path / "c.csv").exists()
