"""A damping structure in one file outside: command line, report and JSON take it."""

import json
import sys

import pytest
from packages import STRUCTURE, install

from analysis.identify import Measurement, fit_structure, select
from analysis.models import Structure
from analysis.record import load_record
from analysis.structures import AddedStructure, added_structures, check_structure
from rigd.beam import Parameter
from rigd.plugins import Plugin, PluginError, check_plugin, find_plugin, installed_plugins

GROUP = "analysis.structures"
PLUGIN = Plugin(GROUP, "fractional", "x:y", "lab-x", "1")


@pytest.fixture
def packages(tmp_path, monkeypatch):
    """Folder in which the package with the structure is installed."""
    folder = tmp_path / "site"
    install(folder, "lab-zener", "0.1", STRUCTURE, f"[{GROUP}]\nzener = lab_zener:ZENER\n")
    monkeypatch.syspath_prepend(folder)
    yield folder
    sys.modules.pop("lab_zener", None)


@pytest.fixture(scope="module")
def session(tmp_path_factory, make_signals, write_session):
    path = tmp_path_factory.mktemp("structures") / "a.mcap"
    signals = make_signals(sweep_s=15.0, ring_down_s=5.0, rate_hz=500.0, quantum_rad=0.0)
    return write_session(path, signals)


@pytest.fixture(scope="module")
def selection(session):
    return select(Measurement.from_record(load_record(session)))


def test_added_structure_is_found_by_name(packages):
    (added,) = added_structures(["zener"])
    assert added.structure.free == ("relaxation_strength", "relaxation_time_s", "air")
    assert added.plugin.label == "lab-zener 0.1"
    assert check_plugin(find_plugin(GROUP, "zener")).startswith("Relaxation of the material")
    with pytest.raises(LookupError, match=r"no installed package adds .* 'x'; there are zener"):
        added_structures(["x"])


def fractional(s, values):
    """Type VI once more, with other names."""
    return (
        1 + values["inside"] * s ** values["order_inside"],
        values["outside"] * s ** values["order_outside"],
    )


def coefficient(name, start):
    return Parameter(
        name, name, "damping", logarithmic=True, lower=1e-9, upper=1.0, starts=(start,)
    )


def order(name):
    return Parameter(name, name, "its order", lower=0.01, upper=1.99, starts=(0.7, 1.1))


@pytest.mark.fit
def test_fit_equals_that_of_the_same_law_in_the_analyser(selection):
    parameters = (
        coefficient("inside", 1e-4), order("order_inside"),
        coefficient("outside", 1e-2), order("order_outside"),
    )  # fmt: skip
    structure = Structure("fractional", "Fractional damping", parameters, fractional)
    check_structure(structure)
    added = fit_structure(AddedStructure(structure, PLUGIN), selection)
    (fit,) = [each.fit for each in selection.candidates if each.name == "VI"]
    assert added.cost == pytest.approx(fit.cost, rel=1e-4)
    for name, own in zip(("zeta", "alpha", "gamma", "lambda"), structure.free, strict=True):
        assert abs(added.parameters[own] - fit.parameters[name]) < 0.1 * fit.std[name]
        assert added.std[own] == pytest.approx(fit.std[name], rel=0.05)
    bics = {each.name: each.bic for each in selection.candidates}
    assert added.delta_bic == pytest.approx(bics["VI"] - bics[added.compared_with], abs=0.5)
    first, *_ = added.loss_factors
    assert first[1] == pytest.approx(2 * fit.modes[0].damping_ratio, rel=0.05)


@pytest.mark.fit
def test_failing_law_is_named_with_its_values(selection):
    def breaks(s, values):
        return 1 + values["inside"] * s, float("nan") * s if values["inside"] > 1.2e-5 else 0 * s

    structure = Structure("breaks", "Breaks", (coefficient("inside", 1e-5),), breaks)
    check_structure(structure)
    with pytest.raises(PluginError, match=r"lab-x 1, .*not finite at inside = "):
        fit_structure(AddedStructure(structure, PLUGIN), selection)


def changed(*pairs):
    code = STRUCTURE
    for old, new in pairs:
        assert old in code
        code = code.replace(old, new)
    return code


