"""Models of an analysis as matrices: accuracy, formats, other programs, refusals."""

import dataclasses
import json
import shutil
import subprocess

import numpy as np
import pytest
from cases import further
from scipy.io import loadmat
from scipy.signal import StateSpace, cont2discrete, lsim
from typer.testing import CliRunner

from analysis.cli.app import app
from analysis.exchange import export_model
from analysis.identify import ModalModel
from analysis.linear_model import ModelOptions, identify_session, linear_model
from rigd.beam import Beam, Damping, Plant
from rigd.identified_beam import IdentifiedBeamError

BAND_HZ = (0.05, 100.0)
RELATIVE_STD = 1e-3
NOMINAL = {
    "zeta": 7e-5, "alpha": 0.9, "gamma": 0.05, "lambda": 0.6,
    "density_over_stiffness": 0.052, "bending_stiffness_n_m2": 0.09, "delay_s": 1.2e-3,
    "tool_inertia_kg_m2": 2e-4, "root_compliance_rad_per_nm": 0.05,
    "second_order_filter_time_constant_s": 8e-4,
}  # fmt: skip
LENGTH_M = 0.98
FEW = ("--samples", 0, "--order", 14)
LOGARITHMIC_PARAMETERS = ("zeta", "gamma", "density_over_stiffness", "bending_stiffness_n_m2")
MODAL = ModalModel(
    (complex(-0.2, 16.0), complex(-0.9, 101.0), complex(-3.0, 282.0)),
    (complex(0.05, -1.9), complex(1.0, -12.0), complex(4.0, -33.0)),
    (0.01, 1e-3, 1.6e-4, 1e-7, 2e-9),
)
MODAL_STD = {"ln_frequency": 1e-4, "ln_damping_ratio": 2e-2, "ln_residue": 3e-3} | {
    "residue_phase_rad": 2e-3
}
MODAL_NAMES = [f"{name}_{mode}" for mode in (1, 2, 3) for name in MODAL_STD]
MODAL_NAMES += [f"background_{power}" for power in range(5)]
MODAL_VARIANCE = (
    np.array([*list(MODAL_STD.values()) * 3, *(0.01 * np.array(MODAL.background))]) ** 2
)


def slow(*values):
    """Return parameters of a test that only `make test-all` runs."""
    return pytest.param(*values, marks=pytest.mark.slow)


def random_beam(seed):
    """Parameters of a beam with all that a rig may have at its ends and in its channels."""
    rng = np.random.default_rng(seed)
    return {
        "zeta": 10 ** rng.uniform(-5.5, -3.5),
        "alpha": rng.uniform(0.3, 1.3),
        "gamma": 10 ** rng.uniform(-2.5, -0.3),
        "lambda": rng.uniform(0.3, 1.3),
        "density_over_stiffness": 0.052 * np.exp(rng.normal(0, 0.4)),
        "bending_stiffness_n_m2": 0.09 * np.exp(rng.normal(0, 0.4)),
        "delay_s": rng.uniform(-1e-3, 4e-3),
        "tool_inertia_kg_m2": 10 ** rng.uniform(-5, -3),
        "tip_mass_kg": rng.choice([0.0, 1e-4, 5e-4]),
        "root_compliance_rad_per_nm": rng.choice([0.0, 0.02, 0.2]),
        "filter_time_constant_s": rng.choice([0.0, 1e-3]),
    }


def exact(values, s):
    """Response from angle to torque, from the beam's exact model and not from the export."""
    stiffness = values["bending_stiffness_n_m2"]
    beam = Plant(
        Beam(LENGTH_M, values["density_over_stiffness"] * stiffness, stiffness),
        Damping(values["zeta"], values["alpha"], values["gamma"], values["lambda"]),
        tip_mass_kg=values.get("tip_mass_kg", 0.0),
        root_compliance_rad_per_nm=values.get("root_compliance_rad_per_nm", 0.0),
    )
    torque = beam.transfer(s) + values["tool_inertia_kg_m2"] * s**2
    x = values.get("filter_time_constant_s", 0.0) * s
    y = values.get("second_order_filter_time_constant_s", 0.0) * s
    return torque * np.exp(-values["delay_s"] * s) / (1 + x) / (1 + np.sqrt(2) * y + y**2)


