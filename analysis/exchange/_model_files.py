"""Writing of linear models to JSON, NumPy and MATLAB files with the same variables."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any, BinaryIO, Final

import numpy as np

Variables = Mapping[str, Any]
"""Variables of a linear model by name: strings, numbers, lists of strings and arrays."""


def write_json(variables: Variables, stream: BinaryIO) -> None:
    """Write the variables of a linear model as a JSON object, with a line for each variable.

    Complex numbers are pairs of real and imaginary part; unknown values are null.
    """
    from analysis.results import finite_json

    json_content = finite_json(
        {variable_name: _json_value(json_value) for variable_name, json_value in variables.items()}
    )
    json_lines = (
        f"{json.dumps(variable_name)}: "
        f"{json.dumps(json_value, ensure_ascii=False, allow_nan=False)}"
        for variable_name, json_value in json_content.items()
    )
    stream.write(("{\n" + ",\n".join(json_lines) + "\n}\n").encode())


def write_npz(variables: Variables, stream: BinaryIO) -> None:
    """Write the variables of a linear model as NumPy arrays that can be loaded without pickle."""
    np.savez_compressed(
        stream,
        **{
            variable_name: _string_array(variable_value, np.str_)
            for variable_name, variable_value in variables.items()
        },
    )


def write_mat(variables: Variables, stream: BinaryIO) -> None:
    """Write the variables of a linear model to a MATLAB file of version 7.

    Lists of strings become cell arrays.
    """
    from scipy.io import savemat

    savemat(
        stream,
        {
            variable_name: _string_array(variable_value, np.object_)
            for variable_name, variable_value in variables.items()
        },
        do_compression=True,
        oned_as="column",
    )


MODEL_FORMATS: Final[Mapping[str, Callable[[Variables, BinaryIO], None]]] = {
    ".json": write_json,
    ".npz": write_npz,
    ".mat": write_mat,
}
"""Function that writes a linear model, by the suffix of the file."""


def _json_value(value: Any) -> Any:  # noqa: ANN401
    """Return an array as nested lists, its complex numbers as pairs; other values unchanged."""
    if not isinstance(value, np.ndarray):
        return value
    if np.iscomplexobj(value):
        value = np.stack([value.real, value.imag], axis=-1)
    return value.tolist()


def _string_array(value: Any, element_type: type) -> Any:  # noqa: ANN401
    """Return a list of strings as an array with the given element type; other values unchanged."""
    return np.array(value, dtype=element_type) if isinstance(value, list) else value
