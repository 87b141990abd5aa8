"""MATLAB files: channels of variables and structs, and a table as a file of version 5."""

from __future__ import annotations

import re
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from analysis.exchange._matlab_times import stated_times, states_time
from analysis.exchange._source import (
    ExchangeError,
    SourceChannel,
    as_column,
    bounded_memory,
    check_samples,
    no_such_channel,
)
from rigd.session.limits import MAX_SAMPLES
from rigd.session.user_metadata import META_PREFIX, NOTES
from rigd.units import unit_of

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Mapping, Sequence
    from pathlib import Path
    from typing import BinaryIO

    from numpy.typing import NDArray

    from analysis.exchange._table import ExportTable


# Reading

_HDF5_MAGIC: Final = b"\x89HDF\r\n\x1a\n"
_HDF5_AT: Final = (0, 512)  # MATLAB puts its own header of 512 bytes before it


def read(path: Path, names: Sequence[str]) -> Mapping[str, SourceChannel]:
    """Read vectors of a MATLAB file, as `analysis.exchange._source.read_source` asks for.

    A channel is a variable ``angle``, a field of a struct ``log.angle``, of one element of a struct
    array ``log(2).angle``, or a column of a matrix ``data#2``, counted from 1 as MATLAB does.
    """
    with path.open("rb") as stream:
        head = stream.read(max(_HDF5_AT) + len(_HDF5_MAGIC))
    if any(head[at : at + len(_HDF5_MAGIC)] == _HDF5_MAGIC for at in _HDF5_AT):
        return _read_hdf5(path, names)
    return _read_mat(path, names)


def _read_mat(path: Path, names: Sequence[str]) -> Mapping[str, SourceChannel]:
    from scipy.io import loadmat, whosmat

    try:
        with bounded_memory():
            return _vectors(path, names, whosmat(path), partial(loadmat, spmatrix=False))
    except (ExchangeError, OSError, MemoryError):
        raise
    except Exception as error:  # scipy lets through whatever a damaged file provokes
        raise ExchangeError(
            f"{path}: is not a MATLAB file of version 4 to 7, or is damaged ({error}); save it "
            "again with save('-v7', …)."
        ) from error


def _vectors(
    path: Path,
    names: Sequence[str],
    listed: Sequence[tuple[str, tuple[int, ...], str]],
    load: Callable[..., Mapping[str, Any]],
) -> dict[str, SourceChannel]:
    """Load the requested variables after a check of their listed sizes."""
    shapes = {name: shape for name, shape, _ in listed}
    variables = {name: _element(_split(name, shapes)[0])[0] for name in names}
    for name, variable in variables.items():
        if variable not in shapes:
            raise no_such_channel(path, name, shapes)
        check_samples(path, f"The variable '{variable}'", max(shapes[variable], default=0))
    time_variables = {
        n for n in shapes if states_time(n) and max(shapes[n], default=0) <= MAX_SAMPLES
    }
    contents = load(path, variable_names=sorted(time_variables | set(variables.values())))
    known = {name: contents[name] for name in shapes if name in contents}

    def fields(parent: str) -> Sequence[str]:
        if not parent:
            return list(known)
        value = _value_of(path, parent, known)
        return getattr(getattr(value, "dtype", None), "names", None) or ()

    channels = {}
    for name in names:
        values = _vector(path, name, known)
        label = _label(path, name, known)
        rate_hz, times = stated_times(
            name, names, len(values), fields, partial(_vector_of, path, known)
        )
        channels[name] = SourceChannel(values, unit_label=label, rate_hz=rate_hz, times=times)
    return channels


def _vector_of(path: Path, contents: Mapping[str, Any], name: str) -> NDArray[Any]:
    return _vector(path, name, contents)


_OF_TIMESERIES: Final = {"Time": "TimeInfo", "Data": "DataInfo"}


def _label(path: Path, name: str, contents: Mapping[str, Any]) -> str:
    """Return the unit that a struct with the fields of a timeseries states, "" if none."""
    parent, _, field = name.rpartition(".")
    if field not in _OF_TIMESERIES:
        return ""
    try:
        value = _value_of(path, f"{parent}.{_OF_TIMESERIES[field]}.Units", contents)
    except ExchangeError:
        return ""
    return str(value.reshape(-1)[0]) if value.dtype.kind == "U" and value.size == 1 else ""


def _split(name: str, variables: Container[str]) -> tuple[str, list[str], int | None]:
    """Split ``log.angle#2`` into variable, fields and column (from 0)."""
    column = None
    if name not in variables:
        whole, mark, number = name.rpartition("#")
        if mark and number.isdecimal() and int(number) > 0:
            name, column = whole, int(number) - 1
    variable, *fields = name.split(".")
    return variable, fields, column