def document(values=NOMINAL, *, gate="passed", covariance=True, modal=True, **more):
    """Results of one session, as `analyze --json` writes them."""
    names = [
        f"ln_{name}" if name in LOGARITHMIC_PARAMETERS else name
        for name in NOMINAL
        if name in values
    ]
    sizes = [1.0 if name.startswith("ln_") else values[name] for name in names]
    headline = {
        "file": "a.mcap",
        "parameters": {name: {"value": value, "flag": None} for name, value in values.items()},
        "modes": [],
        "named": [],
        "validity": {"uniform_beam": {"status": gate, "p_value": 0.25}},
    }
    if covariance is True:
        matrix = np.diag((RELATIVE_STD * np.array(sizes)) ** 2).tolist()
        covariance = {"names": names, "matrix": matrix}
    if covariance:
        headline["covariance"] = covariance
    if modal:
        headline["modal_model"] = {
            **MODAL.as_json(),
            "names": MODAL_NAMES,
            "modes": [1, 2, 3],
            "covariance": np.diag(MODAL_VARIANCE).tolist(),
        }
    return {
        "files": [{"file": "a.mcap", "beam_length_m": LENGTH_M}],
        "records": [{"file": "a.mcap", "band_hz": [0.0, 50.0]}],
        "headlines": [headline | more],
    }


@pytest.fixture
def export(analyze, tmp_path):
    """Export from a document, and return the result of the command."""

    def run(content, name, *options):
        source = tmp_path / "model.json"
        source.write_text(json.dumps(content))
        return analyze("export", "model", source, tmp_path / name, *options)

    return run


@pytest.fixture(scope="module")
def nominal(tmp_path_factory):
    """A model with 50 samples of its posterior and 20 states."""
    folder = tmp_path_factory.mktemp("nominal")
    (folder / "model.json").write_text(json.dumps(document()))
    arguments = ["export", "model", folder / "model.json", folder / "model.npz", "--order", 20]
    result = CliRunner().invoke(app, list(map(str, arguments)))
    assert result.exit_code == 0, result.output
    with np.load(folder / "model.npz", allow_pickle=False) as file:
        return dict(file)


@pytest.fixture
def exported(export, tmp_path):
    """Export to a file for NumPy, and return its variables."""

    def run(content, *options, name="model.npz"):
        result = export(content, name, *options)
        assert result.exit_code == 0, result.output
        with np.load(tmp_path / name, allow_pickle=False) as file:
            return dict(file)

    return run


def sampled(model, k, frequency_hz):
    """Response of one sample of the posterior."""
    one = {name: model[f"{name}_samples"][k] for name in "ABCD"}
    return response(one | {"delay_s": model["delay_samples_s"][k]}, frequency_hz)


def response(model, frequency_hz):
    """Response of the loaded matrices to the angle, with the delay."""
    s = 2j * np.pi * frequency_hz
    a, b, c, d = (model[name] for name in "ABCD")
    states = np.linalg.solve(s[:, None, None] * np.eye(len(a)) - a, b + 0j)
    motion = np.array([np.ones_like(s), s, s**2])[-b.shape[1] :]
    return ((c @ states + d)[:, 0] * motion.T).sum(axis=1) * np.exp(-model["delay_s"] * s)


@pytest.mark.parametrize(
    ("seed", "given"),
    [
        (0, "acceleration"),
        (4, "angle"),
        *(further(seed, "acceleration") for seed in range(1, 7)),
        *(further(seed, "angle") for seed in range(3)),
        *(slow(seed, "acceleration") for seed in range(7, 20)),
        *(slow(seed, "angle") for seed in range(3, 20) if seed != 4),
    ],
)
def test_chosen_order_is_accurate_to_a_thousandth(exported, seed, given):
    values = random_beam(seed)
    model = exported(document(values, modal=False), "--input", given, "--samples", 0)
    frequency_hz = np.geomspace(*BAND_HZ, 5000)
    error = np.abs(response(model, frequency_hz) / exact(values, 2j * np.pi * frequency_hz) - 1)
    assert error.max() < 1e-3
    assert error.max() < 1.05 * model["error_max"]
    assert model["order"] == len(model["A"]) < 40
    assert np.linalg.eigvals(model["A"]).real.max() < 1e-9
    assert model["delay_s"] == values["delay_s"]
    np.testing.assert_allclose(
        model["response_nm_per_rad"], exact(values, 2j * np.pi * model["frequency_hz"]), rtol=1e-9
    )


