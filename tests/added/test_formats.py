"""An import format in one file outside: reading uses it, and reports its errors."""

import sys
from pathlib import Path

import numpy as np
import pytest
from packages import FORMAT, install, rigd_with

from analysis.exchange import ExchangeError, read_source
from rigd.plugins import PluginError, check_plugin, find_plugin, installed_plugins
from rigd.session import read_session

GROUP = "analysis.formats"
PROJECT = Path(__file__).parents[2]


@pytest.fixture
def archive(tmp_path, monkeypatch):
    """File of the format that an installed package adds."""
    folder = tmp_path / "site"
    install(folder, "lab-npz", "0.2", FORMAT, f"[{GROUP}]\nnpz = lab_npz:NPZ\n")
    monkeypatch.syspath_prepend(folder)
    np.savez(tmp_path / "a.npz", angle=np.arange(9.0), torque=np.arange(9), few=np.zeros(1))
    yield tmp_path / "a.npz"
    sys.modules.pop("lab_npz", None)


def test_channels_of_an_added_format_are_read(archive):
    name, channels = read_source(archive, ["angle", "torque"])
    assert name == "NumPy archive"
    assert channels["torque"].values.dtype == float
    assert channels["angle"].rate_hz == 1000.0
    assert "import of .npz" in check_plugin(find_plugin(GROUP, "npz"))


@pytest.mark.parametrize(("channel", "message"), [("x", "no channel x"), ("few", "1 samples")])
def test_errors_match_those_of_other_formats(archive, channel, message):
    with pytest.raises(ExchangeError, match=message):
        read_source(archive, [channel])


def test_a_damaged_file_is_an_error_with_the_name_of_the_package(archive):
    archive.write_bytes(b"PK" + bytes(50))
    with pytest.raises(ExchangeError, match=r"a\.npz.*lab-npz 0\.2"):
        read_source(archive, ["angle"])


def test_unknown_suffix_is_refused_with_the_known_ones(archive):
    with pytest.raises(ExchangeError, match=r"\.csv, .*\.npz"):
        read_source(archive.with_suffix(".xyz"), ["angle"])


WRONG = {  # code of a package, and the reason that is stated
    "bad": ("raise SystemExit", "SystemExit"),
    "raises": ("raise RuntimeError('no')", "RuntimeError: no"),
    "kind": ("NPZ = 1", "not a ImportFormat"),
    "absent": ("", "AttributeError"),
    "csv": (FORMAT, "cannot be replaced"),
    "nameless": (FORMAT.replace("NumPy archive", " "), "has no name"),
    "size": (FORMAT.replace("10_000_000", "0"), "max_bytes = 0"),
    "endless": (FORMAT.replace("10_000_000", "float('inf')"), "max_bytes = inf"),
    "function": (FORMAT.replace('archive", read', 'archive", None'), "no function"),
}


@pytest.mark.parametrize("name", WRONG)
def test_unusable_package_is_named_without_affecting_others(archive, tmp_path, monkeypatch, name):
    code, reason = WRONG[name]
    install(tmp_path / "b", f"y-{name}", "1", code, f"[{GROUP}]\n{name} = y_{name}:NPZ\n")
    monkeypatch.syspath_prepend(tmp_path / "b")
    (plugin,) = [each for each in installed_plugins(GROUP) if each.name == name]
    with pytest.raises(PluginError, match=reason):
        check_plugin(plugin)
    if name != "csv":
        with pytest.raises(ExchangeError, match=reason):
            read_source(tmp_path / f"a.{name}", ["angle"])
    assert read_source(archive, ["angle"])[0] == "NumPy archive"


WRONG_READERS = {  # value of a reader for the channel "angle", and the message
    "nothing": ("None", "TypeError"),
    "lacks": ("{}", "KeyError"),
    "text": ("{'angle': SourceChannel(np.array(['a', 'b']))}", "does not hold real numbers"),
    "complex": ("{'angle': SourceChannel(np.ones(9, complex))}", "is complex"),
    "matrix": ("{'angle': SourceChannel(np.ones((9, 2)))}", "2 dimensions"),
    "rate": ("{'angle': SourceChannel(np.ones(9), rate_hz=-1.0)}", "rate of -1.0 Hz"),
    "fails": ("1 / 0", "ZeroDivisionError"),
    "exits": ("exit()", "SystemExit"),
}


@pytest.mark.parametrize("name", WRONG_READERS)
def test_failing_reader_is_an_error_on_the_file(archive, tmp_path, monkeypatch, name):
    returned, message = WRONG_READERS[name]
    code = f"{FORMAT}\nNPZ = ImportFormat('x', lambda path, names: {returned}, 1000)\n"
    install(tmp_path / "b", f"z-{name}", "1", code, f"[{GROUP}]\n{name} = z_{name}:NPZ\n")
    monkeypatch.syspath_prepend(tmp_path / "b")
    path = tmp_path / f"a.{name}"
    path.write_bytes(b"x")
    with pytest.raises(ExchangeError, match=f"a.{name}.*{message}"):
        read_source(path, ["angle"])
    assert read_source(archive, ["angle"])[0] == "NumPy archive"


@pytest.mark.process
def test_analyze_import_accepts_it(archive, tmp_path):
    angle = 0.02 * np.sin(np.arange(4000) / 50)
    np.savez(archive, angle=angle, torque=0.1 * angle)
    code, output, errors = rigd_with(
        archive.parent / "site", "import", archive, tmp_path / "a.mcap",
        "--profile", PROJECT / "hw_profiles" / "sim.toml", "--rate-hz", "1000",
        "--angle", "angle:rad", "--torque", "torque:N.m", program=("-P", "-m", "analysis"),
    )  # fmt: skip
    assert code == 0, output + errors
    assert read_session(tmp_path / "a.mcap").metadata["import_format"]
