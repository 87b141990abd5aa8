"""Files of other programs, as these write them, and errors in some."""

import struct
import sys

import numpy as np
import pytest
import scipy  # whose parts come on first use
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from analysis.exchange import ExchangeError, read_source
from rigd.session.limits import MAX_SAMPLES

NUMBERS = arrays(np.float64, st.integers(2, 40), elements=st.floats(width=64))


def values(path, *names):
    _, channels = read_source(path, names)
    found = [channels[name].values for name in names]
    return found[0] if len(found) == 1 else found


def refused(path, *names):
    with pytest.raises(ExchangeError) as refusal:
        read_source(path, names)
    message = str(refusal.value)
    assert message.startswith(str(path))
    return message


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("sources")


@pytest.fixture
def text(tmp_path):
    def write(content, name="a.csv", encoding="utf-8"):
        path = tmp_path / name
        path.write_bytes(content.encode(encoding))
        return path

    return write


@pytest.mark.parametrize(
    "content",
    [
        "t,angle\n0,1.5\n1,-2e-3\n",
        "\n t ; angle \r\n0;1.5\r\n\r\n1;-2e-3\r\n",
        "t\tangle\textra\n0\t1.5\tyes\n1\t-2e-3\tno",
        '﻿"t","angle"\n"0","1.5"\n"1"," -2e-3 "\n',
    ],
)
def test_columns_are_found_by_name_or_number(text, content):
    path = text(content)
    assert values(path, "angle").tolist() == [1.5, -2e-3]
    assert values(path, "#2").tolist() == [1.5, -2e-3]


@pytest.mark.parametrize(
    "content",
    [
        "t;angle\n0;1,5\n1;-2e-3\n2;;\n",
        "t;angle\r\n0,0;1,5\r\n1,0;-0,2e-2\r\n2;;\r\n",
        "t\tangle\n0\t1,5\n1\t-,002\n2\t\n",
    ],
)
def test_decimal_commas_are_read_where_the_separator_is_another(text, content):
    np.testing.assert_array_equal(values(text(content), "angle"), [1.5, -2e-3, np.nan])


def test_a_first_line_of_numbers_with_decimal_commas_is_data(text):
    path = text("0,5;1\n1,5;2\n")
    assert values(path, "#1").tolist() == [0.5, 1.5]
    assert values(path, "#2").tolist() == [1.0, 2.0]


def test_a_csv_without_names_has_numbers(text):
    assert values(text("0,1\n1,2\n2,3\n"), "#2").tolist() == [1, 2, 3]
    assert "'#1', '#2'" in refused(text("0,1\n1,2\n"), "angle")


@pytest.mark.parametrize(
    ("content", "names"),
    [
        ("  1.0e+00  2.5\n -3.0e-01  4\n", ("#1", "#2")),  # as DaISy has them
        ("1 2.5\n-0.3 4\n\n", ("#1", "#2")),
        ("u y\n1 2.5\n-0.3 4\n", ("u", "y")),
        ("# u y\n1 2.5\n-0.3 4\n", ("u", "y")),  # as numpy.savetxt has it
        ("drive of motor\n1 2.5\n-0.3 4\n", ("#1", "#2")),
    ],
)
@pytest.mark.parametrize("ending", ["dat", "txt"])
def test_columns_begin_at_the_first_line_of_numbers(text, content, names, ending):
    first, second = values(text(content, f"a.{ending}"), *names)
    assert first.tolist() == [1.0, -0.3]
    assert second.tolist() == [2.5, 4.0]


def test_first_line_with_an_empty_cell_is_data(text):
    first, third = values(text("1,,3\n4,5,6\n"), "#1", "#3")
    assert (first.tolist(), third.tolist()) == ([1, 4], [3, 6])
    np.testing.assert_array_equal(values(text("1,,3\n4,5,6\n"), "#2"), [np.nan, 5])


def test_an_empty_cell_is_not_a_number(text):
    np.testing.assert_array_equal(values(text("a,b\n1,2\n,3\nnan,4\n"), "a"), [1, np.nan, np.nan])


