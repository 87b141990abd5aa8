"""Files in a folder that every user can write to are not trusted."""

import os
import stat
import tempfile

import pytest

from rigd.runtime.addresses import UnsafeFolderError, folder_fault, known_folders, runtime_folder
from rigd.runtime.locks import LockFile


@pytest.fixture
def common(monkeypatch, tmp_path):
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


@pytest.mark.parametrize("taken_by", ["nobody", "a file", "a link", "another user"])
def test_a_new_folder_is_private_to_the_user(common, monkeypatch, taken_by):
    name = common / f"rigd-{os.getuid()}"
    if taken_by == "a file":
        name.touch()
    elif taken_by == "a link":
        (common / "elsewhere").mkdir()
        name.symlink_to(common / "elsewhere")
    elif taken_by == "another user":
        if os.getuid():
            pytest.skip("only root can give a folder away")
        name.mkdir()
        os.chown(name, 12345, 12345)
    folder = runtime_folder()
    assert folder == runtime_folder()  # a second search finds the same
    assert (folder == name) is (taken_by == "nobody")
    assert stat.S_IMODE(folder.lstat().st_mode) == 0o700
    assert folder.lstat().st_uid == os.getuid()


def test_an_alternative_folder_is_found_again(common):
    taken = common / f"rigd-{os.getuid()}"
    taken.touch()
    folder = runtime_folder()
    taken.unlink()
    assert runtime_folder() == folder
    assert folder in known_folders(os.getuid())
    assert not taken.exists()
    taken.mkdir(mode=0o700)  # both are this user's
    assert runtime_folder() == taken
    assert set(known_folders(os.getuid())) >= {folder, taken}


@pytest.mark.parametrize("mode", [0o770, 0o707, 0o2770, 0o1777])
def test_a_folder_writable_by_others_is_refused(runtime_folder, mode):
    folder = runtime_folder / "rigd"
    held = LockFile("rig-a", for_all_users=False)  # before the mode is wrong
    held.acquire("rigd run")
    held.release()
    folder.chmod(mode)
    with pytest.raises(UnsafeFolderError, match=rf"{folder} .*{mode:04o}.*chmod go-w {folder}"):
        LockFile("rig-a", for_all_users=False)
    assert folder_fault(folder, is_shared=True)
    folder.chmod(0o2750)
    assert not folder_fault(folder)
    assert LockFile("rig-a", for_all_users=False).path.parent == folder


def test_a_parent_folder_writable_by_others_is_refused(runtime_folder):
    runtime_folder.chmod(0o770)
    with pytest.raises(UnsafeFolderError, match=f"{runtime_folder} is writable by its group"):
        LockFile("rig-a", for_all_users=False)
    runtime_folder.chmod(0o1777)  # as /tmp: users cannot replace files of others
    assert LockFile("rig-a", for_all_users=False).path.parent == runtime_folder / "rigd"


def test_a_folder_of_another_user_is_refused(runtime_folder, monkeypatch):
    folder = runtime_folder / "rigd"
    folder.mkdir(mode=0o700)
    owner = os.getuid() or 4711
    os.chown(folder, owner, -1)
    assert not folder_fault(folder)
    monkeypatch.setattr("os.getuid", lambda: owner + 1)
    assert f"{folder} belongs to another user ({owner})" in folder_fault(folder)
    assert not folder_fault(folder, is_shared=True)


def test_a_lock_follows_no_link(runtime_folder):
    held = LockFile("rig-a", for_all_users=False)
    held.path.parent.mkdir(parents=True)
    precious = runtime_folder / "precious"
    precious.write_text("precious")
    held.path.symlink_to(precious)
    with pytest.raises(OSError, match="symbolic links"):
        held.acquire("rigd run")
    assert precious.read_text() == "precious"
    held.path.unlink()
    os.mkfifo(held.path)
    with pytest.raises(OSError, match="not a plain file"):
        held.acquire("rigd run")
