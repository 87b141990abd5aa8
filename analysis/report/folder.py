"""Folders of reports: each is complete or absent, and no other files are overwritten.

Each folder lists its files with their SHA-256 (``SHA256SUMS``, as ``sha256sum -c`` checks it). A
file that is in the list and unchanged was written by an analysis: nothing else is ever replaced or
removed.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rigd.documents import DocumentError, read_json, read_text

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

_LONGEST_LIST: Final = 10_000_000
"""Largest list in bytes: a hundred thousand files."""
LIST: Final = "SHA256SUMS"
"""Name of the list of a report's files."""

_KEYS_OF_RESULTS: Final = frozenset(("versions", "headlines", "fits"))
"""Keys by which a JSON document is known to hold results of an analysis."""


class OutputExistsError(ValueError):
    """A file or folder to be written exists already."""


class OutputError(Exception):
    """Something could not be written."""


# Names


def report_folders(
    files: Sequence[Path], report: Path | None, *, overwrite: bool = False
) -> list[Path]:
    """Choose a folder for each file's report.

    Parameters
    ----------
    files : sequence of Path
    report : Path, optional
        Requested folder: that of the report of one file, or one that is to hold a folder per file,
        named like the file. Default: ``NAME.report`` next to each file, or if that exists
        ``NAME.report-2`` and so on.
    overwrite : bool
        Whether an earlier report is to be replaced.

    Raises
    ------
    OutputExistsError
        If the folder exists, is not empty and does not hold an earlier report to be replaced.
    """
    if report is None:
        # A folder given for a file may have no name of its own ("." or "/").
        requested = [file.parent / f"{file.stem}.report" for file in files]
    elif overwrite or _is_free(report):
        requested = [report] if len(files) == 1 else [report / file.stem for file in files]
    else:
        raise OutputExistsError(
            f"--report {report} exists and is not an empty folder; choose another name, or replace "
            "an earlier report with --overwrite. Nothing is overwritten without it."
        )
    taken: set[Path] = set()
    if not overwrite:
        return requested if requested == [report] else [_free(each, taken) for each in requested]
    folders = [_free(each, taken, overwrite=True) for each in requested]
    for folder in folders:
        _check_earlier(folder)
    return folders


def check_new_file(path: Path, what: str, *, overwrite: bool = False) -> None:
    """Raise OutputExistsError if a path exists, naming what it was to be.

    Parameters
    ----------
    path : Path
        The new file.
    what : str
        Option that requests it.
    overwrite : bool
        Whether it may be there already, holding results of an analysis in JSON.
    """
    if not os.path.lexists(path):
        return
    if not overwrite:
        raise OutputExistsError(
            f"{what} {path} exists; choose another name or move it away, nothing is overwritten."
        )
    if not _holds_results(path):
        raise OutputExistsError(
            f"{what} {path} exists and does not hold results of an analysis, which is all that "
            "--overwrite replaces; choose another name or move it away."
        )


def _is_free(folder: Path) -> bool:
    """Whether nothing is there, or an empty folder."""
    return not os.path.lexists(folder) or (folder.is_dir() and not any(folder.iterdir()))


def _free(folder: Path, taken: set[Path], *, overwrite: bool = False) -> Path:
    """Return the folder, or the first numbered name like it that is not in use."""
    number, candidate = 1, folder
    while candidate in taken or (os.path.lexists(candidate) and not overwrite):
        number += 1
        candidate = folder.with_name(f"{folder.name}-{number}")
    taken.add(candidate)
    return candidate


def _holds_results(path: Path) -> bool:
    if path.is_symlink() or not path.is_file():
        return False
    try:
        content = read_json(path)
    except DocumentError:
        return False
    return isinstance(content, dict) and content.keys() >= _KEYS_OF_RESULTS


# Writing


