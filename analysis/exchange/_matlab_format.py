"""Reading of channels from MATLAB files, and writing of tables as MATLAB files of version 5."""

from __future__ import annotations

import re
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from analysis.exchange._matlab_times import is_name_of_times, stated_times
from analysis.exchange._source import (
    ExchangeError,
    SourceChannel,
    bounded_memory,
    check_sample_count,
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


def read(path: Path, channel_names: Sequence[str]) -> Mapping[str, SourceChannel]:
    """Read vectors from a MATLAB file (see `analysis.exchange.read_source`).

    A channel is a variable ``angle``, a field of a struct ``log.angle``, a field of an element of a
    struct array ``log(2).angle``, or a column of a matrix ``data#2``, counted from 1.
    """
    with path.open("rb") as stream:
        first_bytes = stream.read(max(_HDF5_OFFSETS) + len(_HDF5_MAGIC))
    if any(
        first_bytes[magic_offset : magic_offset + len(_HDF5_MAGIC)] == _HDF5_MAGIC
        for magic_offset in _HDF5_OFFSETS
    ):
        return _read_hdf5(path, channel_names)
    return _read_mat(path, channel_names)


def _read_mat(path: Path, channel_names: Sequence[str]) -> Mapping[str, SourceChannel]:
    """Read vectors from a MATLAB file of version 4 to 7."""
    from scipy.io import loadmat, whosmat

    try:
        with bounded_memory():
            return _read_channels(
                path, channel_names, whosmat(path), partial(loadmat, spmatrix=False)
            )
    except (ExchangeError, OSError, MemoryError):
        raise
    except Exception as error:  # scipy raises many types on a damaged file
        raise ExchangeError(
            f"{path}: is not a MATLAB file of version 4 to 7, or is damaged ({error}); save it "
            "again with save('-v7', …)."
        ) from error


def _read_channels(
    path: Path,
    channel_names: Sequence[str],
    listed_variables: Sequence[tuple[str, tuple[int, ...], str]],
    load_variables: Callable[..., Mapping[str, Any]],
) -> dict[str, SourceChannel]:
    """Load the requested variables after checking their listed sizes, and return the channels."""
    shape_by_name = {
        variable_name: variable_shape for variable_name, variable_shape, _ in listed_variables
    }
    variable_names = {
        channel_name: _split_element_index(_split_channel_name(channel_name, shape_by_name)[0])[0]
        for channel_name in channel_names
    }
    for channel_name, variable_name in variable_names.items():
        if variable_name not in shape_by_name:
            raise no_such_channel_error(path, channel_name, shape_by_name)
        check_sample_count(
            path, f"The variable '{variable_name}'", max(shape_by_name[variable_name], default=0)
        )
    time_variables = {
        n
        for n in shape_by_name
        if is_name_of_times(n) and max(shape_by_name[n], default=0) <= MAX_SAMPLES
    }
    file_variables = load_variables(
        path, variable_names=sorted(time_variables | set(variable_names.values()))
    )
    loaded_variables = {
        variable_name: file_variables[variable_name]
        for variable_name in shape_by_name
        if variable_name in file_variables
    }

    def member_names_of(parent_name: str) -> Sequence[str]:
        """Return the names of the fields of a struct, or of all loaded variables."""
        if not parent_name:
            return list(loaded_variables)
        parent_value = _find_variable_value(path, parent_name, loaded_variables)
        return getattr(getattr(parent_value, "dtype", None), "names", None) or ()

    channels = {}
    for channel_name in channel_names:
        channel_values = _read_vector(path, channel_name, loaded_variables)
        unit_label = _timeseries_unit(path, channel_name, loaded_variables)
        rate_hz, file_times = stated_times(
            channel_name,
            channel_names,
            len(channel_values),
            member_names_of,
            partial(_read_vector_of_channel, path, loaded_variables),
        )
        channels[channel_name] = SourceChannel(
            channel_values, unit_label=unit_label, rate_hz=rate_hz, times=file_times
        )
    return channels


def _read_vector_of_channel(
    path: Path, variables: Mapping[str, Any], channel_name: str
) -> NDArray[Any]:
    """Call `_read_vector` with the channel name last, as `functools.partial` requires."""
    return _read_vector(path, channel_name, variables)


_UNIT_FIELDS_BY_FIELD: Final = {"Time": "TimeInfo", "Data": "DataInfo"}
"""Fields of a timeseries struct, each with the field that states its unit."""


def _timeseries_unit(path: Path, channel_name: str, variables: Mapping[str, Any]) -> str:
    """Return the unit that a timeseries struct states for one of its fields, or an empty text."""
    parent_name, _, field_name = channel_name.rpartition(".")
    if field_name not in _UNIT_FIELDS_BY_FIELD:
        return ""
    try:
        unit_value = _find_variable_value(
            path, f"{parent_name}.{_UNIT_FIELDS_BY_FIELD[field_name]}.Units", variables
        )
    except ExchangeError:
        return ""
    return (
        str(unit_value.reshape(-1)[0])
        if unit_value.dtype.kind == "U" and unit_value.size == 1
        else ""
    )


def _split_channel_name(
    channel_name: str, variables: Container[str]
) -> tuple[str, list[str], int | None]:
    """Split a channel's name ``log.angle#2`` into variable, fields and column index (from 0)."""
    column_index = None
    if channel_name not in variables:
        name_part, separator, column_number = channel_name.rpartition("#")
        if separator and column_number.isdecimal() and int(column_number) > 0:
            channel_name, column_index = name_part, int(column_number) - 1
    variable, *field_names = channel_name.split(".")
    return variable, field_names, column_index


_ELEMENT_PATTERN: Final = re.compile(r"(.+)\((\d+)\)")
"""Pattern of the name of an element of a struct array."""


def _split_element_index(name_component: str) -> tuple[str, int | None]:
    """Split ``log(2)`` into name and element index (from 0), which is None for a plain name."""
    element_match = _ELEMENT_PATTERN.fullmatch(name_component)
    return (
        (element_match[1], int(element_match[2]) - 1) if element_match else (name_component, None)
    )


def _read_vector(path: Path, channel_name: str, variables: Mapping[str, Any]) -> NDArray[Any]:
    """Return the values of a channel, given its name in the file."""
    return _vector_of_array(
        path,
        channel_name,
        _find_variable_value(path, channel_name, variables),
        _split_channel_name(channel_name, variables)[2],
    )


def _find_variable_value(path: Path, channel_name: str, variables: Mapping[str, Any]) -> Any:  # noqa: ANN401
    """Return a variable, or a field of a struct or of an element of a struct array."""
    variable, field_names, _ = _split_channel_name(channel_name, variables)
    found_value: Any = None
    parent_name = ""
    for component_index, name_component in enumerate((variable, *field_names)):
        member_name, element_index = _split_element_index(name_component)
        if component_index:
            dtype = getattr(found_value, "dtype", None)
            if dtype is None or dtype.names is None:
                raise ExchangeError(
                    f"{path}: '{channel_name}' asks for a field '{member_name}', but its parent "
                    f"'{parent_name}' is not "
                    "one struct."
                )
            if found_value.size != 1:
                shape_text = "×".join(map(str, found_value.shape))
                raise ExchangeError(
                    f"{path}: '{parent_name}' is a struct array of {shape_text}, not one struct; "
                    f"name one of its elements, such as {parent_name}(1).{member_name}, or save "
                    f"[{parent_name}.{member_name}] as a vector."
                )
            if member_name not in dtype.names:
                raise no_such_channel_error(
                    path, channel_name, (f"{parent_name}.{field}" for field in dtype.names)
                )
            found_value = found_value.reshape(-1)[0][member_name]
        elif member_name not in variables:
            raise no_such_channel_error(path, channel_name, variables)
        else:
            found_value = variables[member_name]
        parent_name = f"{parent_name}.{name_component}" if component_index else name_component
        if element_index is not None:
            element_count = getattr(found_value, "size", 0)
            if not 0 <= element_index < element_count:
                raise ExchangeError(
                    f"{path}: '{parent_name}' is not there; '{member_name}' has {element_count} "
                    "elements."
                )
            found_value = found_value.reshape(-1, order="F")[element_index : element_index + 1]
    return found_value


_MATLAB_OBJECT_TYPES: Final = ("MatlabOpaque", "MatlabObject", "MatlabFunction")
"""Types by which scipy represents MATLAB objects that it cannot read."""


def _vector_of_array(
    path: Path,
    channel_name: str,
    array: Any,  # noqa: ANN401
    column_index: int | None,
) -> NDArray[Any]:
    """Return an array, or one column of it, as a vector of floats; raise if it is no vector."""
    array_shape = getattr(array, "shape", None)
    if type(array).__name__ in _MATLAB_OBJECT_TYPES:
        raise ExchangeError(
            f"{path}: '{channel_name}' is an object of MATLAB (timeseries, table, datetime or the "
            "like); save its values as vectors, such as t = x.Time; angle = x.Data."
        )
    dtype_names = getattr(getattr(array, "dtype", None), "names", None)
    if dtype_names:
        field_names = ", ".join(f"{channel_name}.{field_name}" for field_name in dtype_names[:12])
        raise ExchangeError(
            f"{path}: '{channel_name}' is a struct; choose one of its fields: {field_names}."
        )
    if array_shape is None or getattr(array, "dtype", None) is None or hasattr(array, "tocoo"):
        raise ExchangeError(
            f"{path}: '{channel_name}' is not a full array of numbers; save it as one."
        )
    check_sample_count(path, f"'{channel_name}'", max(array_shape, default=0))
    if column_index is None:
        if array.size != max(array_shape, default=0):
            shape_text = "×".join(map(str, array_shape))
            raise ExchangeError(
                f"{path}: '{channel_name}' is a matrix of {shape_text}; name one of its columns, "
                f"such as {channel_name}#1."
            )
        return real_vector(path, channel_name, array.reshape(-1))
    if array.ndim != 2 or column_index >= array.shape[1]:
        shape_text = "×".join(map(str, array_shape))
        raise ExchangeError(
            f"{path}: '{channel_name}' is not a column of it, its size is {shape_text}."
        )
    if array.shape[0] < array.shape[1]:
        raise ExchangeError(
            f"{path}: '{channel_name}' has {array.shape[0]} values, fewer than there are columns "
            f"({array.shape[1]}); channels are columns: save the matrix transposed."
        )
    return real_vector(path, channel_name, array[:, column_index])


def _read_hdf5(path: Path, channel_names: Sequence[str]) -> Mapping[str, SourceChannel]:
    """Read vectors from a MATLAB file of version 7.3, which is an HDF5 file."""
    try:
        import h5py
    except ImportError as error:
        raise ExchangeError(
            f"{path}: is a MATLAB file of version 7.3; save it with save('-v7', …), or install the "
            "package h5py."
        ) from error
    try:
        with bounded_memory(), h5py.File(path, "r") as hdf5_file:
            return {
                channel_name: _read_hdf5_channel(path, hdf5_file, channel_name, channel_names, h5py)
                for channel_name in channel_names
            }
    except (ExchangeError, MemoryError):
        raise
    except Exception as error:  # h5py raises many types on a damaged file
        raise ExchangeError(
            f"{path}: cannot be read as a MATLAB file of version 7.3 ({error}); save it with "
            "save('-v7', …)."
        ) from error


_MATLAB_NUMERIC_CLASSES: Final = (
    "double", "single", "logical",
    *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
)  # fmt: skip
"""Names of MATLAB's numeric classes."""


def _read_hdf5_channel(
    path: Path,
    hdf5_file: Any,  # noqa: ANN401
    channel_name: str,
    channel_names: Sequence[str],
    h5py: Any,  # noqa: ANN401
) -> SourceChannel:
    """Return one channel of a MATLAB file of version 7.3."""

    def member_names_of(parent_name: str) -> Sequence[str]:
        """Return the names of the members of a group of the file."""
        group = hdf5_file[parent_name.replace(".", "/")] if parent_name else hdf5_file
        return list(group) if isinstance(group, h5py.Group) else ()

    channel_values = _read_hdf5_vector(path, hdf5_file, channel_name, h5py)
    rate_hz, file_times = stated_times(
        channel_name,
        channel_names,
        len(channel_values),
        member_names_of,
        lambda sibling_name: _read_hdf5_vector(path, hdf5_file, sibling_name, h5py),
    )
    return SourceChannel(channel_values, rate_hz=rate_hz, times=file_times)


def _read_hdf5_vector(path: Path, hdf5_file: Any, channel_name: str, h5py: Any) -> NDArray[Any]:  # noqa: ANN401
    """Return the values of the named vector of a MATLAB file of version 7.3."""
    variable_names = list(hdf5_file)  # only names, as a link may lead into another file
    variable, path_names, column_index = _split_channel_name(channel_name, variable_names)
    dataset = hdf5_file
    for name_component in (variable, *path_names):
        member_link = _hdf5_link(dataset, name_component, h5py)
        if member_link is None:
            raise no_such_channel_error(
                path,
                channel_name,
                (member_name for member_name in variable_names if not member_name.startswith("#")),
            )
        if not isinstance(member_link, h5py.HardLink):
            raise _external_data_error(path, channel_name)
        dataset = dataset[name_component]
    if not isinstance(dataset, h5py.Dataset):
        field_names = ", ".join(
            f"{channel_name}.{member_name}" for member_name in list(dataset)[:12]
        )
        raise ExchangeError(
            f"{path}: '{channel_name}' is a struct; choose one of its fields: {field_names}."
        )
    if dataset.is_virtual or dataset.external:
        raise _external_data_error(path, channel_name)
    check_sample_count(path, f"'{channel_name}'", max(dataset.shape or (), default=0))
    matlab_class = dataset.attrs.get("MATLAB_class", b"double")
    matlab_class = (
        matlab_class.decode("ascii", "replace")
        if isinstance(matlab_class, bytes)
        else str(matlab_class)
    )
    if (
        matlab_class not in _MATLAB_NUMERIC_CLASSES
        or dataset.dtype.kind == "O"
        or "MATLAB_empty" in dataset.attrs
    ):
        raise ExchangeError(
            f"{path}: '{channel_name}' holds no numbers but is of MATLAB's class {matlab_class}, a "
            "struct array or empty; save the values of one record as vectors, such as angle = "
            "log(1).angle."
        )
    # HDF5 stores dimensions in the reverse order, so that MATLAB's columns are its rows.
    return _vector_of_array(path, channel_name, dataset[()].T, column_index)


def _hdf5_link(hdf5_group: Any, member_name: str, h5py: Any) -> object:  # noqa: ANN401
    """Return the link to a member of a group without following it; None if there is no member."""
    if not isinstance(hdf5_group, h5py.Group) or "/" in member_name or member_name in ("", "."):
        return None
    return hdf5_group.get(member_name, getlink=True)


def _external_data_error(path: Path, channel_name: str) -> ExchangeError:
    """Return the error for a channel whose samples are stored outside the file."""
    return ExchangeError(
        f"{path}: '{channel_name}' is a link or refers to samples stored elsewhere, which are "
        "not read; save the channel itself with save('-v7', …)."
    )


# Writing


def write_mat(table: ExportTable, stream: BinaryIO) -> None:
    """Write a table as MATLAB variables (n×1), and its metadata as a struct ``information``.

    A field of the struct is a number, a row of numbers if the text has several with commas between
    them, or else a text.
    """
    from scipy.io import savemat

    mat_variables = {column.name: column.values for column in (table.axis, *table.columns)}
    savemat(
        stream,
        {
            **mat_variables,
            "information": {
                _matlab_field_name(k): _metadata_value(k, v) for k, v in table.information.items()
            },
        },
        long_field_names=True,
        do_compression=True,
        oned_as="column",
    )


_TEXT_METADATA_KEYS: Final = ("id", *NOTES)
"""Keys of metadata that remain texts even if they have the form of numbers."""
_NUMBER_PATTERN: Final = re.compile(r"[-+]?(?:(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|inf|nan)")
"""Pattern of a number in the metadata."""
_MAX_EXACT_INTEGER: Final = 2**53
"""Largest number up to which every integer is exact as a double."""


def _metadata_value(metadata_key: str, metadata_text: str) -> str | float | NDArray[Any]:
    """Return the value of a metadata text: a number, a row of numbers, or the text."""
    text_entries = [entry.strip() for entry in metadata_text.split(",")]
    is_text = metadata_key in _TEXT_METADATA_KEYS or (
        metadata_key.startswith(META_PREFIX) and not unit_of(metadata_key)
    )
    if is_text or not all(map(_NUMBER_PATTERN.fullmatch, text_entries)):
        return metadata_text
    if len(text_entries) > 1:
        return np.array([list(map(float, text_entries))])
    if metadata_text.strip().isdecimal() and _MAX_EXACT_INTEGER < int(metadata_text) < 2**63:
        return np.array([[int(metadata_text)]], dtype=np.int64)
    return float(metadata_text)


def _matlab_field_name(metadata_key: str) -> str:
    """Return a valid MATLAB field name for a key."""
    field_name = "".join(
        c if c.isascii() and (c.isalnum() or c == "_") else "_" for c in metadata_key
    )
    return (field_name if field_name[:1].isalpha() else f"x{field_name}")[:63]
