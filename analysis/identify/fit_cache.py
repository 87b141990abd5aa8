"""Cache of the fits to whole records, so that no record is fitted twice.

A quick look, a report, a campaign and an exported model of one session need the same fits. The
first of them stores the fits in the user's cache folder (``$XDG_CACHE_HOME/rigd/fits``, by default
``~/.cache/rigd/fits``), and the others read them there. The key of an entry is a digest of all data
and settings that enter the fits, and of the programs that compute them: an entry is used only if
the same programs would fit the same samples with the same settings. The folder may be deleted at
any time; the environment variable ``RIGD_NO_CACHE`` switches the cache off.
"""

from __future__ import annotations

import io
import os
import pickle
import platform
import stat
import tempfile
from contextlib import suppress
from dataclasses import fields, replace
from functools import cache
from hashlib import blake2b
from importlib.metadata import version as installed_version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np

from rigd.runtime import read_plain_file
from rigd.runtime.computations import ValuePickler
from rigd.runtime.user_folders import cache_folder

if TYPE_CHECKING:
    from collections.abc import Iterable
    from typing import IO

    from analysis.identify import Measurement, Selection, Setting

_MAX_CACHE_BYTES: Final = 1 << 30
"""Largest total size of the cache in bytes: the fits of some 200 sessions of two minutes."""
_DIGEST_BYTES: Final = 32
"""Size in bytes of the digest at the end of an entry, which shows whether the entry is intact."""
_PROGRAMS: Final = ("analysis", "rigd")
"""Packages on whose source code the fits depend."""
_LIBRARIES: Final = ("numpy", "scipy")
"""Libraries on whose version the fits depend."""


class FitCache:
    """Fits of whole records in a folder.

    Parameters
    ----------
    folder : Path
        Folder of the entries, which is created when the first one is stored.
    max_bytes : int, optional
        Largest total size of the entries. Those that have not been used for the longest time are
        removed.
    """

    def __init__(self, folder: Path, max_bytes: int = _MAX_CACHE_BYTES) -> None:
        self._folder, self._max_bytes = folder, max_bytes

    @classmethod
    def of_user(cls) -> FitCache | None:
        """Return the cache of the user; None if it is switched off or would not be safe.

        An entry is a pickle, which can execute any code: it is not safe if another user can write
        to the folder.
        """
        user_folder = cache_folder()
        if os.environ.get("RIGD_NO_CACHE") or user_folder is None or not hasattr(os, "geteuid"):
            return None
        fits_folder = user_folder / "fits"
        if not (_only_user_writes(user_folder) and _only_user_writes(fits_folder)):
            return None
        try:
            _programs_digest()
        except (OSError, ImportError):  # a source file or a version that cannot be read
            return None
        return cls(fits_folder)

    def find(
        self,
        measurement: Measurement,
        fixed_settings: Iterable[Setting],
        band_hz: tuple[float, float],
    ) -> Selection | None:
        """Return the stored selection of a record; None if there is none.

        Parameters
        ----------
        measurement, fixed_settings, band_hz
            Arguments of :func:`analysis.identify.select`.
        """
        path = self._entry_path(measurement, fixed_settings, band_hz)
        try:
            content = memoryview(read_plain_file(path, _MAX_CACHE_BYTES))
        except OSError:
            return None
        stored_value, stored_digest = content[:-_DIGEST_BYTES], content[-_DIGEST_BYTES:]
        entry_digest = _entry_digest(path)
        entry_digest.update(stored_value)
        if entry_digest.digest() != stored_digest:
            return None
        with suppress(OSError):
            os.utime(path)
        unpickler = _MeasurementUnpickler(stored_value, measurement)
        return _with_name(cast("Selection", unpickler.load()), measurement.name)

    def store(
        self,
        selection: Selection,
        measurement: Measurement,
        fixed_settings: Iterable[Setting],
        band_hz: tuple[float, float],
    ) -> None:
        """Store the selection of a record; do nothing if that is not possible.

        It is not if the folder cannot be written, or if the selection cannot be pickled.

        Parameters
        ----------
        selection : Selection
            Result of :func:`analysis.identify.select`.
        measurement, fixed_settings, band_hz
            Its arguments.
        """
        path = self._entry_path(measurement, fixed_settings, band_hz)
        with suppress(OSError, pickle.PicklingError, AttributeError, TypeError):
            # Not with `parents` alone, which leaves the mode of the parents to the umask.
            self._folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._folder.mkdir(mode=0o700, exist_ok=True)
            # A name of its own until the entry is complete: others may write the same entry.
            with tempfile.NamedTemporaryFile(dir=self._folder, delete=False) as file:
                part_path = Path(file.name)
                try:
                    digesting_file = _DigestingFile(file, _entry_digest(path))
                    pickler = _MeasurementPickler(digesting_file, measurement)
                    pickler.dump(_with_name(selection, ""))
                    file.write(digesting_file.digest())
                    file.close()
                    part_path.replace(path)
                finally:
                    part_path.unlink(missing_ok=True)
            self._remove_unused()

    def _entry_path(
        self,
        measurement: Measurement,
        fixed_settings: Iterable[Setting],
        band_hz: tuple[float, float],
    ) -> Path:
        """Return the path of a record's entry; its name is the digest of all that it depends on.

        The record's name is not part of it: a file that was moved or copied has the same fits.
        """
        digest = blake2b(_programs_digest(), digest_size=16)
        for field in fields(measurement):
            if field.name != "name":
                digest.update(pickle.dumps((field.name, getattr(measurement, field.name)), 5))
        digest.update(pickle.dumps((tuple(fixed_settings), tuple(band_hz)), 5))
        return self._folder / f"{digest.hexdigest()}.fits"

    def _remove_unused(self) -> None:
        """Remove the entries that were not used for the longest time, until the rest is small."""
        entries = []
        for path in self._folder.iterdir():
            with suppress(OSError):  # another process may have removed it
                status = path.stat()
                entries.append((status.st_mtime_ns, status.st_size, path))
        total_bytes = 0
        for _, entry_bytes, path in sorted(entries, reverse=True):
            total_bytes += entry_bytes
            if total_bytes > self._max_bytes:
                path.unlink(missing_ok=True)