def test_inputs_outputs_and_states_have_names_and_units(nominal, exported):
    model = nominal
    assert model["inputs"].tolist() == ["motor_acceleration"]
    assert model["input_units"].tolist() == ["rad/s^2"]
    assert model["outputs"].tolist() == ["coupling_torque"]
    assert model["output_units"].tolist() == ["N.m"]
    assert len(model["states"]) == len(model["state_units"]) == model["order"]
    assert model["states"][:2].tolist() == ["mode_1_a", "mode_1_b"]
    angle = exported(document(), "--samples", 0, "--input", "angle", "--order", 12)
    assert angle["inputs"].tolist() == ["motor_angle", "motor_velocity", "motor_acceleration"]
    assert angle["B"].shape == (angle["order"], 3)


def test_requested_number_of_states_has_its_error_stated(nominal, exported, export):
    best = nominal
    fewer = exported(document(), "--samples", 0, "--order", 14, name="fewer.npz")
    assert fewer["order"] == 14 < best["order"]
    frequency_hz = np.geomspace(*BAND_HZ, 3000)
    true = exact(NOMINAL, 2j * np.pi * frequency_hz)
    error = np.abs(response(fewer, frequency_hz) / true - 1).max()
    assert best["error_max"] < error < 1.05 * fewer["error_max"]
    refused = export(document(), "x.npz", "--order", 100)
    assert refused.exit_code == 1
    assert "may have 2 to" in refused.stderr


def test_a_rate_holds_the_input_exactly(nominal, exported):
    continuous = nominal
    held = exported(document(), "--samples", 2, "--rate", 500, "--order", 20)
    assert held["Ts"] == pytest.approx(2e-3)
    assert continuous["Ts"] == 0
    for suffix in ("", "_samples"):
        matrices = [continuous[name + suffix] for name in "ABCD"]
        others = [held[name + suffix] for name in "ABCD"]
        if suffix:
            matrices, others = ([each[1] for each in them] for them in (matrices, others))
        for mine, theirs in zip(
            others, cont2discrete(matrices, 2e-3, method="zoh")[:4], strict=True
        ):
            np.testing.assert_allclose(mine, theirs, atol=1e-12)


def test_posterior_samples_have_the_same_states(nominal):
    model = nominal
    n = int(model["order"])
    assert model["A_samples"].shape == (50, n, n)
    assert model["parameter_samples"].shape == (50, len(model["parameter_names"]))
    names = model["parameter_names"].tolist()
    assert {"ln_zeta", "alpha", "delay_s"} <= set(names)
    np.testing.assert_array_equal(model["A_samples"] != 0, model["A"][None] != np.zeros((50, 1, 1)))
    frequency_hz = np.geomspace(0.5, 90, 300)
    for k in (0, 17, 49):
        drawn = dict(zip(names, model["parameter_samples"][k].tolist(), strict=True))
        values = {
            each: np.exp(drawn[f"ln_{each}"]) if f"ln_{each}" in drawn else drawn.get(each, value)
            for each, value in NOMINAL.items()
        }
        np.testing.assert_allclose(
            sampled(model, k, frequency_hz), exact(values, 2j * np.pi * frequency_hz), rtol=3e-3
        )
    frequency_hz = model["frequency_hz"]
    spread = np.std([sampled(model, k, frequency_hz) for k in range(50)], axis=0)
    ratio = spread / np.abs(model["response_nm_per_rad"]) / model["uncertainty"]
    assert np.median(ratio) == pytest.approx(1.0, abs=0.2)
    assert model["uncertainty_max"] == model["uncertainty"].max() > 3 * model["uncertainty_median"]


