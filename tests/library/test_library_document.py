"""The examples of docs/library.md run as written."""

import re
import sqlite3
import tomllib
from pathlib import Path

from library_folders import mode

from rigd.library import list_sessions
from rigd.profile import load_profile, load_specimen

PROJECT = Path(__file__).parents[2]
DOCUMENT = (PROJECT / "docs" / "library.md").read_text("utf-8")


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```$", DOCUMENT, re.MULTILINE | re.DOTALL)


def test_the_queries_read_the_index(
    record_briefly, write_quick_look, tmp_path, monkeypatch, capsys
):
    write_quick_look(record_briefly("a", specimen="antenna 3"), mode(2.5))
    list_sessions(tmp_path)
    (query,), (code,) = blocks("sql"), blocks("python")
    database = sqlite3.connect(tmp_path / "library.sqlite")
    ((_, specimen, first_mode_hz),) = database.execute(query)
    database.close()
    assert (specimen, first_mode_hz) == ("antenna 3", 2.5)
    (tmp_path / "sessions").symlink_to(tmp_path)
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(code, names)
    names["index"].close()
    assert capsys.readouterr().out == "2023-11-14T22:13:20.000+00:00 antenna 3 complete\n"


def test_toml_blocks_are_valid(tmp_path):
    required, specimen = blocks("toml")
    path = tmp_path / "lab.toml"
    path.write_text((PROJECT / "hw_profiles" / "sim.toml").read_text("utf-8") + required)
    profile = load_profile(str(path))
    assert list(profile.metadata.required) == tomllib.loads(required)["metadata"]["required"]
    path = tmp_path / "antenna_4.toml"
    path.write_text(specimen)
    assert load_specimen(path).beam.length_m == 0.95