WRONG = {  # code of a package, and the reason that is stated
    "raises": ("raise RuntimeError('no')", "RuntimeError: no"),
    "exits": ("import sys; sys.exit()", "SystemExit"),
    "type": ("ZENER = 'zener'", "is a str, not a Structure"),
    "other": (STRUCTURE, 'declares the structure "zener"'),
    "vi": (STRUCTURE, "built into the analyser"),
    "lines": (changed(("material, and", "material\\nand")), "description is not one line"),
    "range": (changed(("lower=1e-6, upper=1.0", "lower=1.0, upper=1e-6")), "1 to 1e-06"),
    "endless": (changed((", upper=1.0", "")), "is not finite"),
    "start": (changed(("starts=(1e-2,)", "starts=(20.0,)")), "start 20 of its parameter air"),
    "none": (changed((", starts=(1e-2,)", "")), "air states no start"),
    "unit": (changed(('constant", "s"', 'constant", "ms"')), 'unit "ms", but its name says s'),
    "taken": (changed(('"air", "c_a"', '"zeta", "c_a"')), "zeta is taken"),
    "nan": (changed(('["air"] * s', '["air"] * s / 0 * 1j')), "ZeroDivisionError|not finite"),
    "gains": (changed(("elastic = 1 +", "elastic = 1 -")), "stiffness gains energy at"),
    "hysteretic": (
        changed(("elastic = 1 +", "elastic = 1 + 0.01j +")),
        "not a real function",
    ),
    "fails": (changed(('values["air"]', 'values["wind"]')), "KeyError"),
}


@pytest.mark.parametrize("name", WRONG)
def test_unusable_package_is_named_without_affecting_others(packages, tmp_path, monkeypatch, name):
    code, reason = WRONG[name]
    if name not in ("other", "vi"):
        code = code.replace('"zener"', f'"{name}"')
    entry_points = f"[{GROUP}]\n{name} = law_{name}:ZENER\n"
    install(tmp_path / "wrong", f"law-{name}", "0.3", code, entry_points)
    monkeypatch.syspath_prepend(tmp_path / "wrong")
    (plugin,) = [each for each in installed_plugins(GROUP) if each.name == name]
    with pytest.raises(PluginError, match=f"law-{name} 0.3, .*{reason}"):
        check_plugin(plugin)
    with pytest.raises(PluginError, match=reason):
        added_structures([name])
    check_plugin(find_plugin(GROUP, "zener"))


def test_two_packages_that_add_the_same_name_are_named(packages, tmp_path, monkeypatch):
    install(tmp_path / "b", "lab-b", "2", STRUCTURE, f"[{GROUP}]\nzener = lab_b:ZENER\n")
    monkeypatch.syspath_prepend(tmp_path / "b")
    with pytest.raises(PluginError, match=r"lab-zener 0\.1.*lab-b 2|lab-b 2.*lab-zener 0\.1"):
        added_structures(["zener"])


@pytest.mark.fit
def test_analyze_fits_and_reports_it(packages, session, tmp_path, analyze_here, without_drawing):
    entry_points = f"[{GROUP}]\nbroken = lab_broken:BROKEN\n"
    install(packages, "lab-broken", "1", "raise SystemExit(3)", entry_points)
    done = analyze_here("--help")
    assert done.returncode == 0, done.stderr
    assert "--structure" in done.stdout
    assert "of lab-zener 0.1" in done.stdout
    assert "of lab-broken 1" in done.stdout  # none is imported
    report, results = tmp_path / "report", tmp_path / "a.json"
    with without_drawing():
        done = analyze_here(
            session, "--method", "record", "--structure", "zener", "--report", report,
            "--json", results,
        )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    text = " ".join(done.stdout.split())
    assert "Structure zener of lab-zener 0.1 (relaxation of the material, and viscous" in text
    assert "The reported numbers are those of types I to VII." in text
    (record,) = json.loads(results.read_text())["records"]
    (added,) = record["added_structures"]
    assert added["structure"] == "zener"
    assert added["package"] == "lab-zener 0.1"
    assert added["units"]["relaxation_time_s"] == "s"
    assert added["delta_bic"] > 10  # the session is of type VI
    assert record["selected"] in ("VI", "VII")
    table = (report / "tables" / "added_structures.csv").read_text()
    assert "relaxation_strength" in table
    assert "Relaxation of the material" not in table
    assert "Structures of installed packages" in (report / "report.html").read_text()
    for arguments, reason in (
        (("--structure", "maxwell"), "there are broken and zener"),
        (("--structure", "broken"), "Package lab-broken 1"),
        (("--structure", "zener", "--method", "welch"), "for whole-record fits"),
    ):
        done = analyze_here(session, *arguments)
        assert done.returncode == 2
        assert reason in " ".join(done.stderr.split())