@pytest.mark.parametrize(
    ("content", "name", "words"),
    [
        ("", "a", ("empty",)),
        ("a,b\n", "a", ("0 samples",)),
        ("a,b\n1,2\n", "a", ("1 samples",)),
        ("a,b\n1,2\n1,2\n", "c", ("no channel 'c'", "'a', 'b'")),
        ("a,a\n1,2\n1,2\n", "a", ("2 columns", "#1")),
        ("a,b\n1,2\n3\n", "b", ("line 3 has 1 cell", "line 1 has 2 titles")),
        ("a,b\n1,2\n3,4,5\n", "b", ("line 3 has 3 cells", "line 1 has 2 titles", "decimal commas")),
        ("a,b\n1,2\n3,4,\n5,6,7\n", "b", ("line 4 has 3 cells",)),
        ("a,b\n1,2\n3,x\n", "b", ("line 3: 'b'", "'x'", "not a number")),
        ("a,b\nfirst,deg it\n1,2\n", "b", ("line 2: 'b'", "'deg it'", "one line of units")),
        ("a;b\n1;2,5\n3;4.5\n", "b", ("line 3: 'b'", "'4.5'", "decimal commas")),
        ("a;b\n1;2.5\n3;4,5\n", "b", ("line 2: 'b'", "'2.5'", "decimal commas")),
        ("a;b\n1;2,5\n3;1.234,5\n", "b", ("'1.234,5'", "not a number")),
        ("a;b\n1;2,5\n3;1,234,5\n", "b", ("'1,234,5'", "not a number")),
        ("a b\n1 2\n3\n", "b", ("line 3 has 1 cell", "line 1 has 2 titles")),
        ("my a b\n1 2\n3 4\n", "b", ("line 2 has 2 cells", "line 1 has 3 titles")),
        ('a,b\n1,"2\n' + "3,4\n" * 40_000, "b", ("line 2: 'b'", "not a number")),
        ("a" * 70_000 + ",b\n1,2\n", "b", ("a line of more than 65536",)),
    ],
)
def test_other_text_than_a_table_is_refused(text, content, name, words):
    message = refused(text(content), name)
    for word in words:
        assert word in message


@pytest.mark.parametrize("encoding", ["cp1252", "utf-8-sig", "utf-16", "utf-16-le", "utf-32"])
def test_encodings_are_recognised(text, encoding):
    path = text("Zeit;Ausschlag [°]\n0;1,5\n1;2,5\n", encoding=encoding)
    assert values(path, "Ausschlag [°]").tolist() == [1.5, 2.5]


@settings(max_examples=25)
@given(columns=NUMBERS)
def test_csv_preserves_every_digit(folder, columns):
    path = folder / "digits.csv"
    path.write_text("a\n" + "".join(f"{value!r}\n" for value in columns.tolist()))
    np.testing.assert_array_equal(values(path, "a"), columns)


@settings(max_examples=25)
@given(numbers=NUMBERS, as_row=st.booleans(), compressed=st.booleans())
def test_matlab_variables_fields_and_columns(folder, numbers, as_row, compressed):
    path = folder / "log.mat"
    vector = numbers[None, :] if as_row else numbers[:, None]
    log = {"angle": vector, "inner": {"torque": numbers}}
    matrix = np.column_stack([numbers, 2.0 * np.arange(len(numbers))])
    scipy.io.savemat(path, {"angle": vector, "log": log, "m": matrix}, do_compression=compressed)
    for name in ("angle", "log.angle", "log.inner.torque", "m#1"):
        np.testing.assert_array_equal(values(path, name), numbers)
    np.testing.assert_array_equal(values(path, "m#2"), 2.0 * np.arange(len(numbers)))


def test_matlab_elements_of_struct_arrays(tmp_path):
    path = tmp_path / "a.mat"
    runs = np.empty((1, 2), dtype=[("t", "O"), ("q", "O")])
    runs[0, 0], runs[0, 1] = (np.arange(3.0), np.ones(3)), (np.arange(4.0), np.full(4, 2.0))
    scipy.io.savemat(path, {"log": runs, "wide": np.ones((3, 9))})
    assert values(path, "log(2).q").tolist() == [2, 2, 2, 2]
    assert "struct array of 1×2" in refused(path, "log.q")
    assert "log(1).q" in refused(path, "log.q")
    assert "has 2 elements" in refused(path, "log(3).q")
    assert "transposed" in refused(path, "wide#1")


