import shutil
import subprocess
from pathlib import Path

import pytest

from analysis.report.folder import (
    CHECKSUM_LIST_NAME,
    OutputError,
    OutputExistsError,
    check_new_file,
    new_report_folder,
    report_folders,
    write_new_file,
)


def test_default_folders_are_new_and_next_to_the_files(tmp_path):
    files = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    assert [f.name for f in report_folders(files, None)] == ["a.report", "b.report"]
    (tmp_path / "a.report").mkdir()
    (tmp_path / "a.report-2").write_text("a file will do")
    assert [f.name for f in report_folders(files, None)] == ["a.report-3", "b.report"]


def test_requested_folder_holds_a_report_or_one_per_file(tmp_path):
    one, two = tmp_path / "a.mcap", tmp_path / "sub" / "a.mcap"
    assert report_folders([one], tmp_path / "out") == [tmp_path / "out"]
    assert report_folders([one, two], tmp_path / "out") == [
        tmp_path / "out" / "a",
        tmp_path / "out" / "a-2",
    ]


def test_only_an_empty_folder_is_used(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    assert report_folders([tmp_path / "a.mcap"], out) == [out]
    with new_report_folder(out) as part:
        (part / "x").write_text("1")
    assert (out / "x").read_text() == "1"
    with pytest.raises(OutputExistsError, match="out"):
        report_folders([tmp_path / "a.mcap"], out)


def test_a_folder_is_complete_or_absent(tmp_path):
    with pytest.raises(KeyboardInterrupt), new_report_folder(tmp_path / "out") as part:
        (part / "x").write_text("1")
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_folder_that_appears_meanwhile_is_preserved(tmp_path):
    out = tmp_path / "out"
    with pytest.raises(OutputExistsError, match="meanwhile"), new_report_folder(out) as part:
        (part / "x").write_text("mine")
        out.mkdir()
        (out / "x").write_text("theirs")
    assert (out / "x").read_text() == "theirs"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_impossible_folder_is_an_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="file"), new_report_folder(tmp_path / "file" / "out"):
        pass


def test_new_file_must_not_exist(tmp_path):
    path = tmp_path / "deep" / "a.json"
    check_new_file(path, "--json")
    write_new_file(path, "1")
    with pytest.raises(OutputExistsError, match="--json"):
        check_new_file(path, "--json")
    with pytest.raises(OutputExistsError):
        write_new_file(path, "2")
    assert path.read_text() == "1"
    with pytest.raises(OutputError, match="written"):
        write_new_file(path / "below.json", "3")


def write_report(folder, overwrite=True, **files):
    with new_report_folder(folder, overwrite=overwrite) as part:
        for name, text in files.items():
            write_new_file(part / name.replace("_in_", "/"), text)


def contents(folder):
    return {
        path.relative_to(folder).as_posix(): path.read_text()
        for path in folder.rglob("*")
        if path.is_file() and path.name != CHECKSUM_LIST_NAME
    }


@pytest.mark.process
def test_report_lists_its_files_like_sha256sum(tmp_path):
    out = tmp_path / "out"
    write_report(out, overwrite=False, a="1", sub_in_b="2")
    check = [shutil.which("sha256sum"), "--check", "--strict", CHECKSUM_LIST_NAME]
    assert subprocess.run(check, cwd=out, capture_output=True, check=True).stderr == b""
    assert len((out / CHECKSUM_LIST_NAME).read_text().splitlines()) == 2


def test_replacement_preserves_files_of_others(tmp_path):
    out = tmp_path / "out"
    write_report(out, a="1", sub_in_b="2", gone_in_c="3")
    (out / "notes").write_text("mine")
    (out / "sub" / "notes").write_text("mine, too")
    with pytest.raises(OutputExistsError, match="--overwrite"):
        report_folders([tmp_path / "x.mcap"], out)
    assert report_folders([tmp_path / "x.mcap"], out, overwrite=True) == [out]
    write_report(out, a="4", d="5")
    mine = {"notes": "mine", "sub/notes": "mine, too"}
    assert contents(out) == {"a": "4", "d": "5", **mine}
    assert not (out / "gone").exists()
    assert len((out / CHECKSUM_LIST_NAME).read_text().splitlines()) == 2


@pytest.mark.parametrize("change", ["edited", "a link", "a folder", "foreign"])
def test_changed_file_stops_the_replacement(tmp_path, change):
    out, other = tmp_path / "out", tmp_path / "other"
    write_report(out, a="1", b="2")
    other.write_text("1")
    if change == "edited":
        (out / "a").write_text("mine")
    elif change == "foreign":
        (out / "c").write_text("mine")
    else:
        (out / "a").unlink()
        (out / "a").symlink_to(other) if change == "a link" else (out / "a").mkdir()
    before = contents(out)
    with pytest.raises(OutputExistsError, match="is unchanged"):
        write_report(out, a="3", b="4", c="5")
    assert contents(out) == before
    assert other.read_text() == "1"


def test_a_list_cannot_reach_beyond_its_folder(tmp_path):
    out, outside = tmp_path / "out", tmp_path / "mine"
    write_report(out, a="1")
    outside.write_text("1")
    checksum = (out / CHECKSUM_LIST_NAME).read_text().split()[0]
    (out / CHECKSUM_LIST_NAME).write_text(f"{checksum}  ../mine\n{checksum}  {outside}\n")
    (out / "a").unlink()
    write_report(out, b="2")
    assert outside.read_text() == "1"


def test_interrupted_replacement_is_resumed(tmp_path, monkeypatch):
    out = tmp_path / "out"
    write_report(out, a="1", b="2")
    replace, calls = Path.replace, []

    def killed(path, target):
        calls.append(target)
        if target == out / "b":
            raise KeyboardInterrupt
        return replace(path, target)

    monkeypatch.setattr(Path, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        write_report(out, a="3", b="4")
    monkeypatch.undo()
    assert contents(out) == {"a": "3", "b": "2"}
    write_report(out, a="5", b="6")
    assert contents(out) == {"a": "5", "b": "6"}


def test_non_report_folder_is_not_replaced(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "a").write_text("mine")
    with pytest.raises(OutputExistsError, match=f"no list of its files .{CHECKSUM_LIST_NAME}"):
        report_folders([tmp_path / "x.mcap"], out, overwrite=True)
    (tmp_path / "x.report").write_text("a file")
    with pytest.raises(OutputExistsError, match=r"x\.report is not one"):
        report_folders([tmp_path / "x.mcap"], None, overwrite=True)


def test_only_earlier_results_are_replaced(tmp_path):
    path = tmp_path / "a.json"
    write_new_file(path, '{"versions": {}, "headlines": [], "fits": []}', overwrite=True)
    write_new_file(path, '{"versions": {}, "headlines": [], "fits": [1]}', overwrite=True)
    with pytest.raises(OutputExistsError, match="nothing is overwritten"):
        write_new_file(path, "2")
    assert "[1]" in path.read_text()
    for text in ('{"fits": []}', "[]", "not JSON"):
        path.write_text(text)
        with pytest.raises(OutputExistsError, match="does not hold results"):
            check_new_file(path, "--json", overwrite=True)
    assert [each.name for each in tmp_path.iterdir()] == ["a.json"]