def test_every_format_has_the_same_variables(exported, export, tmp_path):
    options = ("--samples", 3, "--order", 16)
    npz = exported(document(), *options)
    assert export(document(), "model.mat", *options).exit_code == 0
    assert export(document(), "model_out.json", *options).exit_code == 0
    mat = loadmat(tmp_path / "model.mat", squeeze_me=True)
    text = json.loads((tmp_path / "model_out.json").read_text())
    assert npz.keys() == text.keys() == {name for name in mat if not name.startswith("__")}
    for name, values in npz.items():
        np.testing.assert_array_equal(np.squeeze(values), mat[name], err_msg=name)
        listed = np.array(text[name], dtype=values.real.dtype)
        if values.dtype.kind == "c":
            listed = listed[..., 0] + 1j * listed[..., 1]
        np.testing.assert_array_equal(values, listed, err_msg=name)
    head = (tmp_path / "model.mat").read_bytes()[:124]
    assert head.startswith(b"MATLAB 5.0 MAT-file")  # the format of MATLAB's version 7
    np.testing.assert_array_equal(npz["poles_rad_s"], MODAL.poles_rad_s)
    np.testing.assert_array_equal(npz["residues_nm_per_s"], MODAL.residues)
    np.testing.assert_array_equal(npz["background"], MODAL.background)


@pytest.mark.parametrize("given", ["acceleration", further("angle")])
def test_modal_model_is_exported_for_a_refused_beam(exported, given):
    model = exported(document(gate="refused"), "--input", given)
    assert model["model"] == "modal"
    assert model["band_hz"].tolist() == [0.05, 50.0]
    frequency_hz = np.geomspace(0.05, 50.0, 5000)
    true = MODAL.response(2j * np.pi * frequency_hz)
    error = np.abs(response(model, frequency_hz) / true - 1)
    assert error.max() < min(1e-3, 1.05 * model["error_max"])
    assert np.linalg.eigvals(model["A"]).real.max() < 1e-9
    for mode, pole in enumerate(MODAL.poles_rad_s):
        block = model["A"][2 * mode : 2 * mode + 2, 2 * mode : 2 * mode + 2]
        assert np.linalg.eigvals(block).imag.max() == pytest.approx(pole.imag)
    drawn = np.log(model["A_samples"][:, 0, 1])
    assert drawn.std() == pytest.approx(1e-4, rel=0.3)
    damping = -model["A_samples"][:, 2, 2] / 101.0
    assert np.log(damping).std() == pytest.approx(2e-2, rel=0.3)
    assert model["parameter_names"].tolist() == MODAL_NAMES
    frequency_hz = model["frequency_hz"]
    std = np.std([sampled(model, k, frequency_hz) for k in range(50)], axis=0)
    ratio = std / np.abs(MODAL.response(2j * np.pi * frequency_hz)) / model["uncertainty"]
    assert np.median(ratio) == pytest.approx(1.0, abs=0.2)


def test_beam_is_exported_on_request_with_its_doubts(export, exported):
    result = export(document(gate="refused"), "beam.npz", "--beam", *FEW)
    assert result.exit_code == 0
    assert "Note: whether a uniform beam predicts the modes: refused" in result.stdout
    assert "exact beam" in result.stdout
    parameters = {name: {"value": value, "flag": None} for name, value in NOMINAL.items()}
    parameters["alpha"]["flag"] = "not identifiable"
    parameters["drag"] = {"value": 1e-3, "flag": None}
    parameters["clock_rate_difference"] = {"value": -1e-5, "flag": None}  # of older versions
    named = [
        {"what": "soft stiffness", "sentence": "It softens."},
        {"what": "clock rate difference", "sentence": "Clocks differ."},
    ]
    result = export(document(parameters=parameters, named=named), "b.npz", *FEW)
    assert result.exit_code == 0
    for words in (
        "flagged by the analysis: alpha", "drag is not part", "soft stiffness (It soft",
        "clock_rate_difference is not part", "clock rate difference (Clocks differ)",
    ):  # fmt: skip
        assert words in result.stdout


@pytest.mark.parametrize("gate", ["passed", "refused"])
def test_air_drag_that_was_fitted_with_the_modes_is_noted(exported, gate):
    drag = {"what": "air drag", "value": 2.3e-3, "sentence": "Air drag acts."}
    model = exported(document(gate=gate, named=[drag]), *FEW)
    assert model["model"] == ("beam" if gate == "passed" else "modal")
    assert model["notes"].tolist() == ["not part of the model: air drag (Air drag acts)"]
    uncertain = document(gate=gate, named=[drag | {"value": None}])
    assert exported(uncertain, *FEW, name="uncertain.npz")["notes"].tolist() == []