def test_matlab_states_times_and_units(tmp_path):
    path = tmp_path / "a.mat"
    series = {"Time": np.arange(4.0), "Data": np.ones(4), "TimeInfo": {"Units": "milliseconds"}}
    scipy.io.savemat(path, {"q": series, "Fs": 250.0, "a": np.ones(4)})
    _, channels = read_source(path, ["q.Data", "q.Time", "a"])
    assert channels["q.Time"].unit_label == "milliseconds"
    assert channels["a"].rate_hz == 250.0
    _, channels = read_source(path, ["q.Data"])
    assert channels["q.Data"].times.name == "q.Time"


def test_first_times_that_increase_are_those_of_the_file(tdms, tmp_path):
    variables = {"time_out": [5.0, 5.0, 5.0], "time": [0.0, 1.0, 2.0], "a": [1.0, 2.0, 1.0]}
    scipy.io.savemat(tmp_path / "a.mat", variables)
    with tdms.TdmsWriter(str(tmp_path / "a.tdms")) as writer:
        writer.write_segment([tdms.ChannelObject("g", *pair) for pair in variables.items()])
    for name, channel in (("a.mat", "a"), ("a.tdms", "g/a")):
        _, channels = read_source(tmp_path / name, [channel])
        assert channels[channel].times.values.tolist() == [0.0, 1.0, 2.0]


def test_matlab_7_3_texts_and_objects_are_no_numbers(tmp_path):
    def write(file):
        for name, kind in (("text", "char"), ("series", "timeseries")):
            file[name] = np.arange(6, dtype=np.uint32)[:, None]
            file[name].attrs["MATLAB_class"] = np.bytes_(kind)

    path = hdf5_of_matlab(tmp_path / "a.mat", write)
    for name, kind in (("text", "char"), ("series", "timeseries")):
        assert f"MATLAB's class {kind}" in refused(path, name)


def test_matlab_integers_are_numbers(tmp_path):
    scipy.io.savemat(tmp_path / "a.mat", {"a": np.array([1, -2, 3], dtype=np.int16)})
    assert values(tmp_path / "a.mat", "a").tolist() == [1.0, -2.0, 3.0]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("b", ("no channel 'b'", "'m'", "'log'")),
        ("m", ("a matrix of 4×3", "m#1")),
        ("m#4", ("4×3",)),
        ("m#0", ("no channel 'm#0'",)),
        ("log", ("a struct", "log.angle")),
        ("log.b", ("no channel 'log.b'", "'log.angle'")),
        ("m.b", ("is not one struct",)),
        ("text", ("real numbers",)),
        ("cell", ("real numbers",)),
        ("imaginary", ("is complex", "frequency response")),
        ("sparse", ("full array",)),
        ("empty", ("0 samples",)),
    ],
)
def test_non_vector_of_matlab_is_refused(tmp_path, name, words):
    path = tmp_path / "a.mat"
    contents = {
        "m": np.ones((4, 3)),
        "log": {"angle": np.ones(4)},
        "text": "words",
        "cell": np.array([1.0, "a"], dtype=object),
        "imaginary": np.array([1.0, 1.0j]),
        "sparse": scipy.sparse.eye_array(4),
        "empty": np.zeros((0, 0)),
    }
    scipy.io.savemat(path, contents)
    message = refused(path, name)
    for word in words:
        assert word in message


@pytest.mark.parametrize(
    "content", [b"", b"MATLAB 5.0 MAT-file", b"\0" * 200, b"text, not MATLAB\n" * 20]
)
def test_non_matlab_file_is_refused(tmp_path, content):
    path = tmp_path / "a.mat"
    path.write_bytes(content)
    assert "save('-v7'" in refused(path, "a")


def hdf5_of_matlab(path, write):
    h5py = pytest.importorskip("h5py", reason="MATLAB 7.3 is read if h5py is there")
    with h5py.File(path, "w", userblock_size=512) as file:
        write(file)
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    return path


