import pytest

from analysis.report._folder import (
    OutputError,
    OutputExistsError,
    check_new_file,
    new_folder,
    report_folders,
    write_new,
)


def test_default_folders_are_beside_the_files_and_new(tmp_path):
    files = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    assert [f.name for f in report_folders(files, None)] == ["a.report", "b.report"]
    (tmp_path / "a.report").mkdir()
    (tmp_path / "a.report-2").write_text("a file will do")
    assert [f.name for f in report_folders(files, None)] == ["a.report-3", "b.report"]


def test_the_folder_asked_for_holds_one_report_or_one_folder_a_file(tmp_path):
    one, two = tmp_path / "a.mcap", tmp_path / "sub" / "a.mcap"
    assert report_folders([one], tmp_path / "out") == [tmp_path / "out"]
    assert report_folders([one, two], tmp_path / "out") == [
        tmp_path / "out" / "a",
        tmp_path / "out" / "a-2",
    ]


def test_a_folder_with_contents_is_refused_and_an_empty_one_used(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    assert report_folders([tmp_path / "a.mcap"], out) == [out]
    with new_folder(out) as part:
        (part / "x").write_text("1")
    assert (out / "x").read_text() == "1"
    with pytest.raises(OutputExistsError, match="out"):
        report_folders([tmp_path / "a.mcap"], out)


def test_a_folder_is_complete_or_absent(tmp_path):
    with pytest.raises(KeyboardInterrupt), new_folder(tmp_path / "out") as part:
        (part / "x").write_text("1")
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_appears_meanwhile_is_kept(tmp_path):
    out = tmp_path / "out"
    with pytest.raises(OutputExistsError, match="meanwhile"), new_folder(out) as part:
        (part / "x").write_text("mine")
        out.mkdir()
        (out / "x").write_text("theirs")
    assert (out / "x").read_text() == "theirs"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_folder_that_cannot_be_is_an_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="file"), new_folder(tmp_path / "file" / "out"):
        pass


def test_a_new_file_is_new(tmp_path):
    path = tmp_path / "deep" / "a.json"
    check_new_file(path, "--json")
    write_new(path, "1")
    with pytest.raises(OutputExistsError, match="--json"):
        check_new_file(path, "--json")
    with pytest.raises(OutputExistsError):
        write_new(path, "2")
    assert path.read_text() == "1"
    with pytest.raises(OutputError, match="written"):
        write_new(path / "below.json", "3")
