"""Files of quick looks: with any content, the values read from them are valid."""

import json
import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from library_folders import mode, quantity
from online_fits import online_fit

from rigd.estimates import modes_from_json
from rigd.session import BeamUniformity, Validity
from rigd.session.quick_look import (
    fit_of,
    last_quick_look,
    quick_look_path,
    read_quick_look,
)
from rigd.view._fits import fit_table_markdown

RESPONSE = {
    "frequency_hz": [1.0, 2.0],
    "magnitude": [3.0, 4.0],
    "phase_rad": [0.1, 0.2],
    "coherence": [0.9, 0.8],
    "resolution_hz": 0.05,
}
MODEL = {
    **{name: RESPONSE[name] for name in ("frequency_hz", "magnitude", "phase_rad")},
    "magnitude_low_95": [2.9, 3.9],
    "magnitude_high_95": [3.1, 4.1],
}


OF_MODAL_MODEL = {"participation": quantity(1.4e-3, 2e-6), "source": "modal"}


def write(folder, name, **members) -> Path:
    path = quick_look_path(folder / f"{name}.mcap")
    path.write_text(json.dumps({"version": 1} | members))
    return path


def test_a_written_file_is_read(tmp_path):
    written = {
        "version": 1, "file": "a.mcap", "session_id": "a", "specimen": "antenna 3",
        "excitation": "chirp", "start_utc_ns": 5, "made_utc_ns": 6, "took_s": 2.5,
        "modes": [{"mode": 2, "shown": False, **mode(2.5), **OF_MODAL_MODEL}],
        "coherence": {"mean": None, "low_bands": []}, "flags": ["clipped"], "against_last": None,
        "response": RESPONSE, "model": MODEL, "text": ["Quick look"],
        "validity": Validity(0.6, 0.12, BeamUniformity("refused", 2e-18)).as_json(),
    }  # fmt: skip
    assert read_quick_look(write(tmp_path, "a", **written)) == written


@pytest.mark.parametrize(
    "stated",
    [None, "0.6", {}, {"predicted_peak_tip_slope_rad": 0.6}, {"predicted_peak_tip_slope_rad": -1.0,
     "linear_model_error": 0.1}, {"predicted_peak_tip_slope_rad": True, "linear_model_error": 0.1},
     {"predicted_peak_tip_slope_rad": 10**400, "linear_model_error": 0.1}],
)  # fmt: skip
def test_an_invalid_validity_is_unknown(tmp_path, stated):
    quick_look = read_quick_look(write(tmp_path, "a", modes=[mode(2.5)], validity=stated))
    assert quick_look["validity"] == Validity().as_json()
    assert "unknown" in quick_look["validity"]["sentence"]


@pytest.mark.parametrize(
    "stated",
    [None, 7, {}, {"status": "perhaps", "p_value": 0.5}, {"status": "passed"}, {"status": []},
     {"status": "refused", "p_value": -1.0}, {"status": "passed", "p_value": "0.5"}],
)  # fmt: skip
def test_an_invalid_test_of_uniformity_is_unknown(tmp_path, stated):
    quick_look = read_quick_look(
        write(tmp_path, "a", modes=[mode(2.5)], validity={"uniform_beam": stated})
    )
    assert quick_look["validity"]["uniform_beam"] is None


@pytest.mark.parametrize(
    ("found", "sentence", "short"),
    [
        (BeamUniformity("passed", 0.4), "A uniform beam predicts the modes (p = 0.4).",
         "yes (p = 0.4)"),
        (BeamUniformity("refused", 2e-18), "A uniform beam does not predict the modes (p = 2e-18): "
         "orders that assume one are not properties of the material.", "no (p = 2e-18)"),
        (BeamUniformity("refused", 0.0), "A uniform beam does not predict the modes (p < 1e-300): "
         "orders that assume one are not properties of the material.", "no (p < 1e-300)"),
        (BeamUniformity("not tested"), "Whether a uniform beam predicts the modes was not tested: "
         "too few modes are determined.", "not tested"),
    ],
)  # fmt: skip
def test_a_test_of_uniformity_is_stated_in_words(found, sentence, short):
    assert (found.sentence, found.short_text) == (sentence, short)
    assert BeamUniformity.from_document(found.as_json()) == found


def test_missing_values_are_empty(tmp_path):
    quick_look = read_quick_look(write(tmp_path, "a"))
    assert (
        quick_look["specimen"],
        quick_look["start_utc_ns"],
        quick_look["modes"],
        quick_look["text"],
    ) == ("", 0, [], [])
    assert quick_look["response"] is None


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b"[1]", b"{}", b'{"version": 2}', b"\xff" * 9, b"[" * 100_000,
     b'{"version": 1, "specimen": 3}', b'{"version": 1, "start_utc_ns": "a"}',
     b'{"version": 1, "text": 7}', b'{"version": 1, "text": [7]}',
     b'{"version": 1, "flags": "' + b"a" * (1 << 20) + b'"}'],
)  # fmt: skip
def test_invalid_files_are_not_read(tmp_path, content):
    path = quick_look_path(tmp_path / "a.mcap")
    path.write_bytes(content)
    assert read_quick_look(path) is None
    assert read_quick_look(tmp_path) is None
    assert read_quick_look(tmp_path / "missing.look.json") is None