def test_matlab_7_3_without_h5py_is_refused_with_the_remedy(tmp_path, monkeypatch):
    path = tmp_path / "a.mat"
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(512) + b"\x89HDF\r\n\x1a\n" + b"\0" * 100)
    monkeypatch.setitem(sys.modules, "h5py", None)
    message = refused(path, "a")
    assert "version 7.3" in message
    assert "save('-v7'" in message
    assert "h5py" in message


def test_matlab_7_3_with_h5py(tmp_path):
    def write(file):
        file["angle"] = np.arange(5.0)[None, :]  # 5×1 in MATLAB
        file["log/torque"] = np.arange(5.0)[:, None]
        file["m"] = np.arange(10.0).reshape(2, 5)  # 5×2 in MATLAB

    path = hdf5_of_matlab(tmp_path / "a.mat", write)
    for name in ("angle", "log.torque", "m#1"):
        assert values(path, name).tolist() == [0, 1, 2, 3, 4]
    assert values(path, "m#2").tolist() == [5, 6, 7, 8, 9]
    assert "no channel 'b'" in refused(path, "b")
    assert "log.torque" in refused(path, "log")
    assert "5×2" in refused(path, "m")


@pytest.fixture
def tdms():
    return pytest.importorskip("nptdms", reason="TDMS needs npTDMS")


@settings(max_examples=25)
@given(numbers=NUMBERS, whole=arrays(np.int32, 7))
def test_tdms_channels(folder, numbers, whole):
    tdms = pytest.importorskip("nptdms", reason="TDMS needs npTDMS")
    path = folder / "a.tdms"
    half = len(numbers) // 2
    with tdms.TdmsWriter(str(path)) as writer:  # in two segments, as LabVIEW appends
        for part in (numbers[:half], numbers[half:]):
            writer.write_segment([tdms.ChannelObject("Rig/1", "Angle", part)])
        writer.write_segment([tdms.ChannelObject("Rig/1", "Counts", whole)])
    np.testing.assert_array_equal(values(path, "Rig/1/Angle"), numbers)
    np.testing.assert_array_equal(values(path, "Rig/1/Counts"), whole)


def test_tdms_states_unit_and_rate(tdms, tmp_path):
    path = tmp_path / "a.tdms"
    properties = {"unit_string": "deg", "wf_increment": 1e-3}
    with tdms.TdmsWriter(str(path)) as writer:
        writer.write_segment([tdms.ChannelObject("Rig", "Angle", np.arange(5.0), properties)])
    _, channels = read_source(path, ["Rig/Angle"])
    assert channels["Rig/Angle"].unit_label == "deg"
    assert channels["Rig/Angle"].rate_hz == pytest.approx(1000.0)
    assert channels["Rig/Angle"].remark == ""


def test_truncated_tdms_is_reported_without_using_another_index(tdms, tmp_path):
    path = tmp_path / "a.tdms"
    with tdms.TdmsWriter(str(path), index_file=True) as writer:
        writer.write_segment([tdms.ChannelObject("Rig", "Angle", np.arange(100.0))])
    path.write_bytes(path.read_bytes()[:-80])
    _, channels = read_source(path, ["Rig/Angle"])
    assert channels["Rig/Angle"].values.tolist() == list(range(90))
    assert "cut off" in channels["Rig/Angle"].remark


@pytest.mark.parametrize(("offset", "bit"), [(20, 0x08), (21, 0x01), (15, 0x10)])
def test_tdms_with_a_wrong_position_of_its_data_is_refused(tdms, tmp_path, offset, bit):
    path = tmp_path / "a.tdms"
    with tdms.TdmsWriter(str(path)) as writer:
        for numbers in (np.arange(500.0), np.arange(600.0)):
            channels = [tdms.ChannelObject("Rig", name, numbers) for name in ("Angle", "Torque")]
            writer.write_segment(channels)
    content = bytearray(path.read_bytes())
    content[offset] ^= bit
    path.write_bytes(content)
    assert "is damaged (" in refused(path, "Rig/Angle")


