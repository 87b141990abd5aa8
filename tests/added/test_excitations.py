"""An excitation in one file outside: command line, socket, page, file and analysis take it."""

import asyncio
import json
import sys

import aiohttp
import numpy as np
import pytest
from operated_daemons import RequestError, parse_request
from packages import EXCITATION, install, rigd_with

from analysis.applicability import welch_exclusion_reason
from analysis.record import load_record
from rigd.excitation import KINDS, ExcitationError, excitation_options, make_excitation
from rigd.plugins import PluginError, check_plugin, find_plugin, installed_plugins
from rigd.session import read_session

GROUP = "rigd.excitations"


@pytest.fixture
def packages(tmp_path, monkeypatch):
    """Folder in which the package with the excitation is installed."""
    folder = tmp_path / "site"
    install(
        folder, "lab-signals", "0.4", EXCITATION, f"[{GROUP}]\ntriangle = lab_signals:TRIANGLE\n"
    )
    monkeypatch.syspath_prepend(folder)
    yield folder
    sys.modules.pop("lab_signals", None)


def test_added_excitation_is_made_by_name(packages):
    assert "triangle" in KINDS
    assert list(KINDS)[-1] == "triangle"
    excitation = make_excitation("triangle", {"amplitude_rad": 0.02}, rate_hz=1000)
    assert excitation.kind == "triangle"
    assert np.ptp(excitation.reference_rad) == pytest.approx(0.02)
    assert excitation.segments["sweep"] == (500, 4500)
    assert excitation.parameters["period_s"] == 1.0


def test_options_are_declared_for_form_and_command(packages):
    options = {option.name: option for option in excitation_options("triangle")}
    assert list(options) == ["amplitude_rad", "period_s", "duration_s", "rest_s", "ring_down_s"]
    assert options["amplitude_rad"].help == "peak of the triangle"
    assert (options["amplitude_rad"].unit, options["amplitude_rad"].default) == ("rad", 0.01)
    assert options["rest_s"].value_type is float
    for name in ("rest_s", "ring_down_s"):  # declared once for all
        helps = {
            each.help for kind in KINDS for each in excitation_options(kind) if each.name == name
        }
        assert helps == {options[name].help}


def test_form_of_the_page_offers_it(packages, request):
    served = request.getfixturevalue("served")  # started with the package installed

    async def hello():
        async with (
            aiohttp.ClientSession(f"http://127.0.0.1:{served.port}/") as session,
            session.ws_connect("/api/live") as socket,
        ):
            for _ in range(9):
                for line in (await socket.receive(30.0)).data.split("\n"):
                    message = json.loads(line)
                    if message["type"] == "hello":
                        return message
        raise AssertionError("no hello")

    triangle = asyncio.run(hello())["excitations"]["triangle"]
    assert triangle[0] == {
        "name": "amplitude_rad", "unit": "rad", "default": 0.01, "help": "peak of the triangle",
    }  # fmt: skip


def test_socket_accepts_it_with_its_parameters(packages):
    request = {"command": "start", "excitation": "triangle", "parameters": {"period_s": 2}}
    assert parse_request(json.dumps(request).encode()).parameters == {"period_s": 2.0}
    for parameters, message in (
        ({"period": 2}, "is not a parameter of triangle; choose from amplitude_rad, period_s"),
        ({"period_s": "2"}, "period_s"),
    ):
        wrong = json.dumps(request | {"parameters": parameters}).encode()
        with pytest.raises(RequestError, match=message):
            parse_request(wrong)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("amplitude_rad", 0.5, "amplitude_rad = 0.5 rad must be less than or equal to 0.1"),
        ("period_s", 0.0, "period_s = 0.0 s must be greater than 0"),
        ("period_s", float("nan"), "period_s = nan s must be"),
        ("duration_s", 1e9, "samples"),
    ],
)
def test_options_out_of_their_range_are_named(packages, name, value, message):
    with pytest.raises(ExcitationError, match=message):
        make_excitation("triangle", {name: value}, rate_hz=1000)


WRONG = {  # code of a package, and the reason that is stated
    "raises": ("raise RuntimeError('no')", "RuntimeError: no"),
    "exits": ("import sys; sys.exit()", "SystemExit"),
    "type": ("TRIANGLE = 'triangle'", "is a str, not a ExcitationKind"),
    "other": (EXCITATION, 'declares the excitation "triangle"'),
    "lacks": (
        EXCITATION.replace('"triangle", "S', '"lacks", "S').replace("rest_s: RestS", "rest: float"),
        "lack rest_s",
    ),
    "range": (
        EXCITATION.replace('"triangle", "S', '"range", "S').replace("= 0.01", "= 0.2"),
        "amplitude_rad = 0.2 rad",
    ),
    "chirp": (EXCITATION.replace('"triangle", "S', '"chirp", "S'), "built into rigd"),
    "shape": (
        EXCITATION.replace('"triangle", "S', '"shape", "S').replace("(phase % 1)", "phase[1:] % 1"),
        "not an array of 4000 finite angles",
    ),
    "fails": (
        EXCITATION.replace('"triangle", "S', '"fails", "S').replace("/ options.period_s", "/ no"),
        "NameError",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_unusable_package_is_named_without_affecting_others(packages, tmp_path, monkeypatch, name):
    code, reason = WRONG[name]
    entry_points = f"[{GROUP}]\n{name} = x_{name}:TRIANGLE\n"
    install(tmp_path / "wrong", f"x-{name}", "0.3", code, entry_points)
    monkeypatch.syspath_prepend(tmp_path / "wrong")
    (plugin,) = [each for each in installed_plugins(GROUP) if each.name == name]
    with pytest.raises((PluginError, ExcitationError), match=reason):
        check_plugin(plugin)
        make_excitation(name, {}, rate_hz=1000)
    assert {"chirp", "triangle"} <= set(KINDS)
    check_plugin(find_plugin(GROUP, "triangle"))
    assert make_excitation("chirp", {}, rate_hz=1000).kind == "chirp"


@pytest.mark.process
def test_commands_and_analysis_support_it(packages, tmp_path, rigd_here):
    done = rigd_here("run", "--help")
    assert done.returncode == 0, done.stderr
    assert "triangle" in done.stdout
    assert "lab-signals 0.4" in done.stdout
    assert "peak of the triangle (rad)." in rigd_here("run", "triangle", "--help").stdout
    done = rigd_here("run", "triangle", "--amplitude", "3", "--fast")
    assert done.returncode == 2
    assert "amplitude_rad = 3.0 rad" in done.stderr
    code, output, errors = rigd_with(
        packages, "run", "triangle", "--amplitude", "0.005", "--duration", "2", "--fast",
        "--seed", "1", "--output", tmp_path / "out", cwd=tmp_path,
    )  # fmt: skip
    assert code == 0, output + errors
    path = next((tmp_path / "out").glob("*-triangle.mcap"))
    metadata = read_session(path).metadata
    assert metadata["excitation"] == "triangle"
    assert metadata["excitation_package"] == "lab-signals 0.4"
    assert metadata["welch_exclusion"].startswith("a triangle excites")
    assert float(metadata["amplitude_rad"]) == 0.005
    # An analysis needs no package.
    assert welch_exclusion_reason(load_record(path)).startswith("a triangle excites")
