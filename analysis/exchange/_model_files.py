"""Files of linear models: JSON, NumPy and MATLAB, all with the same variables."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any, BinaryIO, Final

import numpy as np

Variables = Mapping[str, Any]
"""Strings, numbers, lists of strings and arrays by name."""


def write_json(variables: Variables, stream: BinaryIO) -> None:
    """Write an object with a line for each variable.

    Complex numbers are pairs of real and imaginary part; what is not known is null.

    Parameters
    ----------
    variables : mapping
    stream : binary file
    """
    from analysis.results import finite

    content = finite({name: _plain(value) for name, value in variables.items()})
    lines = (
        f"{json.dumps(name)}: {json.dumps(value, ensure_ascii=False, allow_nan=False)}"
        for name, value in content.items()
    )
    stream.write(("{\n" + ",\n".join(lines) + "\n}\n").encode())


def write_npz(variables: Variables, stream: BinaryIO) -> None:
    """Write an array for each variable, none of which needs pickle.

    Parameters
    ----------
    variables : mapping
    stream : binary file
    """
    np.savez_compressed(
        stream,
        **{name: _strings(value, np.str_) for name, value in variables.items()},
    )


def write_mat(variables: Variables, stream: BinaryIO) -> None:
    """Write a variable for each, lists of strings as cell arrays; MATLAB's version 7.

    Parameters
    ----------
    variables : mapping
    stream : binary file
    """
    from scipy.io import savemat

    savemat(
        stream,
        {name: _strings(value, np.object_) for name, value in variables.items()},
        do_compression=True,
        oned_as="column",
    )


MODEL_FORMATS: Final[Mapping[str, Callable[[Variables, BinaryIO], None]]] = {
    ".json": write_json,
    ".npz": write_npz,
    ".mat": write_mat,
}
"""Writer by the ending of the file."""


def _plain(value: Any) -> Any:  # noqa: ANN401
    if not isinstance(value, np.ndarray):
        return value
    if np.iscomplexobj(value):
        value = np.stack([value.real, value.imag], axis=-1)
    return value.tolist()


def _strings(value: Any, kind: type) -> Any:  # noqa: ANN401
    return np.array(value, dtype=kind) if isinstance(value, list) else value