def test_nonnumeric_tdms_channel_is_refused(tdms, tmp_path):
    path = tmp_path / "a.tdms"
    with tdms.TdmsWriter(str(path)) as writer:
        writer.write_segment([tdms.ChannelObject("Rig", "Angle", np.arange(5.0))])
        writer.write_segment([tdms.ChannelObject("Rig", "Torque", np.arange(6.0))])
        writer.write_segment([tdms.ChannelObject("Rig", "Note", ["a", "b"])])
    assert "'Rig/Angle'" in refused(path, "Angle")
    assert "real numbers" in refused(path, "Rig/Note")
    path.write_bytes(b"TDSx" + b"\0" * 100)
    assert "not a TDMS file" in refused(path, "Rig/Angle")


def uff_of(path, *functions):
    pyuff = pytest.importorskip("pyuff", reason="UFF58 needs pyuff")
    path.unlink(missing_ok=True)
    for title, x, data, options in functions:
        function = pyuff.prepare_58(
            binary=options.get("binary", 0), func_type=1, rsp_node=1, rsp_dir=1, ref_node=1,
            ref_dir=1, data=data, x=x, id1=title, rsp_ent_name="A", ref_ent_name="A",
            abscissa_spacing=options.get("even", 1), abscissa_spec_data_type=17,
            ordinate_spec_data_type=1, orddenom_spec_data_type=0,
            ordinate_axis_units_lab=options.get("unit", "NONE"),
        )  # fmt: skip
        pyuff.UFF(str(path)).write_sets(function, "add")
    return path


# pyuff leaves files open when it writes binary data.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.filterwarnings("ignore::ResourceWarning")
@settings(max_examples=25)
@given(
    numbers=arrays(np.float64, st.integers(2, 40), elements=st.floats(-1e9, 1e9)),
    binary=st.booleans(),
)
def test_uff_of_another_program(folder, numbers, binary):
    x = np.arange(len(numbers)) * 1e-3
    path = uff_of(
        folder / "a.uff",
        ("Angle", x, numbers, {"binary": int(binary), "unit": "deg"}),
        ("Angle", x, 2 * numbers, {}),
        ("Torque", x + 1e-9 * (x > 0), numbers, {"binary": 1, "even": 0}),
    )
    _, channels = read_source(path, ["#1", "#2", "Torque"])
    tolerance = 0.0 if binary else 1e-11
    np.testing.assert_allclose(channels["#1"].values, numbers, rtol=tolerance, atol=1e-300)
    np.testing.assert_allclose(channels["#2"].values, 2 * numbers, rtol=1e-11, atol=1e-300)
    np.testing.assert_array_equal(channels["Torque"].values, numbers)
    assert (channels["#1"].unit_label, channels["#2"].unit_label) == ("deg", "")
    assert channels["#1"].rate_hz == pytest.approx(1000)
    assert channels["Torque"].rate_hz is None
    np.testing.assert_array_equal(values(path, "Torque", "abscissa")[1], x + 1e-9 * (x > 0))
    assert "2 data sets have the title 'Angle'" in refused(path, "Angle")
    assert "'#3 Torque'" in refused(path, "#4")
    assert "other times" in refused(path, "#1", "Torque", "abscissa")
    assert "no channel but 'abscissa'" in refused(path, "abscissa")


@pytest.mark.parametrize(
    ("kind", "axis", "unit", "words"),
    [
        (2, 17, "s", "auto spectrum"),
        (6, 18, "Hz", "coherence"),
        (1, 18, "Hz", "frequency"),
        (0, 0, "Hz", "abscissa is 'Hz'"),
    ],
)
def test_real_functions_of_frequency_are_refused(tmp_path, kind, axis, unit, words):
    x = np.arange(4) * 1e-3
    path = uff_of(tmp_path / "a.uff", ("a", x, x, {}))
    lines = path.read_text().splitlines(keepends=True)
    lines[7] = f"{kind:5d}{lines[7][5:]}"
    lines[9] = f"{axis:10d}{lines[9][10:47]}{unit:20}\n"
    path.write_text("".join(lines))
    assert words in refused(path, "a")


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_uff_binary_numbers_other_than_ieee_are_refused(tmp_path):
    x = np.arange(4) * 1e-3
    path = uff_of(tmp_path / "a.uff", ("a", x, x, {"binary": 1}))
    content = path.read_bytes()
    assert values(path, "a").tolist() == x.tolist()
    path.write_bytes(content.replace(b"    58b     1     2", b"    58b     1     1"))
    assert "format 1 (DEC VMS), which is not read" in refused(path, "a")


