"""Layout and numbers of tables in text, and lines that do not fit."""

from io import BytesIO

import numpy as np
import pytest

from rigd.text_table import MissingColumnError, TableError, decode_text, read_table
from rigd.text_table.titles import stated_unit_of


def table(text, *names, encoding="utf-8", max_rows=1000):
    return read_table(BytesIO(text.encode(encoding)), names, max_rows=max_rows)


def refused(text, *names):
    with pytest.raises(TableError) as refusal:
        table(text, *names)
    return str(refusal.value)


@pytest.mark.parametrize(
    ("head", "units"),
    [
        ("", ""),
        ("sep=;\n", ""),
        ("Rig 4; second run\n\nOperator: Eve\n", ""),
        ("", "s;rad;Nm\n"),
        ("s;rad;Nm\n", ""),
        ("", "(s);[rad];<Nm>\n---;---;---\n"),
    ],
)
def test_headers_and_rows_of_units(head, units):
    found = table(
        f"{head}t;angle;torque;\n{units}0,0;1,5;-2;\n0,1;2,5;,5\n", "angle", "torque", "t"
    )
    assert found.columns["angle"].values.tolist() == [1.5, 2.5]
    assert found.columns["torque"].values.tolist() == [-2.0, 0.5]
    in_row = "rad" in head + units
    assert [found.columns[name].unit for name in ("t", "angle", "torque")] == (
        ["s", "rad", "Nm"] if in_row else ["", "", ""]
    )
    assert found.column_count == 3
    assert found.line_numbers.tolist() == [
        (head + units).count("\n") + 2, (head + units).count("\n") + 3
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "first"),
    [
        ("0;1\n0,5;2\n0,6;2\n", 0.5),
        ("1;2;\n0,5;2;\n0,6;2;\n", 0.5),
        ("1;3\n0,5;2\n0,6;2\n", 1.0),
        ("0;1\n1;2\n2;3\n", 0.0),  # all are whole numbers
        ("1\n0.5\n0.6\n", 1.0),
        ("0;1\n", 0.0),
    ],
)
def test_line_of_column_numbers_is_no_data(text, first):
    assert table(text, "#1").columns["#1"].values[0] == first


LABVIEW = """LabVIEW Measurement\t
Separator\tTab
Decimal_Separator\t,
***End_of_Header***\t
\t
Channels\t2\t\t
Date\t2026/11/25\t2026/11/25
Time\t18:18:05,1\t18:18:05,2
X_Dimension\tTime\tTime
X0\t0,0\t0,5
Delta_X\t0,002\t0,002
***End_of_Header***\t\t
X_Value\tangle\ttorque\tComment
0,000\t1,5\t2,5\tstarted
0,002\t1,6\t2,6
"""


def test_header_of_labview_states_rate_and_start():
    found = table(LABVIEW, "angle", "torque")
    angle, torque = found.columns["angle"], found.columns["torque"]
    assert (angle.values.tolist(), torque.values.tolist()) == ([1.5, 1.6], [2.5, 2.6])
    assert angle.rate_hz == torque.rate_hz == pytest.approx(500.0)
    assert torque.start_ns - angle.start_ns == 600_000_000
    assert found.times.title == "X_Value"
    assert "not a function of time" in refused(LABVIEW.replace("Time\tTime", "Time\tFrequency"),
                                               "torque")  # fmt: skip
    assert "no line ***End" in refused(LABVIEW.replace("***End", "***"), "angle")


@pytest.mark.parametrize(
    ("line", "rate_hz"),
    [
        ("Sampling rate: 500 Hz", 500.0),
        ("# dt = 2 ms", 500.0),
        ("Sample rate [kHz]\t0.5", 500.0),
        ("Delta: 0,002 sec.", 500.0),
        ("Sampling rate,1,kHz", 1000.0),
        ("Sample Rate: 1 kS/s", 1000.0),
        ("Sampling rate (1/s): 1000", 1000.0),
        ("Sample rate = 60000 samples/min", 1000.0),
        ("Sample Rate: 1,000 Hz", None),
        ("Abtastrate: 1.000 Hz", None),
        ("Sample rate: 3 per turn", None),
        ("Measurement interval: 8 s", None),
        ("Number of samples: 500", None),
        ("Time 18:18:05", None),
    ],
)
def test_header_states_the_rate_in_words(line, rate_hz):
    found = table(f"{line}\nu,v\n1,2\n3,4\n", "u").columns["u"].rate_hz
    assert found == (rate_hz and pytest.approx(rate_hz))