_INDEXED: Final = re.compile(r"(.+)\((\d+)\)")


def _element(text: str) -> tuple[str, int | None]:
    """Split ``log(2)`` into the name and the element's index from 0 on, None without one."""
    found = _INDEXED.fullmatch(text)
    return (found[1], int(found[2]) - 1) if found else (text, None)


def _vector(path: Path, name: str, contents: Mapping[str, Any]) -> NDArray[Any]:
    return _column(path, name, _value_of(path, name, contents), _split(name, contents)[2])


def _value_of(path: Path, name: str, contents: Mapping[str, Any]) -> Any:  # noqa: ANN401
    """Return a variable, or a field of a struct or of one element of a struct array."""
    first, fields, _ = _split(name, contents)
    value: Any = None
    shown = ""
    for depth, part in enumerate((first, *fields)):
        key, element = _element(part)
        if depth:
            found = getattr(value, "dtype", None)
            if found is None or found.names is None:
                raise ExchangeError(
                    f"{path}: '{name}' asks for a field '{key}', but its parent '{shown}' is not "
                    "one struct."
                )
            if value.size != 1:
                size = "×".join(map(str, value.shape))
                raise ExchangeError(
                    f"{path}: '{shown}' is a struct array of {size}, not one struct; name one of "
                    f"its elements, such as {shown}(1).{key}, or save [{shown}.{key}] as a vector."
                )
            if key not in found.names:
                raise no_such_channel(path, name, (f"{shown}.{each}" for each in found.names))
            value = value.reshape(-1)[0][key]
        elif key not in contents:
            raise no_such_channel(path, name, contents)
        else:
            value = contents[key]
        shown = f"{shown}.{part}" if depth else part
        if element is not None:
            count = getattr(value, "size", 0)
            if not 0 <= element < count:
                raise ExchangeError(
                    f"{path}: '{shown}' is not there; '{key}' has {count} elements."
                )
            value = value.reshape(-1, order="F")[element : element + 1]
    return value


_OBJECTS: Final = ("MatlabOpaque", "MatlabObject", "MatlabFunction")


def _column(path: Path, name: str, value: Any, column: int | None) -> NDArray[Any]:  # noqa: ANN401
    shape = getattr(value, "shape", None)
    if type(value).__name__ in _OBJECTS:
        raise ExchangeError(
            f"{path}: '{name}' is an object of MATLAB (timeseries, table, datetime or the like); "
            "save its values as vectors, such as t = x.Time; angle = x.Data."
        )
    names = getattr(getattr(value, "dtype", None), "names", None)
    if names:
        listed = ", ".join(f"{name}.{each}" for each in names[:12])
        raise ExchangeError(f"{path}: '{name}' is a struct; choose one of its fields: {listed}.")
    if shape is None or getattr(value, "dtype", None) is None or hasattr(value, "tocoo"):
        raise ExchangeError(f"{path}: '{name}' is not a full array of numbers; save it as one.")
    check_samples(path, f"'{name}'", max(shape, default=0))
    if column is None:
        if value.size != max(shape, default=0):
            size = "×".join(map(str, shape))
            raise ExchangeError(
                f"{path}: '{name}' is a matrix of {size}; name one of its columns, such as "
                f"{name}#1."
            )
        return as_column(path, name, value.reshape(-1))
    if value.ndim != 2 or column >= value.shape[1]:
        size = "×".join(map(str, shape))
        raise ExchangeError(f"{path}: '{name}' is not a column of it, its size is {size}.")
    if value.shape[0] < value.shape[1]:
        raise ExchangeError(
            f"{path}: '{name}' has {value.shape[0]} values, fewer than there are columns "
            f"({value.shape[1]}); channels are columns: save the matrix transposed."
        )
    return as_column(path, name, value[:, column])


def _read_hdf5(path: Path, names: Sequence[str]) -> Mapping[str, SourceChannel]:
    try:
        import h5py
    except ImportError as error:
        raise ExchangeError(
            f"{path}: is a MATLAB file of version 7.3; save it with save('-v7', …), or install the "
            "package h5py."
        ) from error
    try:
        with bounded_memory(), h5py.File(path, "r") as file:
            return {name: _hdf5_channel(path, file, name, names, h5py) for name in names}
    except (ExchangeError, MemoryError):
        raise
    except Exception as error:  # h5py lets through whatever a damaged file provokes
        raise ExchangeError(
            f"{path}: cannot be read as a MATLAB file of version 7.3 ({error}); save it with "
            "save('-v7', …)."
        ) from error