@pytest.mark.parametrize(
    "modes",
    [7, [7], [{}], [{"frequency_hz": {"value": "a"}}], [mode(2.5) | {"frequency_hz": None}],
     [mode(-2.5)], [mode(2.5) | {"mode": "first"}],
     [mode(2.5) | {"damping_ratio": {"value": float("nan")}}],
     [mode(2.5) | {"damping_ratio": {"value": float("inf")}}],
     [mode(2.5) | {"damping_ratio": {"value": 10**400}}]],
)  # fmt: skip
def test_modes_without_their_numbers_are_omitted(tmp_path, modes):
    whole = mode(16.0) | {"mode": 2, "shown": True} | OF_MODAL_MODEL
    given = [*modes, whole] if isinstance(modes, list) else modes
    found = read_quick_look(write(tmp_path, "a", modes=given))["modes"]
    assert found == ([whole] if isinstance(modes, list) else [])
    assert [each.as_json() for each in modes_from_json(given)] == found


def test_an_interval_needs_two_numbers():
    (found,) = modes_from_json(
        [mode(2.5) | {"frequency_hz": quantity(2.5, 0.1) | {"interval_95": [2]}}]
    )
    assert (found.frequency_hz.interval_95, found.number, found.shown) == (None, 1, True)


@pytest.mark.parametrize(
    "wrong",
    [{"magnitude": [3.0]}, {"phase_rad": [0.1, None]}, {"frequency_hz": []}, {"magnitude": "34"},
     {"magnitude": [3.0, float("inf")]}],
)  # fmt: skip
def test_a_response_is_whole_or_none(tmp_path, wrong):
    assert read_quick_look(write(tmp_path, "a", response=RESPONSE | wrong))["response"] is None
    without = read_quick_look(write(tmp_path, "b", response=RESPONSE | {"coherence": None}))
    assert without["response"] == RESPONSE | {"coherence": None}


def test_numbers_beyond_all_floats_are_unknown(tmp_path):
    path = quick_look_path(tmp_path / "a.mcap")
    path.write_text('{"version": 1, "took_s": 1e999, "coherence": {"mean": NaN}}')
    quick_look = read_quick_look(path)
    assert (quick_look["took_s"], quick_look["coherence"]) == (None, {"mean": None})


@given(st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(
        st.sampled_from(["version", "modes", "frequency_hz", "damping_ratio", "value", "response",
                         "text", "flags", "specimen", "start_utc_ns", "interval_95", "std"]),
        inner,
    ),
    max_leaves=10,
))  # fmt: skip
def test_any_content_is_read_as_json_or_refused(tmp_path_factory, found):
    folder = tmp_path_factory.getbasetemp()
    members = found if isinstance(found, dict) else {"modes": found, "response": found}
    quick_look = read_quick_look(write(folder, f"any-{os.getpid()}", **members | {"version": 1}))
    if quick_look is not None:
        json.dumps(quick_look, allow_nan=False)


# The last one


def test_the_last_quick_look_is_of_the_latest_session(tmp_path):
    write(tmp_path, "early", start_utc_ns=5, specimen="A", response=RESPONSE)
    write(tmp_path, "late", start_utc_ns=9, specimen="A")
    write(tmp_path, "other", start_utc_ns=8, specimen="B")
    write(tmp_path, "none", start_utc_ns=7)
    quick_look_path(tmp_path / "torn.mcap").write_text("{")

    def last(specimen, usable=bool, **limits):
        found = last_quick_look(tmp_path, specimen, is_usable=usable, **limits)
        return None if found is None else found[0].name

    assert last("A") == "late.mcap"
    assert last("A", excluded_session="late") == last("A", before_utc_ns=9) == "early.mcap"
    assert last("A", usable=lambda quick_look: quick_look["response"]) == "early.mcap"
    assert last("") == "none.mcap"
    assert last("C") is None
    assert last_quick_look(tmp_path / "missing", "A", is_usable=bool) is None


def test_usable_parts_of_a_fit_are_read():
    fit = online_fit(9.5, third="doubtful")
    found = fit_of({"fit": json.dumps(fit)})
    assert found["duration_s"] == 9.5
    assert [each["mode"] for each in found["modes"]] == [1, 2, 3]
    assert found["modes"][2]["damping_ratio"]["flag"] == "It depends on the structure."
    assert found["parameters"].keys() == fit["parameters"].keys()
    targets = found["search"]["targets"]
    assert [each["std"] for each in targets] == [1e-4, None]
    assert [each["quantity"] for each in targets] == ["damping", "damping"]
    assert [each["mode"] for each in targets] == [1, 3]
    assert fit_of(None) is None
    assert fit_of({"outcome": "complete"}) is None


@given(
    st.recursive(
        st.none() | st.floats() | st.text(),
        lambda inner: (
            st.lists(inner, max_size=3)
            | st.dictionaries(st.sampled_from([*online_fit(), "name", "asked_std"]), inner)
        ),
    )
)
def test_invalid_parts_of_a_fit_are_omitted(found):
    for content in (found, online_fit() | found if isinstance(found, dict) else found):
        fit = fit_of({"fit": json.dumps(content)})
        assert fit is None or fit_table_markdown(fit)