@pytest.mark.parametrize(
    ("text", "name", "words"),
    [
        ("t,a\n0,5,1,5\n", "a", ("line 2 has 4 cells", "line 1 has 2 titles", "decimal commas")),
        ("t,a\n0,1,1.5\n1,2,2.5\n", "a", ("line 2 has 3 cells", "index")),
        ("s;rad\n0;1;2\n1;2;3\n", "#2", ("line 2 has 3 cells",)),
        ("t a\n1 0 2\n2 1 3\n", "#2", ("line 2 has 3 cells",)),
        ("0,0,0,05\n0,1,0,15\n", "#2", ("line 1", "decimals of the one before")),
        ("0,0,0000,0,05\n1,0,0010,0,15\n", "#3", ("line 1", "decimals of the one before")),
        ("0,05,-0,01,\n0,15,-0,02,\n", "#2", ("line 1", "decimals of the one before")),
        ("t;a\n0;1,234\n1;999\n", "a", ("line 2", "thousands")),
        ("t;a\n0;1.234\n1;999\n", "a", ("line 2", "thousands")),
        ("t;a\n0;1,234\n1;2,345\n", "a", ("line 2", "thousands")),
        ("t;a\n0;1\nMax;2\n", "a", ("line 3: '#1' is not a number ('Max')",)),
        ("u;a\n0;1\nMax;2\n", "a", ("line 3: column 1 is not a number ('Max')",)),
        ("u;a\n0;1\nu;a\n1;2\n", "a", ("line 3", "is not a number")),
        ("t;a\nMin;0\nMax;1\n0;1\n1;2\n", "a", ("line 2 has texts where the line below",)),
        ("t;a\nGain;2\n11:59:58;1\n11:59:59;2\n", "a", ("line 2 has texts",)),
        ("t;a\nMin;0\nMax;1\nMean;0\n0;1\n1;2\n", "#2", ("line 4 has texts",)),
        ("t;a\n0;1\n# pause\n1;2\n", "a", ("line 3 has 1 cell",)),
        ("t;a\n0;1\n1;1_0\n", "a", ("line 3: 'a' is not a number ('1_0')",)),
        ("t;a\n0;1\n1\t2\n", "#2", ("line 3 has 1 cell",)),
        ("0;1\n1;2\n2\t3\n3\t4\n", "#2", ("line 3 has 1 cell",)),
        ("a\n1\n\n2\n", "a", ("line 3 is empty",)),
        ("a\n1\n2,5\n", "a", ("line 3 has 2 cells",)),
        ("t;a\n01/02/2026 11:00:00;1\n02/02/2026 11:00:00;2\n", "t", ("line 3", "another day")),
        ("t;a\nyesterday;1\n", "t", ("line 2: 't' is not a number ('yesterday')",)),
        ("t;a\n2026-11-25;1\n", "t", ("line 2: 't' is a date", "2026-11-25 12:00:00.001")),
    ],
)
def test_inconsistent_line_is_refused_with_its_number(text, name, words):
    message = refused(text, name)
    for word in words:
        assert word in message


def test_texts_in_a_column_of_remarks_are_no_settings():
    for remarks in (("start", "", "3", ""), ("0A", "0F", "12", "1B")):
        text = "t;a;remark\n" + "".join(f"{n};{n}.5;{text}\n" for n, text in enumerate(remarks))
        assert table(text, "a").columns["a"].values.tolist() == [0.5, 1.5, 2.5, 3.5]


def test_numbers_with_leading_zeros_next_to_decimal_points_are_no_decimals():
    assert table("0.1,7,0001\n0.2,7,0002\n", "#3").columns["#3"].values.tolist() == [1.0, 2.0]


def test_missing_column_is_named_with_the_existing_ones():
    with pytest.raises(MissingColumnError) as refusal:
        table("Rig 4\nt;q\n0;1\n1;2\n", "t", "angle")
    assert str(refusal.value) == "has no channel 'angle'; it has 't', 'q' (line 2)."
    assert refusal.value.unquoted_message() == "has no column 'angle'."


def test_times_of_day_are_seconds():
    text = "when,a\n2026-11-25 23:59:59.999,1\n2026-11-26T00:00:00.001Z,2\n,3\n"
    found = table(text, "when").columns["when"]
    np.testing.assert_array_equal(found.values, [0.0, 0.002, np.nan])
    assert found.unit == "s"
    text = "a;when\n1;11:59:59,9 AM\n2;12:00:00,1 PM\n"
    found = table(text, "a").times
    assert (found.title, found.values.tolist(), found.unit_s) == ("when", [0.0, 0.2], 1.0)


def test_unrequested_times_are_found_with_their_unit():
    for title, unit_s in (("t", None), ("Time [ms]", 1e-3), ("zeit_us", 1e-6), ("x [s]", 1.0)):
        assert table(f"{title};a\n0;1\n1;2\n", "a").times.unit_s == unit_s
    for title in ("target", "T_z", "T [°C]", "t_set"):
        assert table(f"{title};a\n0;1\n1;2\n", "a").times is None
    for title in ("Time out [s]", "Latency [us]"):
        found = table(f"{title};x [s];a\n5;0,1;1\n4;0,2;2\n5;0,3;1\n", "a")
        assert (found.times.title, found.times.values.tolist()) == ("x [s]", [0.1, 0.2, 0.3])


def test_reading_ends_at_the_maximum_of_rows():
    assert len(table("a\n" + "1\n" * 50, "a", max_rows=10).columns["a"].values) == 11


def test_empty_lines_are_reported():
    found = table("t,a\n0,1\n\n1,2\n,,\n2,3\n,\n", "a")
    np.testing.assert_array_equal(found.columns["a"].values, [1, 2, np.nan, 3])
    assert "line 3" in found.remark


def test_units_of_titles():
    unit_of_title = {
        "q [deg]": "deg",
        "t/ms": "ms",
        "M in Nm": "Nm",
        "Tz (mN·m)": "mN·m",
        "a [1e-3]": "1e-3",
        "Angle [deg] CH1": "deg",
        "Time (ms) rel": "ms",
        "Angle (deg) [filtered]": "deg",
    }
    for title, unit in unit_of_title.items():
        assert stated_unit_of(title) == unit
    for title in ("Rig/Angle", "angle (filtered)", "Angle", "in"):
        assert stated_unit_of(title) == ""


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-32"])
def test_byte_order_marks_are_no_text(encoding):
    assert decode_text("[beam] # µ".encode(encoding)) == "[beam] # µ"