@contextmanager
def new_folder(folder: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """Yield a temporary folder that is renamed on success, and removed otherwise.

    Parameters
    ----------
    folder : Path
    overwrite : bool
        Whether an earlier report of that name is replaced: its own files go, all others stay.

    Raises
    ------
    OutputExistsError
        If a folder of that name has appeared meanwhile and is not empty, or a file of the earlier
        report was changed.
    OutputError
        If it cannot be created.
    """
    part = folder.with_name(f".{folder.name}.part-{os.getpid()}")
    try:
        try:
            folder.parent.mkdir(parents=True, exist_ok=True)
            part.mkdir()
        except OSError as error:
            raise OutputError(
                f"The report {folder} cannot be written: {error.strerror or error}. "
                "Choose a folder with --report."
            ) from error
        yield part
        sums = {
            path.relative_to(part).as_posix(): {_sha256(path)}
            for path in sorted(part.rglob("*"))
            if path.is_file()
        }
        if overwrite and not _is_free(folder):
            _replace(folder, part, sums)
            return
        (part / LIST).write_text(_listed(sums), encoding="utf-8")
        try:
            part.rename(folder)
        except OSError as error:
            raise OutputExistsError(
                f"The report {folder} was created meanwhile ({error.strerror or error}); "
                "nothing is overwritten, choose another name with --report."
            ) from error
    finally:
        shutil.rmtree(part, ignore_errors=True)


def write_new(path: Path, content: str | bytes, *, overwrite: bool = False) -> None:
    """Write a new file, text in UTF-8, with the folders it needs.

    Parameters
    ----------
    path : Path
        The new file.
    content : str or bytes
        Its content.
    overwrite : bool
        Whether it replaces earlier results of an analysis.

    Raises
    ------
    OutputExistsError, OutputError
        If it exists, or cannot be written.
    """
    check_new_file(path, "The file", overwrite=overwrite)
    if isinstance(content, str):
        # File names may hold bytes that are not text; as escapes they are text, and valid JSON.
        content = content.encode("utf-8", "backslashreplace")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if os.path.lexists(path):
            _write_over(path, content)
        else:
            with path.open("xb") as stream:
                stream.write(content)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror or error}.") from error


def _write_over(path: Path, content: bytes) -> None:
    """Replace a file atomically: a full disk leaves the old one."""
    part = path.with_name(f".{path.name}.part-{os.getpid()}")
    try:
        part.write_bytes(content)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


# Earlier reports


def _check_earlier(folder: Path) -> None:
    """Raise if a folder is neither free nor an earlier report."""
    if not _is_free(folder) and not (folder.is_dir() and (folder / LIST).is_file()):
        raise OutputExistsError(
            f"--overwrite replaces reports of an analysis, and {folder} is not one: it has no list "
            f"of its files ({LIST}). Choose another folder with --report, or move it away."
        )


def _replace(folder: Path, part: Path, sums: Mapping[str, set[str]]) -> None:
    """Move the files of a new report into the folder of an earlier one, whose own files go."""
    earlier = _read_list(folder)
    for name in sums:
        if os.path.lexists(folder / name) and not _is_own(folder, name, earlier):
            raise OutputExistsError(
                f"The report {folder} is unchanged: {name} in it was modified, or not written by "
                "an analysis, and --overwrite does not replace such files; move it away, or choose "
                "another folder with --report."
            )
    try:
        # If this is interrupted, the list still contains all files.
        both = {
            name: earlier.get(name, set()) | sums.get(name, set()) for name in {*earlier, *sums}
        }
        _write_over(folder / LIST, _listed(both).encode())
        for name in sums:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (part / name).replace(folder / name)
        for name in earlier.keys() - sums.keys():
            if _is_own(folder, name, earlier):
                (folder / name).unlink()
                with suppress(OSError):  # folders that are not empty stay
                    (folder / name).parent.rmdir()
        _write_over(folder / LIST, _listed(sums).encode())
    except OSError as error:
        raise OutputError(
            f"The report {folder} cannot be replaced: {error.strerror or error}."
        ) from error


def _is_own(folder: Path, name: str, earlier: Mapping[str, set[str]]) -> bool:
    """Whether a file inside the folder is one of its list, and unchanged."""
    path = folder / name
    inside = path.resolve().is_relative_to(folder.resolve()) and not path.is_symlink()
    return inside and path.is_file() and _sha256(path) in earlier.get(name, ())


def _read_list(folder: Path) -> dict[str, set[str]]:
    """Read SHA-256 by name; of a file that was just being replaced there are two."""
    found: dict[str, set[str]] = {}
    try:
        for line in read_text(folder / LIST, _LONGEST_LIST).splitlines():
            checksum, _, name = line.partition("  ")
            found.setdefault(name, set()).add(checksum)
    except DocumentError as error:
        raise OutputError(f"{folder / LIST} {error}.") from error
    return found


def _listed(sums: Mapping[str, set[str]]) -> str:
    return "".join(
        f"{checksum}  {name}\n" for name in sorted(sums) for checksum in sorted(sums[name])
    )


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