def test_effects_that_were_found_are_noted_for_a_modal_model(exported):
    parameters = {name: {"value": value, "flag": None} for name, value in NOMINAL.items()}
    parameters["drag"] = {"value": 1e-3, "flag": None}
    named = [
        {"what": "air drag", "value": 1e-3, "sentence": "Air drag acts."},
        {"what": "soft stiffness", "sentence": "It softens."},
    ]
    model = exported(document(gate="refused", parameters=parameters, named=named), *FEW)
    assert model["notes"].tolist() == [
        "drag is not part of the model: the drag of the air grows with the amplitude",
        "not part of the model: soft stiffness (It softens)",
    ]


def test_exact_beam_is_used_if_its_covariance_is_stated(exported):
    other = NOMINAL | {"density_over_stiffness": 0.0521}
    block = document(other)["headlines"][0]
    exact_geometry = {"parameters": block["parameters"], "covariance": block["covariance"]}
    model = exported(document(exact_geometry=exact_geometry), "--samples", 0, "--order", 22)
    frequency_hz = np.geomspace(*BAND_HZ, 500)
    true = exact(other, 2j * np.pi * frequency_hz)
    np.testing.assert_allclose(response(model, frequency_hz), true, rtol=2e-3)


@pytest.mark.parametrize("gate", ["passed", "refused"])
def test_pooled_result_of_a_campaign_is_exported(exported, gate):
    values = NOMINAL | {"density_over_stiffness": 0.0521}
    (single,) = document()["headlines"]
    (pooled,) = document(values, gate=gate, file=None)["headlines"]
    files = ("a.mcap", "b.mcap")
    content = {
        "files": [{"file": file, "beam_length_m": LENGTH_M} for file in files],
        "settings": {"record_band_hz": [2.0, 40.0]},
        "headlines": [*(single | {"file": file} for file in files), pooled],
    }
    model = exported(content, "--samples", 0)
    if gate == "passed":
        assert model["model"] == "beam"
        frequency_hz = np.geomspace(*BAND_HZ, 500)
        true = exact(values, 2j * np.pi * frequency_hz)
        np.testing.assert_allclose(response(model, frequency_hz), true, rtol=2e-3)
    else:
        assert model["model"] == "modal"
        assert model["band_hz"].tolist() == [2.0, 40.0]


def test_the_summary_has_a_line_for_each_statement(export):
    result = export(document(), "model.npz", "--rate", 1000, *FEW)
    assert result.stderr == ""
    lines = result.stdout.splitlines()
    assert [line.partition(":")[0] for line in lines] == [
        "Model", "Order", "Input", "Output", "Error", "Data", "Samples",
    ]  # fmt: skip
    assert "1000 Hz" in lines[1]
    assert "1.2 ms; the delay is not in the matrices" in lines[3]
    assert "0.05 to 100 Hz" in lines[4]


WRONG_MODAL = {**MODAL.as_json(), "poles_rad_s": [[1.0, 16.0]] * 3}


@pytest.mark.parametrize(
    ("content", "options", "code", "words"),
    [
        (document(covariance=None), (), 1, ("headlines[0] has no covariance", "--samples 0")),
        (document(gate="refused", modal=False), (), 1, ("no modal_model", "--beam")),
        (document(validity={}, modal=False), (), 1, ("no modal_model", "older version")),
        (document(gate="refused", modal_model=WRONG_MODAL), (), 1, ("negative real",)),
        (document(gate="refused", modal_model={"poles_rad_s": 3}), (), 1, ("not a modal model",)),
        (document(parameters={}), (), 1, ("density_over_stiff",)),
        (document({**NOMINAL, "alpha": 3.0}), (), 1, ("alpha.value = 3.0", "below 2")),
        (document({**NOMINAL, "stiffness": 3.0}), (), 1, ("not known to this version",)),
        (
            document({**NOMINAL, "stiffness_offset_51": 0.01}),
            (), 1, ("stiffness_offset_51 is of a mode beyond the band",),
        ),
        (document() | {"files": []}, (), 1, ("beam_length_m",)),
        (
            document(covariance={"names": ["ln_zeta"], "matrix": [[-1.0]]}),
            (), 1, ("positive semidefinite",),
        ),
        (
            document(covariance={"names": ["ln_zeta"], "matrix": [[1.0, 2.0]]}),
            (), 1, ("square matrix",),
        ),
        (document(covariance={"names": ["ln_q"], "matrix": [[1.0]]}), (), 1, ("'ln_q'",)),
        (
            document(covariance={"names": ["lambda"], "matrix": [[1e6]]}),
            (), 1, ("too uncertain", "--samples 0"),
        ),
        ({"headlines": document()["headlines"] * 2}, (), 1, ("results of 2 sessions",)),
        ({"fits": []}, (), 1, ("headlines[0].parameters",)),
        (document(), ("--order", "none"), 2, ("--order", "auto")),
        (document(), ("--rate", "0"), 2, ("--rate", "continuous")),
        (document(), ("--input", "torque"), 2, ("--input", "acceleration, angle")),
        (document(), ("--samples", "-1"), 2, ("--samples",)),
    ],
)  # fmt: skip
def test_impossible_export_is_refused_in_one_sentence(
    export, tmp_path, content, options, code, words
):
    result = export(content, "model.npz", *options)
    assert result.exit_code == code, result.output
    for word in words:
        assert word in result.stderr
    assert "Traceback" not in result.output
    assert not (tmp_path / "model.npz").exists()