def _entry_digest(path: Path) -> blake2b:
    """Return the digest to which the content of an entry is added; it depends on the entry's name.

    An entry that was renamed to the name of another one is therefore not used.
    """
    return blake2b(path.stem.encode(), digest_size=_DIGEST_BYTES)


def _only_user_writes(folder: Path) -> bool:
    """Return whether a folder belongs to this user alone, or does not exist."""
    try:
        status = folder.stat()
    except FileNotFoundError:
        return True
    except OSError:
        return False
    return status.st_uid == os.geteuid() and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _programs_digest() -> bytes:
    """Return a digest of the programs that compute fits: their source code and versions."""
    versions = [f"{name} {installed_version(name)}" for name in _LIBRARIES]
    version_text = "\n".join([platform.python_version(), platform.machine(), *versions])
    return blake2b(version_text.encode() + _source_digest(), digest_size=16).digest()


@cache
def _source_digest() -> bytes:
    """Return a digest of the source code of this project's packages."""
    digest = blake2b(digest_size=16)
    source_folder = Path(__file__).resolve().parents[2]
    for program in _PROGRAMS:
        for path in sorted((source_folder / program).rglob("*.py")):
            if path.is_file():  # not the lock of an editor, a link without a target
                digest.update(os.fsencode(path.relative_to(source_folder)) + b"\0")
                digest.update(path.read_bytes())
    return digest.digest()


def _with_name(selection: Selection, name: str) -> Selection:
    """Return a selection of the record that has a name."""
    return replace(selection, verdict=replace(selection.verdict, name=name))


# Entries: pickles without the samples, which the reader of an entry has


class _DigestingFile:
    """Binary file that computes the digest of what is written to it."""

    def __init__(self, file: IO[bytes], digest: blake2b) -> None:
        self._file, self._digest = file, digest

    def write(self, content: bytes) -> int:
        """Write bytes, and include them in the digest."""
        self._digest.update(content)
        return self._file.write(content)

    def digest(self) -> bytes:
        """Return the digest of all bytes that were written."""
        return self._digest.digest()


def _objects_of_measurement(measurement: Measurement) -> dict[str, Any]:
    """Return a measurement and its arrays, to which an entry refers by these names."""
    arrays = {
        field.name: value
        for field in fields(measurement)
        if isinstance(value := getattr(measurement, field.name), np.ndarray)
    }
    return {"measurement": measurement, **arrays}


class _MeasurementPickler(ValuePickler):
    """Pickler that refers to a measurement and its arrays by name, which halves an entry."""

    def __init__(self, file: _DigestingFile, measurement: Measurement) -> None:
        super().__init__(file, protocol=5)
        self._names_by_id = {
            id(value): name for name, value in _objects_of_measurement(measurement).items()
        }

    def persistent_id(self, obj: object) -> str | None:
        """Return the name of an object of the measurement, None for any other object."""
        return self._names_by_id.get(id(obj))


class _MeasurementUnpickler(pickle.Unpickler):
    """Unpickler that replaces the names of a measurement and its arrays by the objects."""

    def __init__(self, content: memoryview, measurement: Measurement) -> None:
        super().__init__(io.BytesIO(content))
        self._objects_by_name = _objects_of_measurement(measurement)

    def persistent_load(self, pid: str) -> object:
        """Return the object with a name."""
        return self._objects_by_name[pid]
