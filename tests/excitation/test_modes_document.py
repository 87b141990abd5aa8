"""The modes' document: values that are read, and messages on invalid ones."""

import json
import os
import sys
from pathlib import Path

import pytest
import warm_start
from operated_daemons import RequestError, parse_request

from rigd.excitation import ExcitationError
from rigd.excitation._narrow_sweeps import FoundMode, read_modes
from rigd.session import read_session


def test_modes_come_lowest_first_with_two_deviations(document):
    path = document(
        [
            {"frequency_hz": 16.0, "damping_ratio": 0.004, "frequency_std_hz": 0.01, "mode": 2},
            {"frequency_hz": 2.58, "damping_ratio": 0.009, "unheard_of": {"more": [1]}},
        ],
        fits=[{"type": "VI"}],
    )
    assert read_modes(path) == (FoundMode(2.58, 0.009, 0.0), FoundMode(16.0, 0.004, 0.02))


def test_one_bad_fit_of_a_mode_has_no_effect(document):
    frequencies = [16.0, 16.01, 16.02, 16.03, 17.2]
    ratios = [0.004, 0.005, 0.0045, 0.005, 0.04]
    entries = [
        {"frequency_hz": f, "damping_ratio": r, "estimator": "welch"}
        for f, r in zip(frequencies, ratios, strict=True)
    ]
    (mode,) = read_modes(document(entries))
    assert (mode.frequency_hz, mode.damping_ratio) == (16.02, 0.005)
    assert mode.uncertainty_hz == pytest.approx(2 * 1.4826 * 0.01, rel=1e-6)


def test_whole_record_fits_are_preferred(document):
    entries = [
        {"frequency_hz": 16.5, "damping_ratio": 0.02, "estimator": "welch"},
        {"frequency_hz": 16.0, "damping_ratio": 0.004, "estimator": "record"},
    ]
    assert read_modes(document(entries)) == (FoundMode(16.0, 0.004, 0.0),)


def test_modes_of_the_modal_model_are_preferred(document):
    """Which are of beams, and may be off by more than the width of a mode."""
    reported = {
        "frequency_hz": {"value": 16.3, "std": 0.01, "flag": None},
        "damping_ratio": {"value": 0.004, "std": 1e-5},
        "source": "modal",
    }
    path = document(
        [{"frequency_hz": 16.0, "damping_ratio": 0.02}], headlines=[{"modes": [reported]}]
    )
    assert read_modes(path) == (FoundMode(16.3, 0.004, 0.02),)
    unknown = reported | {"damping_ratio": {"value": "small"}}
    path = document([], headlines=[{"modes": [reported, unknown]}])
    with pytest.raises(
        ExcitationError, match=r"headlines\[0\]\.modes\[1\]\.damping_ratio\.value = "
    ):
        read_modes(path)


def test_modes_missing_from_a_fit_are_skipped(document):
    entries = [
        {"frequency_hz": None, "damping_ratio": None},
        {"frequency_hz": 0.0, "damping_ratio": 1.3},
        {"frequency_hz": 2.6, "damping_ratio": 0.01},
    ]
    assert [mode.frequency_hz for mode in read_modes(document(entries))] == [2.6]


@pytest.mark.parametrize(
    ("modes", "words"),
    [
        ([], ("no mode that oscillates", "analyze")),
        ({}, ("modes = {}", "list")),
        ([3], ("modes[0] = 3", "frequency_hz and damping_ratio")),
        ([{"damping_ratio": 0.1}], ("modes[0].frequency_hz is missing",)),
        ([{"frequency_hz": 2.6}], ("modes[0].damping_ratio is missing",)),
        (
            [{"frequency_hz": 2.6, "damping_ratio": 0.1}, {"frequency_hz": -2, "damping_ratio": 1}],
            ("modes[1].frequency_hz = -2 Hz", "not be negative"),
        ),
        (
            [{"frequency_hz": 2.6, "damping_ratio": 0}],
            ("modes[0].damping_ratio = 0", "more than 0"),
        ),
        (
            [{"frequency_hz": "low", "damping_ratio": 0.1}],
            ('modes[0].frequency_hz = "low"', "number in Hz"),
        ),
        (
            [{"frequency_hz": float("inf"), "damping_ratio": 0.1}],
            ("modes[0].frequency_hz", "finite"),
        ),
    ],
)
def test_bad_value_is_reported_with_its_remedy(document, modes, words):
    path = document(modes)
    with pytest.raises(ExcitationError) as refused:
        read_modes(path)
    text = str(refused.value)
    assert text.startswith(f"{path}: ")
    assert all(word in text for word in words), text
    assert len(text) < 400 + len(str(path))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", ("not a JSON document", "analyze")),
        (b"{", ("not a JSON document",)),
        (b"[]", ("not a JSON object", "modes")),
        (b'{"fits": []}', ("modes is missing",)),
        (b"\xff\xfe\x00", ("UTF-8",)),
        (b"[" * 100_000, ("nested",)),
        (b'{"modes": [{"frequency_hz": ' + b"9" * 5000 + b"}]}", ("JSON",)),
    ],
)
def test_other_document_is_refused(tmp_path, content, words):
    path = tmp_path / "fits.json"
    path.write_bytes(content)
    with pytest.raises(ExcitationError) as refused:
        read_modes(path)
    assert str(path) in str(refused.value)
    assert all(word in str(refused.value) for word in words), str(refused.value)


def test_special_file_is_refused(tmp_path):
    with pytest.raises(ExcitationError, match="cannot be read"):
        read_modes(tmp_path / "nothing.json")
    with pytest.raises(ExcitationError, match=r"cannot be read|not a file"):
        read_modes(tmp_path)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ExcitationError, match="not a file"):
        read_modes(tmp_path / "pipe")


@pytest.mark.process
@pytest.mark.further  # its plan is tested below
def test_session_runs_and_reports_its_excitation(document, tmp_path):
    command = [sys.executable, "-m", "rigd", "run", "modes", str(document()), "--fast", "--json"]
    command += ["--duration", "14", "--ring-down", "1", "--output", str(tmp_path)]
    done = warm_start.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    (session,) = json.loads(done.stdout)["sessions"]
    assert (session["outcome"], session["recorded"]) == ("complete", 16_000)
    metadata = read_session(Path(session["path"])).metadata
    assert metadata["excitation"] == "modes"
    assert metadata["bands"].count(" Hz, ") == 3
    assert metadata["duration_s"] == "14.0"


def test_command_refuses_in_one_sentence(rigd_here, tmp_path):
    done = rigd_here("run", "modes", tmp_path / "no.json", "--fast")
    assert done.returncode == 2
    assert "no.json: cannot be read" in done.stderr
    assert "Traceback" not in done.stderr


def test_daemon_takes_options_without_a_rig(document):
    def parsed_request(**parameters):
        request = {"command": "start", "excitation": "modes", "parameters": parameters}
        return parse_request(json.dumps(request).encode())

    path = document()
    assert parsed_request(path=str(path), widths=2).parameters == {"path": path, "widths": 2.0}
    with pytest.raises(RequestError, match=r"rig.* is not a parameter of modes.*amplitude_rad"):
        parsed_request(path=str(path), rig="/dev/null")
    with pytest.raises(RequestError, match=r"parameters\.path is missing"):
        parsed_request()
