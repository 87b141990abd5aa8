"""The examples of docs/exchange.md run as written, on files as the document describes them."""

import re
import shlex
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import scipy  # whose parts come on first use

from analysis.exchange import ExchangeError, parse_choice, read_specimen
from rigd.session import read_session
from rigd.session.limits import MAX_SAMPLES

pytestmark = pytest.mark.process

DOCUMENT = (Path(__file__).parents[2] / "docs" / "exchange.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```$", DOCUMENT, re.MULTILINE | re.DOTALL)


@pytest.fixture
def third_party_files(simulated, tmp_path):
    """The simulated session as four other programs would have recorded it, with 1 s of rest."""
    nptdms = pytest.importorskip("nptdms", reason="the document imports a TDMS file")
    pyuff = pytest.importorskip("pyuff", reason="the document imports a universal file")
    samples = read_session(simulated).samples
    indices = np.clip(np.arange(-500, 21_500), 0, None)
    angle, torque = samples["angle_rad"][indices], samples["coupling_torque_nm"][indices]
    time_s = np.arange(len(indices)) * 1e-3
    np.savetxt(
        tmp_path / "log.csv", np.column_stack([1e3 * time_s, np.degrees(angle), 1e3 * torque]),
        "%.17g", ";", header="t;Shaft [deg];Tz", comments="",
    )  # fmt: skip
    wrench = np.column_stack([samples[name][indices] for name in ("fx_n", "fy_n", "fz_n")] * 2)
    wrench[:, 5] = torque
    log = {"t": time_s, "angle": angle, "wrench": wrench}
    scipy.io.savemat(tmp_path / "log.mat", {"log": log}, oned_as="column")
    with nptdms.TdmsWriter(str(tmp_path / "log.tdms")) as writer:
        for name, values, unit in (("Angle", np.degrees(angle), "deg"), ("Tz", -torque, "Nm")):
            properties = {"unit_string": unit, "wf_increment": 1e-3}
            writer.write_segment([nptdms.ChannelObject("Rig", name, values, properties)])
    for title, values in (("Angle", angle), ("Tz", torque)):
        function = pyuff.prepare_58(
            binary=0, func_type=1, rsp_node=1, rsp_dir=1, ref_node=1, ref_dir=1, data=values,
            x=time_s, id1=title, rsp_ent_name="R", ref_ent_name="R", abscissa_spacing=1,
            abscissa_spec_data_type=17, ordinate_spec_data_type=1, orddenom_spec_data_type=0,
        )  # fmt: skip
        pyuff.UFF(str(tmp_path / "log.uff")).write_sets(function, "add")
    return angle, torque


@pytest.mark.further  # parsed in tests/docs
def test_every_example_runs_as_written(analyze, third_party_files, tmp_path, monkeypatch, capsys):
    angle, torque = third_party_files
    (profile,), shells, (python, _, _) = blocks("toml"), blocks("sh"), blocks("python")
    (tmp_path / "beam.toml").write_text(profile)
    monkeypatch.chdir(tmp_path)
    for line in "".join(shells).splitlines():
        program, *arguments = shlex.split(line)
        result = analyze(*arguments)
        assert (program, result.exit_code, result.stderr) == ("analyze", 0, ""), result.output
    for name in ("csv", "mat", "tdms", "uff"):
        session = read_session(tmp_path / f"from_{name}.mcap")
        np.testing.assert_allclose(session.samples["angle_rad"], angle, rtol=1e-10)
        np.testing.assert_allclose(session.samples["coupling_torque_nm"], torque, rtol=1e-10)
        assert session.metadata["imported_from"] == f"log.{name}"
        assert session.segments["sweep"] == (1000, 21000)
        assert session.events == []
    assert (tmp_path / "from_csv.report").is_dir()
    exec(python, {})
    frequency_hz, decibels = re.findall(r"[\d.]+", capsys.readouterr().out)
    assert float(frequency_hz) == pytest.approx(16.1, abs=0.3)  # second mode of the paper's antenna
    assert 25 < float(decibels) < 40


@pytest.fixture
def exported_models(simulated, analyze, tmp_path, monkeypatch):
    """Models as the document's examples read them, in the current folder."""
    monkeypatch.chdir(tmp_path)
    options = ("--beam", "--samples", 2, "--order", 14)
    for name in ("antenna.npz", "antenna.mat"):
        result = analyze("export", "model", simulated, name, *options)
        assert result.exit_code == 0, result.output


@pytest.mark.further  # the content is tested in test_model_export.py
def test_the_examples_read_a_model(simulated, analyze, exported_models, capsys):
    _, with_numpy, with_control = blocks("python")
    exec(with_numpy, {})
    assert "torque per angle: [" in capsys.readouterr().out
    in_discrete_time = 's = np.exp(1j * omega * float(model["Ts"]))'
    assert in_discrete_time in DOCUMENT
    options = ("--beam", "--samples", 0, "--order", 14, "--rate", 1000)
    assert analyze("export", "model", simulated, "sampled.npz", *options).exit_code == 0
    example = with_numpy.replace("antenna", "sampled").replace("s = 1j * omega", in_discrete_time)
    continuous, sampled = {}, {}
    exec(with_numpy, continuous)
    exec(example, sampled)
    responses = [each["torque_per_acceleration"] for each in (continuous, sampled)]
    np.testing.assert_allclose(*np.abs(responses), rtol=1e-2)
    pytest.importorskip("control", reason="an example reads a model with python-control")
    exec(with_control, {})
    assert re.search(r"1[47] poles", capsys.readouterr().out)  # 3 of a delay, if it is positive


@pytest.mark.further
def test_the_example_for_octave_reads_a_model(exported_models):
    octave = shutil.which("octave-cli")
    if octave is None:
        pytest.skip("Octave is not installed")
    (example,) = blocks("octave")
    done = subprocess.run(
        [octave, "--norc", "--eval", f"pkg load control\n{example}"],
        check=False, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "beam: 14 states, 2 samples" in done.stdout


def test_the_document_has_every_unit_and_the_limits(tmp_path):
    for quantity in ("angle", "torque", "force", "time"):
        (row,) = re.findall(rf"^\| {quantity} \| (.*) \|$", DOCUMENT, re.MULTILINE)
        with pytest.raises(ExchangeError) as refusal:
            parse_choice("channel:furlong", quantity)
        units = ", ".join(re.findall(r"`([^`]+)`", row))
        assert f"choose from {units}. " in str(refusal.value)
    assert f"more than {MAX_SAMPLES / 1e6:g} million samples" in DOCUMENT
    assert "no more than 800 MB" in DOCUMENT  # as test_hostile_files.py has it
    (profile,) = blocks("toml")
    (tmp_path / "beam.toml").write_text(profile)
    assert read_specimen(tmp_path / "beam.toml").beam.length_m == 0.98
