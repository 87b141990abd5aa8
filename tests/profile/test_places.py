"""Folders searched for the profile of a name, and their order."""

from pathlib import Path

import pytest

from rigd.profile import load_profile, profile_files, user_folder

CHECKOUT = Path(__file__).resolve().parents[2]


@pytest.fixture
def own(tmp_path, monkeypatch):
    """The user's own folder, with a profile `sim` in it; the working folder has none."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    return put(tmp_path / "config" / "rigd" / "profiles")


def put(folder):
    """Put a copy of the shipped profile `sim` into a folder."""
    folder.mkdir(parents=True)
    text = (CHECKOUT / "hw_profiles" / "sim.toml").read_text("utf-8")
    (folder / "sim.toml").write_text(text, "utf-8")
    return folder / "sim.toml"


def test_order_of_the_folders_of_profiles(own):
    here = put(Path("hw_profiles"))
    shipped = CHECKOUT / "hw_profiles" / "sim.toml"
    assert [(file.path, file.origin.name) for file in profile_files()["sim"]] == [
        (here, "HERE"),
        (own, "USER"),
        (shipped, "SHIPPED"),
    ]
    for path in (here, own, shipped):
        assert load_profile("sim").path == path
        if path != shipped:
            path.unlink()


def test_profiles_of_a_checkout_are_the_shipped_ones(own, monkeypatch):
    monkeypatch.chdir(CHECKOUT)
    assert [file.origin.name for file in profile_files()["sim"]] == ["USER", "SHIPPED"]
    assert [file.origin.name for file in profile_files()["antenna_can"]] == ["SHIPPED"]


def test_the_user_s_folder_is_below_home_by_default(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    for value in (None, "", "relative/folder"):
        if value is None:
            monkeypatch.delenv("XDG_CONFIG_HOME")
        else:
            monkeypatch.setenv("XDG_CONFIG_HOME", value)
        assert user_folder() == tmp_path / ".config" / "rigd" / "profiles"


def test_a_user_without_a_home_has_the_shipped_profiles(monkeypatch):
    def nobody():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CONFIG_HOME")
    monkeypatch.setattr("pathlib.Path.home", nobody)
    assert user_folder() is None
    assert load_profile("sim").path.parent == CHECKOUT / "hw_profiles"


def test_the_shipped_profiles_are_found_from_a_removed_folder(tmp_path, monkeypatch):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert load_profile("sim").path.parent == CHECKOUT / "hw_profiles"
