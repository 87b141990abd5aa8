"""The index next to the files: always equal to them, after any change of either."""

import errno
import json
import multiprocessing
import os
import shutil
import sqlite3
from pathlib import Path

import pytest
from library_folders import mode

from rigd.library import list_sessions

INDEX_NAME = "library.sqlite"


@pytest.fixture
def read_files(monkeypatch):
    """Names of the session files that were opened, not taken from the index."""
    read = []
    open_path = Path.open

    def opening(path, *arguments, **options):
        if path.suffix == ".mcap" and path.name not in read:
            read.append(path.name)
        return open_path(path, *arguments, **options)

    monkeypatch.setattr(Path, "open", opening)
    return read


def test_only_new_and_changed_files_are_read(
    record_briefly, write_quick_look, write_report, tmp_path, read_files
):
    paths = [record_briefly(name) for name in "abc"]
    list_sessions(tmp_path)
    assert sorted(read_files) == ["a.mcap", "b.mcap", "c.mcap"]
    steps = [
        (lambda: None, []),
        (lambda: write_quick_look(paths[0], mode(2.5)), ["a.mcap"]),
        (lambda: write_report(paths[1], mode(2.5)), ["b.mcap"]),
        (lambda: write_report(paths[1], mode(2.6), number=2), ["b.mcap"]),
        (lambda: os.utime(paths[2], ns=(1, 1)), ["c.mcap"]),
        (lambda: record_briefly("d"), ["d.mcap"]),
        (lambda: paths[0].rename(tmp_path / "e.mcap"), ["e.mcap"]),
        (paths[1].unlink, []),
    ]
    for change, expected in steps:
        read_files.clear()
        change()
        brought_up = list_sessions(tmp_path)
        assert read_files == expected
        (tmp_path / INDEX_NAME).unlink()
        assert list_sessions(tmp_path) == brought_up
    assert [row.id for row in brought_up] == ["e", "d", "c"]


def test_temporarily_unreadable_file_is_read_next_time(
    record_briefly, tmp_path, monkeypatch, read_files
):
    record_briefly("good")
    (tmp_path / "text.mcap").write_text("no session at all")
    with monkeypatch.context() as moment:
        moment.setattr(Path, "open", refuse)  # also to root, who may read everything
        rows = list_sessions(tmp_path)
    assert [row.outcome for row in rows] == ["unreadable", "unreadable"]
    assert all("Permission denied" in row.problem for row in rows)
    for expected in (["good.mcap", "text.mcap"], []):  # damage is known by then
        read_files.clear()
        assert {row.id: row.outcome for row in list_sessions(tmp_path)} == {
            "good": "complete", "text": "unreadable"
        }  # fmt: skip
        assert sorted(read_files) == expected


def refuse(path, *_):
    raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), path)


def test_index_moves_with_its_folder(
    record_briefly, write_quick_look, write_report, tmp_path, read_files
):
    path = record_briefly("a")
    write_quick_look(path, mode(2.5))
    folder = write_report(path, mode(2.5))
    list_sessions(tmp_path)
    moved = tmp_path.rename(tmp_path.with_name("moved"))
    read_files.clear()
    (row,) = list_sessions(moved)
    assert (row.path, row.report) == (moved / "a.mcap", moved / folder.name / "report.html")
    assert read_files == []


def spoil(path, statement):
    with sqlite3.connect(path) as database:
        database.execute(statement)
    database.close()


@pytest.mark.parametrize(
    "harm",
    [
        lambda path: path.write_bytes(path.read_bytes()[:200] + b"\xff" * 8000),
        lambda path: path.write_bytes(path.read_bytes()[:5000]),
        lambda path: path.write_bytes(b""),
        lambda path: spoil(path, "DROP TABLE sessions"),
        lambda path: spoil(path, "ALTER TABLE sessions DROP COLUMN late"),
        lambda path: spoil(path, "UPDATE sessions SET modes = '{'"),
        lambda path: spoil(path, "UPDATE sessions SET specimen = 7.5, meta = '[1]'"),
        lambda path: spoil(path, "PRAGMA user_version = 99"),
    ],
)
def test_invalid_index_is_rebuilt_from_the_files(record_briefly, tmp_path, harm, read_files):
    for name in "abc":
        record_briefly(name, specimen="antenna 3")
    rows = list_sessions(tmp_path)
    harm(tmp_path / INDEX_NAME)
    assert list_sessions(tmp_path) == rows
    read_files.clear()
    assert list_sessions(tmp_path) == rows
    assert read_files == []


@pytest.mark.parametrize("content", [b"a letter to my mother", None])
def test_unrelated_file_is_left_unchanged(record_briefly, tmp_path, content):
    path = tmp_path / INDEX_NAME
    if content is None:
        spoil(path, "CREATE TABLE sessions (file TEXT, stamp TEXT)")
    else:
        path.write_bytes(content)
    before = path.read_bytes()
    record_briefly("a")
    assert [row.id for row in list_sessions(tmp_path)] == ["a"]
    assert path.read_bytes() == before


def test_a_folder_without_room_for_an_index_is_listed(record_briefly, tmp_path):
    record_briefly("a")
    (tmp_path / INDEX_NAME).mkdir()  # even for root, who may write anywhere
    for _ in range(2):
        assert [row.id for row in list_sessions(tmp_path)] == ["a"]


def test_locked_index_is_not_used(record_briefly, tmp_path, monkeypatch):
    monkeypatch.setattr("rigd.library._index._MAX_LOCK_WAIT_S", 0.05)
    record_briefly("a")
    list_sessions(tmp_path)
    holder = sqlite3.connect(tmp_path / INDEX_NAME, isolation_level=None)
    holder.execute("BEGIN EXCLUSIVE")
    record_briefly("b", day=1)
    assert [row.id for row in list_sessions(tmp_path)] == ["b", "a"]
    holder.execute("ROLLBACK")
    holder.close()
    assert [row.id for row in list_sessions(tmp_path)] == ["b", "a"]


def lister(folder, number):
    rows = []
    for turn in range(5):
        shutil.copy(folder / "a.mcap", folder / f"copy-{number}-{turn}.mcap")
        rows.append(len(list_sessions(folder)))
    return rows


def test_several_writers_use_one_index(record_briefly, tmp_path, read_files):
    record_briefly("a")
    with multiprocessing.get_context("fork").Pool(3) as pool:
        results = pool.starmap(lister, [(tmp_path, number) for number in range(3)])
    assert all(counts == sorted(counts) for counts in results)
    rows = list_sessions(tmp_path)
    assert len(rows) == 16
    read_files.clear()
    assert list_sessions(tmp_path) == rows
    assert read_files == []


def test_the_index_opens_as_a_table(record_briefly, write_quick_look, tmp_path):
    write_quick_look(
        record_briefly("a", specimen="antenna 3", meta_temperature_c="21.4"), mode(2.5)
    )
    list_sessions(tmp_path)
    with sqlite3.connect(tmp_path / INDEX_NAME) as database:
        database.row_factory = sqlite3.Row
        (row,) = map(dict, database.execute("SELECT * FROM sessions"))
    database.close()
    assert row["start_utc"] == "2023-11-14T22:13:20.000+00:00"
    assert (row["file"], row["specimen"], row["missed"]) == ("a.mcap", "antenna 3", 7)
    assert json.loads(row["meta"]) == {"temperature_c": 21.4}
    assert json.loads(row["modes"])[0]["frequency_hz"]["value"] == 2.5
