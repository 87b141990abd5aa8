"""Reading of channels from MATLAB files, and writing of tables as MATLAB files of version 5."""

from __future__ import annotations

import re
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from analysis.exchange._matlab_times import stated_times, states_time
from analysis.exchange._source import (
    ExchangeError,
    SourceChannel,
    bounded_memory,
    check_samples,
    no_such_channel_error,
    real_vector,
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
"""First bytes of an HDF5 file."""
_HDF5_OFFSETS: Final = (0, 512)  # MATLAB writes its own header of 512 bytes before the HDF5 data
"""Offsets at which an HDF5 file may begin."""


def read(path: Path, names: Sequence[str]) -> Mapping[str, SourceChannel]:
    """Read vectors from a MATLAB file (see `analysis.exchange.read_source`).

    A channel is a variable ``angle``, a field of a struct ``log.angle``, a field of an element of a
    struct array ``log(2).angle``, or a column of a matrix ``data#2``, counted from 1.
    """
    with path.open("rb") as stream:
        first_bytes = stream.read(max(_HDF5_OFFSETS) + len(_HDF5_MAGIC))
    if any(
        first_bytes[offset : offset + len(_HDF5_MAGIC)] == _HDF5_MAGIC for offset in _HDF5_OFFSETS
    ):
        return _read_hdf5(path, names)
    return _read_mat(path, names)


def _read_mat(path: Path, names: Sequence[str]) -> Mapping[str, SourceChannel]:
    """Read vectors from a MATLAB file of version 4 to 7."""
    from scipy.io import loadmat, whosmat

    try:
        with bounded_memory():
            return _read_channels(path, names, whosmat(path), partial(loadmat, spmatrix=False))
    except (ExchangeError, OSError, MemoryError):
        raise
    except Exception as error:  # scipy raises many types on a damaged file
        raise ExchangeError(
            f"{path}: is not a MATLAB file of version 4 to 7, or is damaged ({error}); save it "
            "again with save('-v7', …)."
        ) from error


def _read_channels(
    path: Path,
    names: Sequence[str],
    variable_list: Sequence[tuple[str, tuple[int, ...], str]],
    load: Callable[..., Mapping[str, Any]],
) -> dict[str, SourceChannel]:
    """Load the requested variables after checking their listed sizes, and return the channels."""
    shapes = {name: shape for name, shape, _ in variable_list}
    variables = {name: _split_element(_split_name(name, shapes)[0])[0] for name in names}
    for name, variable in variables.items():
        if variable not in shapes:
            raise no_such_channel_error(path, name, shapes)
        check_samples(path, f"The variable '{variable}'", max(shapes[variable], default=0))
    time_variables = {
        n for n in shapes if states_time(n) and max(shapes[n], default=0) <= MAX_SAMPLES
    }
    contents = load(path, variable_names=sorted(time_variables | set(variables.values())))
    loaded = {name: contents[name] for name in shapes if name in contents}

    def names_in(parent: str) -> Sequence[str]:
        """Return the names of the fields of a struct, or of all loaded variables."""
        if not parent:
            return list(loaded)
        value = _find_value(path, parent, loaded)
        return getattr(getattr(value, "dtype", None), "names", None) or ()

    channels = {}
    for name in names:
        values = _read_vector(path, name, loaded)
        label = _timeseries_unit(path, name, loaded)
        rate_hz, times = stated_times(
            name, names, len(values), names_in, partial(_vector_from, path, loaded)
        )
        channels[name] = SourceChannel(values, unit_label=label, rate_hz=rate_hz, times=times)
    return channels


def _vector_from(path: Path, contents: Mapping[str, Any], name: str) -> NDArray[Any]:
    """Return the values of a channel; the argument order allows `functools.partial`."""
    return _read_vector(path, name, contents)


_UNIT_FIELDS: Final = {"Time": "TimeInfo", "Data": "DataInfo"}
"""Field of a timeseries struct that states the unit of another field."""


def _timeseries_unit(path: Path, name: str, contents: Mapping[str, Any]) -> str:
    """Return the unit stated in a struct with the fields of a timeseries, or an empty text."""
    parent, _, field = name.rpartition(".")
    if field not in _UNIT_FIELDS:
        return ""
    try:
        value = _find_value(path, f"{parent}.{_UNIT_FIELDS[field]}.Units", contents)
    except ExchangeError:
        return ""
    return str(value.reshape(-1)[0]) if value.dtype.kind == "U" and value.size == 1 else ""


def _split_name(name: str, variables: Container[str]) -> tuple[str, list[str], int | None]:
    """Split a channel's name ``log.angle#2`` into variable, fields and column index (from 0)."""
    column = None
    if name not in variables:
        name_part, separator, number = name.rpartition("#")
        if separator and number.isdecimal() and int(number) > 0:
            name, column = name_part, int(number) - 1
    variable, *fields = name.split(".")
    return variable, fields, column


_ELEMENT_PATTERN: Final = re.compile(r"(.+)\((\d+)\)")
"""Pattern of the name of an element of a struct array."""


def _split_element(text: str) -> tuple[str, int | None]:
    """Split ``log(2)`` into name and element index (from 0); the index is None without one."""
    match = _ELEMENT_PATTERN.fullmatch(text)
    return (match[1], int(match[2]) - 1) if match else (text, None)


def _read_vector(path: Path, name: str, contents: Mapping[str, Any]) -> NDArray[Any]:
    """Return the values of a channel, given its name in the file."""
    return _vector_or_column(
        path, name, _find_value(path, name, contents), _split_name(name, contents)[2]
    )


def _find_value(path: Path, name: str, contents: Mapping[str, Any]) -> Any:  # noqa: ANN401
    """Return a variable, or a field of a struct or of an element of a struct array."""
    variable, fields, _ = _split_name(name, contents)
    value: Any = None
    parent_name = ""
    for depth, component in enumerate((variable, *fields)):
        key, element = _split_element(component)
        if depth:
            dtype = getattr(value, "dtype", None)
            if dtype is None or dtype.names is None:
                raise ExchangeError(
                    f"{path}: '{name}' asks for a field '{key}', but its parent '{parent_name}' is "
                    "not "
                    "one struct."
                )
            if value.size != 1:
                shape_text = "×".join(map(str, value.shape))
                raise ExchangeError(
                    f"{path}: '{parent_name}' is a struct array of {shape_text}, not one struct; "
                    "name one of "
                    f"its elements, such as {parent_name}(1).{key}, or save [{parent_name}.{key}] "
                    "as a vector."
                )
            if key not in dtype.names:
                raise no_such_channel_error(
                    path, name, (f"{parent_name}.{field}" for field in dtype.names)
                )
            value = value.reshape(-1)[0][key]
        elif key not in contents:
            raise no_such_channel_error(path, name, contents)
        else:
            value = contents[key]
        parent_name = f"{parent_name}.{component}" if depth else component
        if element is not None:
            count = getattr(value, "size", 0)
            if not 0 <= element < count:
                raise ExchangeError(
                    f"{path}: '{parent_name}' is not there; '{key}' has {count} elements."
                )
            value = value.reshape(-1, order="F")[element : element + 1]
    return value


_OBJECT_TYPES: Final = ("MatlabOpaque", "MatlabObject", "MatlabFunction")
"""Types by which scipy represents MATLAB objects that it cannot read."""


def _vector_or_column(path: Path, name: str, value: Any, column: int | None) -> NDArray[Any]:  # noqa: ANN401
    """Return an array as a vector of floats, or one column of it; raise if it is neither."""
    shape = getattr(value, "shape", None)
    if type(value).__name__ in _OBJECT_TYPES:
        raise ExchangeError(
            f"{path}: '{name}' is an object of MATLAB (timeseries, table, datetime or the like); "
            "save its values as vectors, such as t = x.Time; angle = x.Data."
        )
    names = getattr(getattr(value, "dtype", None), "names", None)
    if names:
        field_names = ", ".join(f"{name}.{field}" for field in names[:12])
        raise ExchangeError(
            f"{path}: '{name}' is a struct; choose one of its fields: {field_names}."
        )
    if shape is None or getattr(value, "dtype", None) is None or hasattr(value, "tocoo"):
        raise ExchangeError(f"{path}: '{name}' is not a full array of numbers; save it as one.")
    check_samples(path, f"'{name}'", max(shape, default=0))
    if column is None:
        if value.size != max(shape, default=0):
            shape_text = "×".join(map(str, shape))
            raise ExchangeError(
                f"{path}: '{name}' is a matrix of {shape_text}; name one of its columns, such as "
                f"{name}#1."
            )
        return real_vector(path, name, value.reshape(-1))
    if value.ndim != 2 or column >= value.shape[1]:
        shape_text = "×".join(map(str, shape))
        raise ExchangeError(f"{path}: '{name}' is not a column of it, its size is {shape_text}.")
    if value.shape[0] < value.shape[1]:
        raise ExchangeError(
            f"{path}: '{name}' has {value.shape[0]} values, fewer than there are columns "
            f"({value.shape[1]}); channels are columns: save the matrix transposed."
        )
    return real_vector(path, name, value[:, column])


def _read_hdf5(path: Path, names: Sequence[str]) -> Mapping[str, SourceChannel]:
    """Read vectors from a MATLAB file of version 7.3, which is an HDF5 file."""
    try:
        import h5py
    except ImportError as error:
        raise ExchangeError(
            f"{path}: is a MATLAB file of version 7.3; save it with save('-v7', …), or install the "
            "package h5py."
        ) from error
    try:
        with bounded_memory(), h5py.File(path, "r") as file:
            return {name: _read_hdf5_channel(path, file, name, names, h5py) for name in names}
    except (ExchangeError, MemoryError):
        raise
    except Exception as error:  # h5py raises many types on a damaged file
        raise ExchangeError(
            f"{path}: cannot be read as a MATLAB file of version 7.3 ({error}); save it with "
            "save('-v7', …)."
        ) from error


_NUMERIC_CLASSES: Final = (
    "double", "single", "logical",
    *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
)  # fmt: skip
"""Names of MATLAB's numeric classes."""


def _read_hdf5_channel(
    path: Path,
    file: Any,  # noqa: ANN401
    name: str,
    names: Sequence[str],
    h5py: Any,  # noqa: ANN401
) -> SourceChannel:
    """Return one channel of a MATLAB file of version 7.3."""

    def names_in(parent: str) -> Sequence[str]:
        """Return the names of the members of a group of the file."""
        group = file[parent.replace(".", "/")] if parent else file
        return list(group) if isinstance(group, h5py.Group) else ()

    values = _read_hdf5_vector(path, file, name, h5py)
    rate_hz, times = stated_times(
        name, names, len(values), names_in, lambda other: _read_hdf5_vector(path, file, other, h5py)
    )
    return SourceChannel(values, rate_hz=rate_hz, times=times)


def _read_hdf5_vector(path: Path, file: Any, name: str, h5py: Any) -> NDArray[Any]:  # noqa: ANN401
    """Return the values of one vector of a MATLAB file of version 7.3."""
    variables = list(file)  # only names, as a link may lead into another file
    variable, fields, column = _split_name(name, variables)
    dataset = file
    for component in (variable, *fields):
        link = _hdf5_link(dataset, component, h5py)
        if link is None:
            raise no_such_channel_error(
                path, name, (member for member in variables if not member.startswith("#"))
            )
        if not isinstance(link, h5py.HardLink):
            raise _external_data_error(path, name)
        dataset = dataset[component]
    if not isinstance(dataset, h5py.Dataset):
        field_names = ", ".join(f"{name}.{member}" for member in list(dataset)[:12])
        raise ExchangeError(
            f"{path}: '{name}' is a struct; choose one of its fields: {field_names}."
        )
    if dataset.is_virtual or dataset.external:
        raise _external_data_error(path, name)
    check_samples(path, f"'{name}'", max(dataset.shape or (), default=0))
    matlab_class = dataset.attrs.get("MATLAB_class", b"double")
    matlab_class = (
        matlab_class.decode("ascii", "replace")
        if isinstance(matlab_class, bytes)
        else str(matlab_class)
    )
    if (
        matlab_class not in _NUMERIC_CLASSES
        or dataset.dtype.kind == "O"
        or "MATLAB_empty" in dataset.attrs
    ):
        raise ExchangeError(
            f"{path}: '{name}' holds no numbers but is of MATLAB's class {matlab_class}, a struct "
            "array or "
            "empty; save the values of one record as vectors, such as angle = log(1).angle."
        )
    # HDF5 stores dimensions in the reverse order, so that MATLAB's columns are its rows.
    return _vector_or_column(path, name, dataset[()].T, column)


def _hdf5_link(group: Any, name: str, h5py: Any) -> object:  # noqa: ANN401
    """Return the link to a member of a group, not followed; None without such a member."""
    if not isinstance(group, h5py.Group) or "/" in name or name in ("", "."):
        return None
    return group.get(name, getlink=True)


def _external_data_error(path: Path, name: str) -> ExchangeError:
    """Return the error for a channel whose samples are stored outside the file."""
    return ExchangeError(
        f"{path}: '{name}' is a link or refers to samples stored elsewhere, which are not read; "
        "save the channel itself with save('-v7', …)."
    )


# Writing


def write_mat(table: ExportTable, stream: BinaryIO) -> None:
    """Write a table as MATLAB variables (n×1), and its metadata as a struct ``information``.

    A field of the struct is a number, a row of numbers if the text has several with commas between
    them, or else a text.
    """
    from scipy.io import savemat

    variables = {column.name: column.values for column in (table.axis, *table.columns)}
    savemat(
        stream,
        {
            **variables,
            "information": {
                _field_name(k): _metadata_value(k, v) for k, v in table.information.items()
            },
        },
        long_field_names=True,
        do_compression=True,
        oned_as="column",
    )


_TEXT_KEYS: Final = ("id", *NOTES)
"""Keys of metadata that remain texts even if they have the form of numbers."""
_NUMBER_PATTERN: Final = re.compile(r"[-+]?(?:(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|inf|nan)")
"""Pattern of a number in the metadata."""
_LARGEST_EXACT: Final = 2**53
"""Largest number up to which every integer is exact as a double."""


def _metadata_value(key: str, text: str) -> str | float | NDArray[Any]:
    """Return the value of a metadata text: a number, a row of numbers, or the text."""
    entries = [entry.strip() for entry in text.split(",")]
    is_text = key in _TEXT_KEYS or (key.startswith(META_PREFIX) and not unit_of(key))
    if is_text or not all(map(_NUMBER_PATTERN.fullmatch, entries)):
        return text
    if len(entries) > 1:
        return np.array([list(map(float, entries))])
    if text.strip().isdecimal() and _LARGEST_EXACT < int(text) < 2**63:
        return np.array([[int(text)]], dtype=np.int64)
    return float(text)


def _field_name(key: str) -> str:
    """Return a valid MATLAB field name for a key."""
    name = "".join(c if c.isascii() and (c.isalnum() or c == "_") else "_" for c in key)
    return (name if name[:1].isalpha() else f"x{name}")[:63]
