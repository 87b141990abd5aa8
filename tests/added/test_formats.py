"""An import format in one file outside: reading takes it, and names what is wrong with it."""

import sys

import numpy as np
import pytest
from packages import FORMAT, install

from analysis.exchange import ExchangeError, read_source
from rigd.plugins import PluginError, check_plugin, find_plugin, installed_plugins

GROUP = "analysis.formats"


@pytest.fixture
def archive(tmp_path, monkeypatch):
    """File of the format that an installed package adds."""
    folder = tmp_path / "site"
    install(folder, "lab-npz", "0.2", FORMAT, f"[{GROUP}]\nnpz = lab_npz:NPZ\n")
    monkeypatch.syspath_prepend(folder)
    np.savez(tmp_path / "a.npz", angle=np.arange(9.0), torque=np.arange(9), few=np.zeros(1))
    yield tmp_path / "a.npz"
    sys.modules.pop("lab_npz", None)


def test_its_channels_are_read(archive):
    name, channels = read_source(archive, ["angle", "torque"])
    assert name == "NumPy archive"
    assert channels["torque"].values.dtype == float
    assert channels["angle"].rate_hz == 1000.0
    assert "import of .npz" in check_plugin(find_plugin(GROUP, "npz"))


@pytest.mark.parametrize(("channel", "message"), [("x", "no channel x"), ("few", "1 samples")])
def test_errors_of_its_files_are_those_of_other_formats(archive, channel, message):
    with pytest.raises(ExchangeError, match=message):
        read_source(archive, [channel])


def test_a_damaged_file_is_an_error_with_the_name_of_the_package(archive):
    archive.write_bytes(b"PK" + bytes(50))
    with pytest.raises(ExchangeError, match=r"a\.npz.*lab-npz 0\.2"):
        read_source(archive, ["angle"])


def test_an_unknown_suffix_is_refused_with_what_there_is(archive):
    with pytest.raises(ExchangeError, match=r"\.csv, .*\.npz"):
        read_source(archive.with_suffix(".xyz"), ["angle"])


@pytest.mark.parametrize(
    ("name", "code", "reason"),
    [
        ("bad", "raise SystemExit", "SystemExit"),
        ("kind", "NPZ = 1", "no ImportFormat"),
        ("csv", FORMAT, "cannot be replaced"),
    ],
)
def test_a_package_that_cannot_be_used_is_named_and_hurts_no_other(
    archive, tmp_path, monkeypatch, name, code, reason
):
    install(tmp_path / "b", f"y-{name}", "1", code, f"[{GROUP}]\n{name} = y_{name}:NPZ\n")
    monkeypatch.syspath_prepend(tmp_path / "b")
    (plugin,) = [each for each in installed_plugins(GROUP) if each.name == name]
    with pytest.raises(PluginError, match=reason):
        check_plugin(plugin)
    if name != "csv":
        with pytest.raises(ExchangeError, match=reason):
            read_source(tmp_path / f"a.{name}", ["angle"])
    assert read_source(archive, ["angle"])[0] == "NumPy archive"