def test_python_takes_texts_as_paths_and_needs_no_options(tmp_path):
    source, target = tmp_path / "results.json", tmp_path / "model.npz"
    source.write_text(json.dumps(document()))
    model = export_model(str(source), str(target))
    assert target.exists()
    assert model.options == ModelOptions()
    assert len(repr(model)) < 1000


def test_nothing_is_overwritten_and_endings_are_known(export, analyze, tmp_path):
    (tmp_path / "old.mat").write_text("mine")
    result = export(document(), "old.mat")
    assert (result.exit_code, (tmp_path / "old.mat").read_text()) == (2, "mine")
    assert "nothing is overwritten" in result.stderr
    result = export(document(), "model.txt")
    assert result.exit_code == 2
    assert ".json, .npz, .mat" in result.stderr
    result = analyze("export", "model", tmp_path / "none.json", tmp_path / "a.npz")
    assert result.exit_code == 1
    assert "none.json: cannot be read" in result.stderr


@pytest.mark.parametrize(
    "values",
    [
        pytest.param(NOMINAL | {"zeta": 0.0, "gamma": 0.0}, id="undamped"),
        pytest.param(NOMINAL | {"gamma": 0.7, "lambda": 1.1}, id="over-damped first mode"),
        further(NOMINAL | {"zeta": 1e-3, "alpha": 1.0, "gamma": 0.0}, id="over-damped high modes"),
        further(NOMINAL | {"density_over_stiffness": 2.0}, id="modes close together"),
    ],
)
def test_unusual_beams_are_accurate_too(exported, values):
    content = document(values, covariance=None)
    model = exported(content, "--samples", 0)
    frequency_hz = np.geomspace(*BAND_HZ, 2000)
    true = exact(values, 2j * np.pi * frequency_hz)
    assert np.abs(response(model, frequency_hz) / true - 1).max() < 1e-3


@pytest.fixture(scope="module")
def identified(simulated):
    return identify_session(simulated)


@pytest.mark.process
def test_session_is_analysed_for_the_export(simulated, identified, analyze, tmp_path, monkeypatch):
    found = {simulated: identified}
    monkeypatch.setattr("analysis.linear_model.identify_session", found.__getitem__)
    result = analyze("export", "model", simulated, tmp_path / "a.npz", "--samples", 2)
    assert result.exit_code == 0, result.output
    assert f"exact beam of {simulated}" in result.stdout
    with np.load(tmp_path / "a.npz") as file:
        model = dict(file)
    poles = np.linalg.eigvals(model["A"])
    first = poles[np.argmin(np.abs(poles - 16.05j))]
    assert first.imag / (2 * np.pi) == pytest.approx(2.554, abs=0.03)  # of the paper's antenna
    assert 0 < model["uncertainty_median"] < 0.1
    assert model["source"] == simulated.name