_NUMERIC: Final = (
    "double", "single", "logical",
    *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
)  # fmt: skip


def _hdf5_channel(
    path: Path,
    file: Any,  # noqa: ANN401
    name: str,
    names: Sequence[str],
    h5py: Any,  # noqa: ANN401
) -> SourceChannel:
    def fields(parent: str) -> Sequence[str]:
        group = file[parent.replace(".", "/")] if parent else file
        return list(group) if isinstance(group, h5py.Group) else ()

    values = _hdf5_vector(path, file, name, h5py)
    rate_hz, times = stated_times(
        name, names, len(values), fields, lambda other: _hdf5_vector(path, file, other, h5py)
    )
    return SourceChannel(values, rate_hz=rate_hz, times=times)


def _hdf5_vector(path: Path, file: Any, name: str, h5py: Any) -> NDArray[Any]:  # noqa: ANN401
    variables = list(file)  # their names alone: a link may lead into another file
    variable, fields, column = _split(name, variables)
    dataset = file
    for part in (variable, *fields):
        link = _hdf5_link(dataset, part, h5py)
        if link is None:
            raise no_such_channel(
                path, name, (each for each in variables if not each.startswith("#"))
            )
        if not isinstance(link, h5py.HardLink):
            raise _stored_elsewhere(path, name)
        dataset = dataset[part]
    if not isinstance(dataset, h5py.Dataset):
        listed = ", ".join(f"{name}.{each}" for each in list(dataset)[:12])
        raise ExchangeError(f"{path}: '{name}' is a struct; choose one of its fields: {listed}.")
    if dataset.is_virtual or dataset.external:
        raise _stored_elsewhere(path, name)
    check_samples(path, f"'{name}'", max(dataset.shape or (), default=0))
    kind = dataset.attrs.get("MATLAB_class", b"double")
    kind = kind.decode("ascii", "replace") if isinstance(kind, bytes) else str(kind)
    if kind not in _NUMERIC or dataset.dtype.kind == "O" or "MATLAB_empty" in dataset.attrs:
        raise ExchangeError(
            f"{path}: '{name}' holds no numbers but is of MATLAB's class {kind}, a struct array or "
            "empty; save the values of one record as vectors, such as angle = log(1).angle."
        )
    # MATLAB's columns are the rows of HDF5, which counts its dimensions from the other end.
    return _column(path, name, dataset[()].T, column)


def _hdf5_link(group: Any, name: str, h5py: Any) -> object:  # noqa: ANN401
    """Return how a member of a group is linked, without following it; None: there is none."""
    if not isinstance(group, h5py.Group) or "/" in name or name in ("", "."):
        return None
    return group.get(name, getlink=True)


def _stored_elsewhere(path: Path, name: str) -> ExchangeError:
    """Return the error for a channel whose samples are stored elsewhere, unlike MATLAB's."""
    return ExchangeError(
        f"{path}: '{name}' is a link or refers to samples stored elsewhere, which are not read; "
        "save the channel itself with save('-v7', …)."
    )


# Writing


def write_mat(table: ExportTable, stream: BinaryIO) -> None:
    """Write each column as a variable of its name, n×1, and ``information``, a struct.

    Its fields are numbers where the information is one, rows where it is several with commas
    between them, otherwise texts.
    """
    from scipy.io import savemat

    variables = {column.name: column.values for column in (table.axis, *table.columns)}
    savemat(
        stream,
        {
            **variables,
            "information": {_identifier(k): _value(k, v) for k, v in table.information.items()},
        },
        long_field_names=True,
        do_compression=True,
        oned_as="column",
    )


_WORDS: Final = ("id", *NOTES)
_NUMBER: Final = re.compile(r"[-+]?(?:(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|inf|nan)")
_LARGEST_EXACT: Final = 2**53
"""From here on not every whole number is a double."""


def _value(key: str, text: str) -> str | float | NDArray[Any]:
    """Return the value of a text of the session's metadata."""
    parts = [part.strip() for part in text.split(",")]
    words = key in _WORDS or (key.startswith(META_PREFIX) and not unit_of(key))
    if words or not all(map(_NUMBER.fullmatch, parts)):
        return text
    if len(parts) > 1:
        return np.array([list(map(float, parts))])
    if text.strip().isdecimal() and _LARGEST_EXACT < int(text) < 2**63:
        return np.array([[int(text)]], dtype=np.int64)
    return float(text)


def _identifier(key: str) -> str:
    """Make a key of any file a field name that MATLAB takes."""
    name = "".join(c if c.isascii() and (c.isalnum() or c == "_") else "_" for c in key)
    return (name if name[:1].isalpha() else f"x{name}")[:63]