def test_uff_time_response_without_axis_type_states_its_times(tmp_path):
    x = np.arange(4) * 2e-3
    path = uff_of(tmp_path / "a.uff", ("a", x, x, {}))
    lines = path.read_text().splitlines(keepends=True)
    lines[9] = f"{0:10d}{lines[9][10:47]}{'NONE':20}\n"
    units = f"{164:6d}\n{5:10d}{'mm (milli-newton)':20}{2:10d}\n" + (
        "  1.0000000000000000D+03  1.0000000000000000D+03  1.0000000000000000D+00\n"
        "  2.7314999999999998D+02\n"
    )
    path.write_text(f"{-1:6d}\n{units}{-1:6d}\n" + "".join(lines))
    channel = read_source(path, ["a"])[1]["a"]
    np.testing.assert_allclose(channel.times.values, x)
    assert channel.times.unit_s is None
    assert "the units 'mm (milli-newton)'" in channel.remark


def test_uff_other_than_functions_of_time_is_refused(tmp_path):
    x = np.arange(4) * 1e-3
    path = uff_of(
        tmp_path / "a.uff", ("G", x, x + 1j, {}), ("a", x, x, {}), ("b", x[:3], x[:3], {})
    )
    assert "frequency response" in refused(path, "G")
    path.write_bytes(path.read_bytes().replace(b"         4         4", b"         4         9"))
    assert "has 4 values and states 9" in refused(path, "a")
    path.write_bytes(b"    -1\n    58\nx\n    -1\n")
    assert "not a universal file" in refused(path, "a")
    path.write_bytes(b"nothing of the kind")
    assert "no channel 'a', and no other either" in refused(path, "a")


@pytest.mark.parametrize(("suffix", "package"), [("tdms", "nptdms"), ("uff", "pyuff")])
def test_missing_library_is_named_with_the_extra(tmp_path, monkeypatch, suffix, package):
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(b"x")
    monkeypatch.setitem(sys.modules, package, None)
    assert "pip install 'rigd[exchange]'" in refused(path, "a")


def test_unknown_file_format_is_refused(tmp_path):
    assert ".csv" in refused(tmp_path / "a.xlsx", "a")
    assert "cannot be read" in refused(tmp_path / "absent.csv", "a")
    (tmp_path / "folder.csv").mkdir()
    assert "not a file" in refused(tmp_path / "folder.csv", "a")
    with (tmp_path / "huge.csv").open("wb") as stream:
        stream.truncate(600_000_000)
    assert "600 MB" in refused(tmp_path / "huge.csv", "a")


def test_more_samples_than_a_session_has_are_refused(tmp_path):
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, {"a": np.zeros(MAX_SAMPLES + 1, np.int8)}, do_compression=True)
    assert "cut the session out" in refused(path, "a")


def test_damaged_matlab_file_gives_no_traceback(tmp_path):
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, {"a": np.arange(50.0), "s": {"b": np.arange(50.0)}})
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    refusals = 0
    for _ in range(200):
        damaged = bytearray(whole)
        for offset in rng.integers(0, len(whole), 3):
            damaged[offset] = rng.integers(256)
        path.write_bytes(damaged[: rng.integers(len(whole) // 2, len(whole) + 1)])
        try:
            read_source(path, ["a", "s.b"])
        except ExchangeError:
            refusals += 1
    assert refusals > 100


def test_damaged_tdms_file_gives_no_traceback(tdms, tmp_path):
    path = tmp_path / "a.tdms"
    with tdms.TdmsWriter(str(path)) as writer:
        for _ in range(2):
            writer.write_segment(
                [tdms.ChannelObject("g", "a", np.arange(20.0), {"unit_string": "V"})]
            )
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    refusals = 0
    for _ in range(300):
        damaged = bytearray(whole)
        struct.pack_into("<I", damaged, rng.integers(0, 200), int(rng.integers(2**32)))
        path.write_bytes(damaged)
        try:
            read_source(path, ["g/a"])
        except ExchangeError:
            refusals += 1
    assert refusals > 50