@pytest.mark.process
def test_beam_and_modal_model_agree_within_uncertainty(identified):
    found = identified
    assert found.uniform_beam_test.status == "passed"
    beam = linear_model(found, ModelOptions(order=20, posterior_sample_count=0))
    unreadable = found.headline | {"validity": {"uniform_beam": {"status": "refused"}}}
    with pytest.raises(IdentifiedBeamError, match=r"validity\.uniform_beam"):
        linear_model(
            dataclasses.replace(found, headline=unreadable), ModelOptions(posterior_sample_count=0)
        )
    refused = found.headline | {
        "validity": {"uniform_beam": {"status": "refused", "p_value": 1e-9}}
    }
    modal = linear_model(
        dataclasses.replace(found, headline=refused),
        ModelOptions(order=14, posterior_sample_count=0),
    )
    assert (beam.kind, modal.kind) == ("beam", "modal")
    assert modal.system.states.names[0] == "mode_1_a"
    by_modal, by_beam = modal.accuracy, beam.accuracy
    inner = (by_modal.frequency_hz > 1.0) & (by_modal.frequency_hz < 45.0)
    frequency_hz = by_modal.frequency_hz[inner]
    difference = response(beam.variables(), frequency_hz) / by_modal.response[inner] - 1
    assert np.sqrt(np.mean(np.abs(difference / by_modal.relative_std[inner]) ** 2)) < 2.5
    # The modal model assumes less, so it knows less.
    assert np.median(by_modal.relative_std[inner]) > 1.5 * by_beam.median_relative_std
    at_mode = np.argmin(np.abs(frequency_hz - 16.0))
    assert by_modal.relative_std[inner][at_mode] < 0.1


@pytest.mark.process
@pytest.mark.further
def test_a_session_and_its_document_give_the_same_model(simulated, analyze, tmp_path):
    written = tmp_path / "results.json"
    done = analyze(
        simulated, "--method", "record", "--json", written, "--report", tmp_path / "report"
    )
    assert done.exit_code == 0, done.output
    for name, source in (("a", simulated), ("b", written)):
        result = analyze(
            "export", "model", source, tmp_path / f"{name}.npz", "--beam", "--samples", 2
        )
        assert result.exit_code == 0, result.output
    with np.load(tmp_path / "a.npz") as one, np.load(tmp_path / "b.npz") as other:
        for matrix in ("A", "B", "C", "D", "A_samples", "delay_s", "uncertainty"):
            np.testing.assert_array_equal(one[matrix], other[matrix])


# Other programs


TIME_S = np.arange(2001) * 1e-3


def scipy_step(model):
    system = StateSpace(*(model[name] for name in "ABCD"))
    _, torque_nm, _ = lsim(system, np.ones(TIME_S.size), TIME_S)
    return torque_nm


def test_python_control_reads_it(exported):
    control = pytest.importorskip("control", reason="python-control reads the exported model")
    model = exported(document(), *FEW)
    system = control.ss(*(model[name] for name in "ABCD"), float(model["Ts"]))
    torque_nm = control.step_response(system, TIME_S).outputs
    expected = scipy_step(model)
    assert np.abs(torque_nm - expected).max() < 1e-9 * np.abs(expected).max()


_OCTAVE = """
pkg load control
s = load("model.mat");
system = ss(s.A, s.B, s.C, s.D);
[y, t] = step(system, (0:2000)' * 1e-3);
names = strjoin(s.states', ",");
count = [size(s.A_samples), numel(s.poles_rad_s)];
save("-v7", "out.mat", "y", "names", "count");
"""


@pytest.mark.process
def test_octave_reads_it(exported, export, tmp_path):
    octave = shutil.which("octave-cli")
    if octave is None:
        pytest.skip("Octave with its package control is not installed (octave, octave-control)")
    options = ("--samples", 2, "--order", 16)
    model = exported(document(), *options)
    assert export(document(), "model.mat", *options).exit_code == 0
    done = subprocess.run(
        [octave, "--norc", "--eval", _OCTAVE],
        check=False, cwd=tmp_path, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    if "control" in done.stderr and "not installed" in done.stderr:
        pytest.skip("Octave's package control is not installed (octave-control)")
    assert done.returncode == 0, done.stderr
    read = loadmat(tmp_path / "out.mat", squeeze_me=True)
    expected = scipy_step(model)
    assert np.abs(read["y"] - expected).max() < 1e-9 * np.abs(expected).max()
    assert str(read["names"]).split(",") == model["states"].tolist()
    n = int(model["order"])
    assert read["count"].tolist() == [2, n, n, 3]
