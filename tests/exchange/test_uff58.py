"""Universal files as the definition of data set 58 wants them, and as pyuff reads them."""

import io

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from analysis.exchange import ExchangeError
from analysis.exchange._table import ExportColumn, ExportTable
from analysis.exchange._uff_format import write_uff58

NUMBERS = arrays(np.float64, st.integers(1, 17), elements=st.floats(-1e99, 1e99))
LENGTHS = range(1, 10)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return tmp_path_factory.mktemp("uff") / "a.uff"


@pytest.fixture(scope="module")
def pyuff():
    return pytest.importorskip("pyuff", reason="universal files are read back by pyuff")


def table(axis, *columns, unit="s"):
    title = "Time" if unit == "s" else "Frequency"
    return ExportTable(
        "s.mcap", ExportColumn("x", title, unit, axis), columns, {"exported_by": "rigd 1"}
    )


def written(content, *, binary):
    stream = io.BytesIO()
    write_uff58(content, stream, binary=binary)
    return stream.getvalue()


def read_back(pyuff, path, data):
    path.write_bytes(data)
    units, *functions = pyuff.UFF(str(path)).read_sets()
    assert (units["type"], units["units_code"], units["length"]) == (164, 1, 1.0)
    return functions


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("even", [False, True])
@settings(max_examples=30)
@given(real=NUMBERS, imaginary=NUMBERS)
def test_every_length_is_read_back(pyuff, path, binary, even, real, imaginary):
    length = min(len(real), len(imaginary))
    real, imaginary = real[:length], imaginary[:length]
    axis = 0.5 + 0.25 * np.arange(length)
    if not even and length > 2:
        axis[-1] += 0.125
    columns = (
        ExportColumn("a_nm", "A", "N.m", real),
        ExportColumn("g_nm_per_rad", "A / B", "N.m/rad", real + 1j * imaginary),
    )
    one, other = read_back(pyuff, path, written(table(axis, *columns), binary=binary))
    tolerance = 0.0 if binary else 5e-13
    for function, expected in ((one, real), (other, real + 1j * imaginary)):
        np.testing.assert_array_equal(function["x"], axis)
        np.testing.assert_allclose(function["data"].real, expected.real, rtol=tolerance)
        np.testing.assert_allclose(function["data"].imag, expected.imag, rtol=tolerance)
        assert function["num_pts"] == length


@pytest.mark.parametrize("length", LENGTHS)
@pytest.mark.parametrize("complex_", [False, True])
@pytest.mark.parametrize("even", [False, True])
def test_a_binary_body_has_the_bytes_that_its_header_states(length, complex_, even):
    axis = np.arange(length) + (0 if even else 0.3 * (np.arange(length) == length - 1))
    values = np.full(length, np.pi) * (1j if complex_ else 1)
    data = written(table(axis, ExportColumn("a", "A", "N.m", values)), binary=True)
    function = data[data.index(b"    58b") :]
    lines = function.split(b"\n", 12)
    order, form, text_lines, size = (int(field) for field in lines[0][7:43].split())
    assert (order, form, text_lines) == (1, 2, 11)
    body = b"\n".join(lines[12:])
    assert body[size:] == b"    -1\n"
    uneven = length > 2 and not even
    assert size == 8 * length * (1 + complex_ + uneven)


def test_text_matches_the_definition():
    """By hand from the SDRL's definition of data set 58: fields, columns and codes."""
    values = np.array([1.0, complex(0.0, -2.5), 3.25])
    column = ExportColumn("g_nm_per_rad", "Torque / Angle", "N.m/rad", values)
    text = written(table(np.array([0.5, 0.75, 1.0]), column, unit="Hz"), binary=False).decode()
    function = text[text.index("    58") :].split("\n")
    assert [line.rstrip() for line in function[1:6]] == [
        "g_nm_per_rad", "s.mcap", "NONE", "NONE", "rigd 1",
    ]  # fmt: skip
    assert function[6:16] == [
        "    4         0    0         0 NONE               0   0 NONE               0   0",
        "         6         3         1  5.00000E-01  2.50000E-01  0.00000E+00",
        "        18    0    0    0 Frequency            Hz                  ",
        "         1    1    1    0 Torque               N.m                 ",
        "         1    0    0    0 Angle                rad                 ",
        "         0    0    0    0 NONE                 NONE                ",
        "  1.000000000000E+00  0.000000000000E+00  0.000000000000E+00 -2.500000000000E+00",
        "  3.250000000000E+00  0.000000000000E+00",
        "    -1",
        "",
    ]


def test_times_beyond_six_digits_are_refused_in_text(pyuff, path):
    axis = 1000.0 + np.delete(np.arange(40), 7) * 1e-3
    content = table(axis, ExportColumn("a", "A", "N", np.arange(39.0)))
    with pytest.raises(ExchangeError, match="--binary"):
        written(content, binary=False)
    (function,) = read_back(pyuff, path, written(content, binary=True))
    np.testing.assert_array_equal(function["x"], axis)


def test_an_increment_of_more_than_six_digits_is_not_rounded(pyuff, path):
    axis = np.arange(5000) / 1024
    content = table(axis, ExportColumn("a", "A", "N", axis))
    (function,) = read_back(pyuff, path, written(content, binary=True))
    np.testing.assert_allclose(function["x"], axis, atol=1e-5)


def test_integers_are_refused_and_names_sanitised(pyuff, path):
    columns = (
        ExportColumn("status", "Bits", "", np.arange(3)),
        ExportColumn("coherence\r\n    -1", "Coherence", "", np.arange(3.0)),
    )
    content = table(np.arange(3.0), *columns, unit="Hz")
    content = ExportTable("ä" * 100, content.axis, content.columns, content.information)
    (function,) = read_back(pyuff, path, written(content, binary=False))
    assert function["id1"] == "coherence??    -1"
    assert function["id2"] == "?" * 80
    assert function["func_type"] == 6
