"""Files of measurements as people and programs write them, with their everyday mistakes.

`everyday_file(folder, seed)` writes one file of known samples, and states how it is imported.
The mistakes are those of the file or of the user: separators, decimal signs, cells too many or too
few at any line, heads, units, byte order marks, time bases, start times, scales.
"""

import gc
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

FAMILIES = ("text", "text", "text", "text", "tdms", "uff", "mat")
"""Kind of file by the seed: seven seeds make four text files and one of each other kind."""

RATES_HZ = (500.0, 1000.0, 1024.0, 2000.0)


@dataclass
class EverydayFile:
    """A file, how a user imports it, and its contents."""

    path: Path
    story: str
    rate_hz: float
    angle_rad: np.ndarray
    torque_nm: np.ndarray
    plan: dict[str, Any] = field(default_factory=dict)
    """Arguments for the plan of an import: `angle`, `torque`, and `time` or `rate_hz`."""
    ticks: np.ndarray | None = None
    """Ticks of the samples if some are missing."""
    torque_later: float = 0.0
    """Samples by which the torque's first value is later than the angle's."""
    must: str = "either"
    """"read", "refuse", or "either"."""
    names: tuple[str, ...] = ()
    """Words of which a refusal has to name one: a line, a channel, a scale."""
    digits: float = 1e-6
    """Largest error of a value by the digits in the file, in the unit of the channel."""


def everyday_file(folder: Path, seed: int) -> EverydayFile:
    """Write a file of a family by a seed."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(300, 700))
    rate_hz = float(rng.choice(RATES_HZ))
    time_s = np.arange(count) / rate_hz
    phase, speed = rng.uniform(0, 6, 2), rng.uniform(2, 9, 2)
    angle = 0.02 * np.sin(2 * np.pi * speed[0] * time_s + phase[0]) + 0.003 * rng.normal(size=count)
    torque = 2.3 * np.sin(2 * np.pi * speed[1] * time_s + phase[1]) + 0.2 * rng.normal(size=count)
    made = EverydayFile(folder / "unnamed", "", rate_hz, angle, torque)
    make = {"text": _text, "tdms": _tdms, "uff": _uff, "mat": _mat}[FAMILIES[seed % len(FAMILIES)]]
    make(made, folder, rng)
    return made


def _pick(rng: np.random.Generator, *values: Any) -> Any:
    return values[int(rng.integers(len(values)))]


# Text


@dataclass
class _Table:
    """A text file in the making: lines of cells, and how they are joined."""

    titles: list[str]
    rows: list[list[str]]
    separator: str
    mark: str
    head: list[str] = field(default_factory=list)
    units: list[str] | None = None
    tail: list[str] = field(default_factory=list)
    encoding: str = "utf-8"
    ending: str = "\n"
    suffix: str = ".csv"

    def line_of(self, row: int) -> int:
        return len(self.head) + bool(self.titles) + (self.units is not None) + row + 1

    def write(self, path: Path) -> None:
        rows = (self.titles or None, self.units, *self.rows)
        cells = [self.separator.join(row) for row in rows if row is not None]
        lines = [*self.head, *cells, *self.tail]
        path.write_bytes((self.ending.join(lines) + self.ending).encode(self.encoding))


def _number(value: float, mark: str, form: str) -> str:
    return (repr(float(value)) if form == "r" else format(float(value), form)).replace(".", mark)


def _text(made: EverydayFile, folder: Path, rng: np.random.Generator) -> None:
    separator = _pick(rng, ",", ",", ";", ";", "\t", " ", "|")
    mark = "." if separator == "," else _pick(rng, ".", ",")
    form = _pick(rng, ".7f", ".6e", "r", ".9g")
    made.digits = 2e-6
    columns = {
        "t": np.arange(len(made.angle_rad)) / made.rate_hz,
        "angle": made.angle_rad,
        "torque": made.torque_nm,
    }
    rows = [
        [_number(value, mark, form) for value in values]
        for values in zip(*columns.values(), strict=True)
    ]
    table = _Table(list(columns), rows, separator, mark)
    table.suffix = _pick(rng, ".csv", ".txt", ".dat", ".tsv", ".asc")
    made.plan = {"angle": "angle:rad", "torque": "torque:N.m", "time": "t:s"}
    if rng.random() < 0.35:
        del made.plan["time"]
        made.plan["rate_hz"] = made.rate_hz
    if rng.random() < 0.25:
        _by_number(made)
    table.ending = _pick(rng, "\n", "\n", "\r\n", "\r")
    table.encoding = _pick(rng, "utf-8", "utf-8", "utf-8-sig", "utf-16", "cp1252", "utf-16-le")
    made.must = "read"
    mistakes = list(_TEXT_MISTAKES)
    mistake = mistakes[int(rng.integers(len(mistakes)))]
    mistake(made, table, rng)
    made.story = (
        f"{mistake.__name__.strip('_')}, separator {separator!r}, mark {mark!r}, {form}, "
        f"{table.encoding}, {made.plan}"
    )
    made.path = folder / f"record{table.suffix}"
    table.write(made.path)


def _by_number(made: EverydayFile) -> None:
    for key, number in (("time", 1), ("angle", 2), ("torque", 3)):
        if key in made.plan:
            made.plan[key] = f"#{number}:{made.plan[key].rpartition(':')[2]}"


def _at(made: EverydayFile, table: _Table, row: int) -> None:
    made.must, made.names = "refuse", (f"line {table.line_of(row)}",)


def _row(table: _Table, rng: np.random.Generator) -> int:
    return int(rng.integers(len(table.rows)))


def _nothing(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    """No mistake."""


def _free_head(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    lines = [
        "Rig 4, second run",
        "Operator: Eve; angle of the motor",
        "",
        "Rate\t1000",
        "3 channels",
    ]
    table.head = [lines[int(n)] for n in rng.integers(0, len(lines), int(rng.integers(1, 9)))]
    made.must = "either" if "#2" in made.plan["angle"] else "read"
    made.names = ("line ",)


def _long_head(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    table.head = [f"# setting {n} = {n}.5" for n in range(int(rng.integers(20, 200)))]


def _labview(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    if table.separator not in ("\t", ","):
        _separator(made, table, "\t")
    name, tab = {"\t": "Tab", ",": "Comma"}[table.separator], table.separator
    step = 1 / made.rate_hz
    table.titles[0] = "X_Value"
    table.titles.append("Comment")
    if "time" in made.plan:
        made.plan["time"] = made.plan["time"].replace("t:", "X_Value:")
    stated = [f"{value:.9f}".replace(".", table.mark) for value in (step, step)]
    later = _pick(rng, 0, 0, int(rng.integers(1, 20)))
    starts = [f"{value:.9f}".replace(".", table.mark) for value in (0.0, later * step)]
    if later:
        for row in range(len(table.rows) - later):
            table.rows[row][2] = table.rows[row + later][2]
        del table.rows[-later:]
        made.torque_later = later
        made.must, made.names = "either", ("begins",)
    table.head = [
        f"LabVIEW Measurement{tab}", f"Writer_Version{tab}2", f"Separator{tab}{name}",
        f"Decimal_Separator{tab}{table.mark}", f"X_Columns{tab}One", "***End_of_Header***" + tab,
        "", f"Channels{tab}2{tab}{tab}", tab.join(["Delta_X", *stated]),
        tab.join(["X0", *starts]), tab.join(["Y_Unit_Label", "rad", "Nm"]),
        "***End_of_Header***" + 2 * tab,
    ]  # fmt: skip
    table.suffix = ".lvm"


def _dasylab(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    table.head = [
        "DASYLab - V 11.00.00", "Worksheet name: beam", "Recording date: 25.11.2026, 12:00:00",
        "Block length: 512", f"Delta: {1 / made.rate_hz:g} sec.", "Number of channels: 2",
    ]  # fmt: skip
    _titles(made, table, ["t [s]", "angle [rad]", "torque [Nm]"])
    made.must, made.names = ("either" if "#2" in made.plan["angle"] else "read"), ("line ",)


def _units_row(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    table.units = _pick(
        rng, ["s", "rad", "Nm"], ["[s]", "[rad]", "[N·m]"], ["(s)", "(rad)", "(N.m)"]
    )
    if table.encoding == "utf-16-le":
        table.encoding = "utf-16"


def _units_above(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    table.head = [table.separator.join(_pick(rng, ["s", "rad", "Nm"], ["s", "deg", "Nm"]))]
    if "deg" in table.head[0]:
        made.must, made.names = "refuse", ("angle", "#2")
        if "#2" in made.plan["angle"]:
            made.must, made.names = "either", ("#2", "line ")


def _rate_in_head(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    stated = made.rate_hz * _pick(rng, 1, 2)
    table.head = [
        "Rig 4",
        _pick(
            rng, f"Sampling rate: {stated:g} Hz", f"Sample rate [Hz]\t{stated:g}",
            f"# dt = {1e3 / stated:.9g} ms", f"Delta: {1 / stated:.9g} sec.",
            f"Abtastrate: {stated / 1e3:g} kHz", f"Sampling frequency;{stated:g}",
        ),
    ]  # fmt: skip
    if stated != made.rate_hz:
        made.must = "either" if "time" in made.plan else "refuse"
    elif "#2" in made.plan["angle"]:
        made.must = "either"
    made.names = ("angle", "torque", "#2", "#3", "line ")
    if "time" not in made.plan:  # nothing else in the file has the time
        table.titles[0] = "u"
        for cells in table.rows:
            cells[0] = f"1{table.mark}5"


def _another_units_row(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    table.units = _pick(rng, ["s", "deg", "Nm"], ["s", "rad", "mNm"], ["[s]", "[mrad]", "[Nm]"])
    made.must, made.names = "refuse", ("angle", "torque", "#2", "#3")


def _time_units_row(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    table.units = ["ms", "rad", "Nm"]
    for row, cells in enumerate(table.rows):
        cells[0] = _number(1e3 * row / made.rate_hz, table.mark, ".6f")
    if "time" in made.plan and rng.random() < 0.5:
        made.plan["time"] = made.plan["time"].replace(":s", ":ms")
    elif "time" in made.plan:
        made.must, made.names = "refuse", ("'t'", "'#1'")


def _units_in_titles(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    _titles(made, table, _pick(
        rng, ["t/s", "angle/rad", "torque/Nm"], ["t [s]", "angle [rad]", "torque [N·m]"],
        ["t (s)", "angle (rad)", "torque (Nm)"],
    ))  # fmt: skip


def _other_units_in_titles(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    _titles(made, table, _pick(
        rng, ["t/s", "angle/deg", "torque/Nm"], ["t [s]", "angle [°]", "torque [N·m]"],
        ["t (s)", "angle (rad)", "torque (mNm)"], ["t (s)", "angle (degrees)", "torque (Nm)"],
    ))  # fmt: skip
    made.must, made.names = "refuse", ("angle", "torque", "#2", "#3")


def _titles(made: EverydayFile, table: _Table, titles: list[str]) -> None:
    if table.separator == " ":
        titles = [title.replace(" ", "_").replace("_[", "[").replace("_(", "(") for title in titles]
    for key, title in zip(("time", "angle", "torque"), titles, strict=True):
        if key in made.plan and not made.plan[key].startswith("#"):
            made.plan[key] = f"{title}:{made.plan[key].rpartition(':')[2]}"
    table.titles = titles


def _separator(made: EverydayFile, table: _Table, separator: str) -> None:
    table.separator = separator


def _scaled(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    for cells, angle, torque in zip(table.rows, made.angle_rad, made.torque_nm, strict=True):
        cells[1:] = (_number(v, table.mark, ".6f") for v in (np.degrees(angle), 1e3 * torque))
    made.plan["angle"] = made.plan["angle"].replace(":rad", ":deg")
    made.plan["torque"] = made.plan["torque"].replace(":N.m", ":mN.m")
    if rng.random() < 0.5:
        table.units = ["s", "deg", "mNm"]


def _extra_cell(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    row = _row(table, rng)
    table.rows[row].insert(int(rng.integers(0, 4)), "7" + table.mark + "5")
    _at(made, table, row)


def _missing_cell(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    row = _row(table, rng)
    del table.rows[row][int(rng.integers(0, 3))]
    _at(made, table, row)


def _cut_off(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    del table.rows[-1][1 + int(rng.integers(0, 2)) :]
    _at(made, table, len(table.rows) - 1)


def _index_column(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    for number, cells in enumerate(table.rows):
        cells.insert(0, str(number))
    if rng.random() < 0.4 and table.separator != " ":
        table.titles.insert(0, "")
        if "#" in made.plan["angle"]:
            made.plan = {"angle": "#3:rad", "torque": "#4:N.m", "rate_hz": made.rate_hz}
    else:
        _at(made, table, 0)


def _decimal_commas(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    table.separator = ","
    table.rows = [[cell.replace(".", ",") for cell in cells] for cells in table.rows]
    if rng.random() < 0.4:
        table.titles = []
        made.plan = {"angle": "#2:rad", "torque": "#3:N.m", "rate_hz": made.rate_hz}
    made.must, made.names = "refuse", ("line ",)


def _quoted_decimal_commas(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    table.separator = ","
    table.rows = [[f'"{cell.replace(".", ",")}"' for cell in cells] for cells in table.rows]


def _mixed_decimals(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    row, column = _row(table, rng), int(rng.integers(1, 3))
    cells = table.rows[row]
    other = "." if table.mark == "," else ","
    cells[column] = f"1{other}25"
    if table.separator == other:
        cells[column] = f'"1{other}25"'
    made.must, made.names = "refuse", ("line ",)


def _thousands(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    """Torque in µN·m with separators between thousands, as a spreadsheet shows it."""
    group = _pick(rng, ",", ".", "'", " ")
    if table.separator in (group, "|"):
        table.separator = ";"
    for cells, torque in zip(table.rows, made.torque_nm, strict=True):
        cells[1] = cells[1].replace(",", ".")
        cells[0] = cells[0].replace(",", ".")
        cells[2] = f"{1e3 * torque:,.0f}".replace(",", group)
    made.plan["torque"] = made.plan["torque"].replace(":N.m", ":mN.m")
    made.digits = 1.0
    made.must, made.names = "refuse", ("line ",)


def _text_in_a_cell(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    row = _row(table, rng)
    text = _pick(rng, "n/a", "error", "0.5rad", "1_000", "1.2.3", "#DIV/0!", "--", "1e", "0x1F")
    table.rows[row][int(rng.integers(1, 3))] = text
    _at(made, table, row)
    if row == 0 and "#" in made.plan["angle"]:
        made.names = ("line ",)


def _empty_cell(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    row = int(rng.integers(1, len(table.rows)))
    table.rows[row][int(rng.integers(1, 3))] = _pick(rng, "", "nan", "NaN", "inf")
    made.must, made.names = "either", (f"line {table.line_of(row)}",)


def _blank_line(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    table.rows.insert(int(rng.integers(1, len(table.rows))), [])
    made.must = "either"
    made.names = ("line ",)


def _trailing_cells(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    if table.separator == " ":
        return
    for cells in table.rows[:: int(rng.integers(1, 4))]:
        cells.extend([""] * int(rng.integers(1, 3)))


def _trailing_lines(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    empty = "" if table.separator == " " else table.separator * 2
    table.tail = [_pick(rng, "", empty)] * int(rng.integers(1, 5))


def _summary(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    first = _pick(rng, "Mean", "Max", "Total", "End of data", "")
    if table.separator == " " and not first:
        first = "Mean"
    first = first.replace(" ", "_") if table.separator == " " else first
    table.rows += [[first, f"0{table.mark}1", f"0{table.mark}2"]]
    if first:
        _at(made, table, len(table.rows) - 1)
    else:
        made.must, made.names = "either" if "rate_hz" in made.plan else "refuse", ("'t'", "'#1'")
        if "rate_hz" in made.plan:
            made.must, made.names = "refuse", ("line ", "'t'", "'#1'")


def _titles_again(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    row = int(rng.integers(1, len(table.rows)))
    table.rows.insert(row, list(table.titles))
    _at(made, table, row)


def _two_records(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    table.rows = [list(cells) for cells in table.rows * 2]
    if rng.random() < 0.5:
        table.rows.insert(len(made.angle_rad), [])
    made.must, made.names = "refuse", ("'t'", "'#1'", "line ")


def _lost_lines(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    first = int(rng.integers(50, 150))
    gone = int(rng.integers(1, 9))
    del table.rows[first : first + gone]
    made.ticks = np.delete(np.arange(len(made.angle_rad)), np.s_[first : first + gone])
    if "rate_hz" in made.plan:
        made.must, made.names = "refuse", ("'t'", "'#1'")


def _swapped_lines(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    row = int(rng.integers(1, len(table.rows) - 1))
    table.rows[row], table.rows[row + 1] = table.rows[row + 1], table.rows[row]
    made.must, made.names = "refuse", ("'t'", "'#1'")


def _doubled_line(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    row = int(rng.integers(1, len(table.rows) - 1))
    table.rows.insert(row, list(table.rows[row]))
    made.must, made.names = "refuse", ("'t'", "'#1'")


def _another_rate(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    made.plan.pop("time", None)
    made.plan["rate_hz"] = made.rate_hz * float(rng.choice([0.5, 2.0, 1.024, 4.0]))
    if rng.random() < 0.4:
        title, factor, form = _pick(
            rng, ("Time (ms)", 1e3, ".6f"), ("time_us", 1e6, ".3f"), ("Zeit/s", 1.0, ".9f")
        )
        if table.separator != " ":
            table.titles[0] = title
            for row, cells in enumerate(table.rows):
                cells[0] = _number(factor * row / made.rate_hz, table.mark, form)
    made.must, made.names = "refuse", ("'t'", "'#1'", "'Time (ms)'", "'time_us'", "'Zeit/s'")


def _stamps(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    if table.separator in (" ", "|"):
        table.separator = ";"
    form = _pick(rng, "2026-11-25 {}", "25.11.2026 {}", "{}", "11/25/2026 {}", "2026-11-25T{}Z")
    point = _pick(rng, ".", ",") if table.separator != "," else "."
    for row, cells in enumerate(table.rows):
        micro = 43_199_900_000 + round(1e6 * row / made.rate_hz)
        seconds, rest = divmod(micro, 1_000_000)
        clock = (
            f"{seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}{point}{rest:06d}"
        )
        cells[0] = form.format(clock)
    made.names = ("line ", "'t'", "'#1'")


def _later_start(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    begin = float(rng.choice([-0.5, 12.0, 3600.0]))
    for row, cells in enumerate(table.rows):
        cells[0] = _number(begin + row / made.rate_hz, table.mark, ".7f")


def _coarse_times(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    for row, cells in enumerate(table.rows):
        cells[0] = _number(round(row / made.rate_hz, 2), table.mark, ".2f")
    made.must = "read" if "rate_hz" in made.plan else "refuse"
    made.names = ("'t'", "'#1'")


def _excel(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    if table.separator != " ":
        table.head = [f"sep={table.separator}"]


def _quotes(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    if table.separator != " ":
        table.titles = [f'"{title}"' for title in table.titles]
        table.rows = [[f'"{cell}"' for cell in cells] for cells in table.rows]


def _open_quote(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    row = _row(table, rng)
    table.rows[row][1] = '"' + table.rows[row][1]
    made.must, made.names = "refuse", ("line ",)


def _comment_titles(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    table.titles[0] = _pick(rng, "# ", "% ", "#") + table.titles[0]


def _comment_within(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    row = int(rng.integers(1, len(table.rows)))
    table.rows.insert(row, ["# overload"])
    _at(made, table, row)


def _same_titles(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    table.titles[1:] = ["torque", "torque"]
    if "#" not in made.plan["angle"]:
        made.plan["angle"] = "#2:rad"
        made.must, made.names = "refuse", ("'torque'",)


def _numbered_titles(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    first = int(rng.integers(0, 2))
    table.titles = [str(first + n) for n in range(3)]
    made.plan = {"angle": "#2:rad", "torque": "#3:N.m", "rate_hz": made.rate_hz}
    made.must, made.names = "either", ("line ",)


def _text_column(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    if table.separator == " ":
        return
    table.titles.append("state")
    for row, cells in enumerate(table.rows):
        cells.append("ok" if row % 7 else "trigger_1")


def _no_titles(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    table.titles = []
    _by_number(made)


def _other_separator_in_a_line(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    row = _row(table, rng)
    other = ";" if table.separator != ";" else "\t"
    table.rows[row] = [other.join(table.rows[row])]
    _at(made, table, row)


def _commas_in_titles(made: EverydayFile, table: _Table, rng: np.random.Generator) -> None:
    """Titles with commas in addition to decimal commas, so that the counts agree."""
    table.separator = ","
    table.titles = ["t", " s", "angle", " rad", "torque", " Nm"]
    table.rows = [
        [_number(float(cell.replace(",", ".")), ",", ".6f") for cell in cells]
        for cells in table.rows
    ]
    made.plan = {"angle": "angle:rad", "torque": "torque:N.m", "rate_hz": made.rate_hz}
    made.must, made.names = "refuse", ("line ",)


_TEXT_MISTAKES: tuple[Callable[[EverydayFile, _Table, np.random.Generator], None], ...] = (
    _nothing, _free_head, _long_head, _labview, _labview, _dasylab, _units_row, _another_units_row,
    _time_units_row, _units_in_titles, _other_units_in_titles, _scaled, _extra_cell, _extra_cell,
    _missing_cell, _missing_cell, _cut_off, _index_column, _decimal_commas, _decimal_commas,
    _quoted_decimal_commas, _mixed_decimals, _thousands, _text_in_a_cell, _empty_cell, _blank_line,
    _trailing_cells, _trailing_lines, _summary, _titles_again, _two_records, _lost_lines,
    _swapped_lines, _doubled_line, _another_rate, _another_rate, _stamps, _later_start,
    _coarse_times, _excel, _quotes, _open_quote, _comment_titles, _comment_within, _same_titles,
    _numbered_titles, _text_column, _no_titles, _other_separator_in_a_line, _commas_in_titles,
    _units_above, _rate_in_head,
)  # fmt: skip


# TDMS


def _tdms(made: EverydayFile, folder: Path, rng: np.random.Generator) -> None:
    from nptdms import ChannelObject, GroupObject, RootObject, TdmsWriter

    made.path, made.must, made.digits = folder / "record.tdms", "read", 1e-12
    step_s = 1 / made.rate_hz
    start = np.datetime64("2026-11-25T12:00:00.000000")
    angle, torque = made.angle_rad.copy(), made.torque_nm.copy()
    properties: list[dict[str, Any]] = [{"wf_increment": step_s}, {"wf_increment": step_s}]
    of_group: dict[str, Any] = {}
    times: np.ndarray | None = None
    made.plan = {"angle": "Rig/Angle:rad", "torque": "Rig/Tz:N.m", "rate_hz": made.rate_hz}
    names = ("Rig/Angle", "Rig/Tz")
    mistake = _pick(
        rng, "plain", "start", "start", "part of a sample", "offset", "far start", "one start",
        "unknown scale", "unknown scale", "scale of the group", "linear scale", "scaled already",
        "default increment", "default increment", "other increment", "times", "times in ms",
        "other times", "unit", "frequency", "stamps", "lengths", "lengths by start",
    )  # fmt: skip
    if mistake in ("start", "offset", "part of a sample", "lengths by start"):
        later = int(rng.integers(1, 30))
        fraction = 0.37 if mistake == "part of a sample" else 0.0
        micro = np.timedelta64(round(1e6 * (later + fraction) * step_s), "us")
        if mistake == "offset":
            properties[0] |= {"wf_start_time": start, "wf_start_offset": 0.0}
            properties[1] |= {"wf_start_time": start, "wf_start_offset": later * step_s}
        else:
            properties[0] |= {"wf_start_time": start, "wf_start_offset": 0.0}
            properties[1] |= {"wf_start_time": start + micro, "wf_start_offset": 0.0}
        made.torque_later = float(later + fraction)
        torque = torque[later:]
        angle = angle if mistake == "lengths by start" else angle[:-later]
        if abs(micro / np.timedelta64(1, "us") - 1e6 * made.torque_later * step_s) > 0.01:
            made.torque_later = float(micro / np.timedelta64(1, "us") / 1e6 / step_s)
    elif mistake == "far start":
        properties[0]["wf_start_time"] = start
        properties[1]["wf_start_time"] = start + np.timedelta64(2, "h")
        made.must, made.names = "refuse", names
    elif mistake == "one start":
        properties[0]["wf_start_time"] = start
        properties[1]["wf_start_time"] = np.datetime64("1904-01-01T00:00:00.000000")
        made.must, made.names = "either", names
    elif mistake in ("unknown scale", "scale of the group"):
        scale = {
            "NI_Number_Of_Scales": 1,
            "NI_Scaling_Status": "unscaled",
            "NI_Scale[0]_Scale_Type": _pick(rng, "Reciprocal", "Piecewise_Polynomial", "Map"),
        }
        if mistake == "unknown scale":
            properties[1] |= scale
        else:
            of_group = scale
        torque = torque * 2
        made.must, made.names = "refuse", ("Reciprocal", "Piecewise_Polynomial", "Map")
    elif mistake in ("linear scale", "scaled already"):
        properties[1] |= {
            "NI_Number_Of_Scales": 1,
            "NI_Scaling_Status": "unscaled" if mistake == "linear scale" else "scaled",
            "NI_Scale[0]_Scale_Type": "Linear",
            "NI_Scale[0]_Linear_Slope": 0.5,
            "NI_Scale[0]_Linear_Y_Intercept": 0.25,
        }
        torque = (torque - 0.25) / 0.5 if mistake == "linear scale" else torque
    elif mistake == "default increment":
        for each in properties:
            each["wf_increment"] = 1.0
        way = _pick(rng, "rate", "insist", "times")
        if way == "rate":
            made.must, made.names = "refuse", names
        elif way == "insist":
            made.plan["ignore_file_metadata"] = True
        else:
            times = np.arange(len(angle)) * step_s
            del made.plan["rate_hz"]
            made.plan["time"] = "Rig/Time:s"
    elif mistake == "other increment":
        made.plan["rate_hz"] = made.rate_hz * float(rng.choice([0.5, 2.0, 1.0002]))
        made.must, made.names = "refuse", names
    elif mistake in ("times", "times in ms", "other times"):
        times = np.arange(len(angle)) * step_s
        properties = [{}, {}]
        if mistake == "times in ms":
            times = 1e3 * times
        if mistake == "other times":
            made.plan["rate_hz"] = made.rate_hz * 2
            made.must, made.names = "refuse", ("Rig/Time",)
        elif rng.random() < 0.5:
            del made.plan["rate_hz"]
            made.plan["time"] = f"Rig/Time:{'ms' if mistake == 'times in ms' else 's'}"
    elif mistake == "unit":
        properties[0]["unit_string"] = _pick(rng, "deg", "degrees", "mrad")
        made.must, made.names = "refuse", names
    elif mistake == "frequency":
        properties[0]["wf_xunit_string"] = "Hz"
        made.must, made.names = "refuse", names
    elif mistake == "stamps":
        micro = np.round(1e6 * np.arange(len(angle)) * step_s).astype("timedelta64[us]")
        times = start + micro
        del made.plan["rate_hz"]
        made.plan["time"] = "Rig/Time:s"
    elif mistake == "lengths":
        torque = torque[: -int(rng.integers(1, 9))]
        made.must, made.names = "refuse", names
    made.story = f"tdms, {mistake}, {made.plan}"
    channels = [
        ChannelObject("Rig", "Angle", angle, properties[0]),
        ChannelObject("Rig", "Tz", torque, properties[1]),
    ]
    if times is not None:
        channels.append(ChannelObject("Rig", "Time", times, {}))
    with TdmsWriter(str(made.path)) as writer:
        writer.write_segment([RootObject(), GroupObject("Rig", properties=of_group), *channels])


# Universal files


def _uff(made: EverydayFile, folder: Path, rng: np.random.Generator) -> None:
    made.path, made.must = folder / "record.uff", "read"
    made.rate_hz = float(rng.choice([500.0, 1000.0, 2000.0]))
    step = 1 / made.rate_hz
    angle, torque = made.angle_rad.copy(), made.torque_nm.copy()
    even, binary = int(rng.random() < 0.7), int(rng.random() < 0.5)
    made.digits = 1e-10
    sets: list[dict[str, Any]] = [
        {"id1": "angle", "start": 0.0, "unit": "rad"},
        {"id1": "torque", "start": 0.0, "unit": "Nm"},
    ]
    common: dict[str, Any] = {"func": 1, "axis": 17, "label": "Time", "xunit": "s", "scale": 1.0}
    made.plan = {"angle": "#1:rad", "torque": "torque:N.m"}
    if rng.random() < 0.5:
        made.plan["rate_hz"] = made.rate_hz
    else:
        made.plan["time"] = "abscissa:s"
    names = ("#1", "torque", "abscissa")
    mistake = _pick(
        rng, "plain", "start", "start", "part of a sample", "milliseconds", "milliseconds",
        "milliseconds unsaid", "spectrum", "spectrum", "frequency axis", "no axis type", "unit",
        "other rate", "complex", "lengths", "uneven", "label of unit",
    )  # fmt: skip
    if mistake in ("start", "part of a sample"):
        later = int(rng.integers(1, 20))
        fraction = 0.4 if mistake == "part of a sample" else 0.0
        sets[1]["start"] = (later + fraction) * step
        made.torque_later = later + fraction
        angle, torque = angle[:-later], torque[later:]
        if not even:
            made.must, made.names = "either", names
    elif mistake == "milliseconds":
        common |= {"scale": 1e3, "xunit": _pick(rng, "ms", "msec", "[ms]")}
        if "time" in made.plan and rng.random() < 0.6:
            made.plan["time"] = "abscissa:ms"
        elif "time" in made.plan:
            made.must, made.names = "refuse", names
    elif mistake == "milliseconds unsaid":
        common |= {"scale": 1e3, "xunit": "NONE"}
        if "time" in made.plan:
            made.plan["time"] = "abscissa:ms"
        elif rng.random() < 0.5:
            made.plan["ignore_file_metadata"] = True
        else:
            made.must, made.names = ("refuse" if even else "either"), names
    elif mistake == "spectrum":
        common |= {"func": int(_pick(rng, 2, 3, 4, 6)), "axis": int(_pick(rng, 17, 18))}
        common |= {"label": "Frequency", "xunit": "Hz"}
        made.must, made.names = "refuse", names
    elif mistake == "frequency axis":
        common |= {"axis": int(_pick(rng, 18, 19, 20)), "label": "NONE", "xunit": "NONE"}
        made.must, made.names = "refuse", names
    elif mistake == "no axis type":
        common |= {"axis": 0, "func": 0}
        if rng.random() < 0.5:
            common |= {"xunit": "Hz", "label": "Frequency"}
            made.must, made.names = "refuse", names
    elif mistake == "unit":
        sets[0]["unit"] = _pick(rng, "deg", "mrad", "degrees")
        made.must, made.names = "refuse", names
    elif mistake == "label of unit":
        sets[0] |= {"unit": "NONE", "title": "Angle [deg]"}
        made.must, made.names = "refuse", names
    elif mistake == "other rate":
        made.plan = {k: v for k, v in made.plan.items() if k != "time"}
        made.plan["rate_hz"] = made.rate_hz * float(rng.choice([0.5, 2.0, 1.001]))
        made.must, made.names = "refuse", names
    elif mistake == "complex":
        torque = torque + 1j * torque
        made.must, made.names = "refuse", names
    elif mistake == "lengths":
        torque = torque[:-5]
        made.must, made.names = "refuse", names
    elif mistake == "uneven":
        even = 0
    made.story = f"uff, {mistake}, even {even}, binary {binary}, {made.plan}"
    columns = zip(sets, (angle, torque), strict=True)
    _write_uff(made.path, [(own, common, values) for own, values in columns], step, even, binary)


def _write_uff(path: Path, sets: list[Any], step: float, even: int, binary: int) -> None:
    import pyuff

    path.unlink(missing_ok=True)
    written = []
    for own, common, values in sets:
        x = (own["start"] + np.arange(len(values)) * step) * common["scale"]
        empty = {
            f"{axis}_{part}": 0
            for axis in ("abscissa", "ordinate", "orddenom", "z_axis_axis")
            for part in ("spec_data_type", "len_unit_exp", "force_unit_exp", "temp_unit_exp")
        }
        labels = {
            f"{axis}_axis_{part}": "NONE"
            for axis in ("abscissa", "ordinate", "orddenom", "z_axis_axis")
            for part in ("lab", "units_lab")
        }
        written.append({
            "type": 58, "binary": binary, "id1": own["id1"], "id2": "NONE", "id3": "NONE",
            "id4": "NONE", "id5": "NONE", "func_type": common["func"], "ver_num": 0,
            "load_case_id": 0, "rsp_ent_name": "P", "rsp_node": 1, "rsp_dir": 1,
            "ref_ent_name": "NONE", "ref_node": 0, "ref_dir": 0, "data": values, "x": x,
            "num_pts": len(values), "abscissa_spacing": even, "abscissa_min": float(x[0]),
            "abscissa_inc": float(x[1] - x[0]), "z_axis_value": 0.0,
            "ord_data_type": 6 if np.iscomplexobj(values) else 4, **empty, **labels,
            "abscissa_spec_data_type": common["axis"], "abscissa_axis_lab": common["label"],
            "abscissa_axis_units_lab": common["xunit"], "ordinate_axis_units_lab": own["unit"],
            "ordinate_axis_lab": own.get("title", "NONE"),
        })  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)
        for each in written:
            pyuff.UFF(str(path)).write_sets(each, "add")
            gc.collect()  # pyuff leaves binary files open


# MATLAB


def _mat(made: EverydayFile, folder: Path, rng: np.random.Generator) -> None:
    made.path, made.must, made.digits = folder / "record.mat", "read", 1e-12
    angle, torque = made.angle_rad, made.torque_nm
    time_s = np.arange(len(angle)) / made.rate_hz
    newer = bool(rng.random() < 0.3)
    by_rate = bool(rng.random() < 0.5)
    made.plan = {"angle": "angle:rad", "torque": "torque:N.m"}
    names: tuple[str, ...] = ("angle", "torque")
    if by_rate:
        made.plan["rate_hz"] = made.rate_hz
    else:
        made.plan["time"] = "t:s"
    contents: dict[str, Any] = {"t": time_s, "angle": angle[None, :], "torque": torque[:, None]}
    mistake = _pick(
        rng, "plain", "struct", "struct array", "struct array unnamed", "matrix",
        "rows of a matrix", "other rate by t", "other rate by Fs", "dt", "t in ms", "timeseries",
        "timeseries in ms",
        "simulink", "text", "complex", "single", "gaps", "backward", "nested t", "lengths",
    )  # fmt: skip
    if mistake == "struct":
        contents = {"log": contents}
        made.plan = {k: f"log.{v}" if isinstance(v, str) else v for k, v in made.plan.items()}
    elif mistake in ("struct array", "struct array unnamed"):
        newer = False
        runs = np.empty((1, 3), dtype=[("t", "O"), ("angle", "O"), ("torque", "O")])
        for index in range(3):
            runs[0, index] = (time_s, angle * (1 + index), torque * (2 - index) + index)
        made.angle_rad, made.torque_nm = 2 * angle, torque + 1
        contents = {"log": runs}
        first = "log(2)" if mistake == "struct array" else "log"
        made.plan = {k: f"{first}.{v}" if isinstance(v, str) else v for k, v in made.plan.items()}
        if mistake == "struct array unnamed":
            made.must, made.names = "refuse", ("log(1)",)
    elif mistake in ("matrix", "rows of a matrix"):
        matrix = np.column_stack([time_s, angle, torque])
        contents = {"m": matrix if mistake == "matrix" else matrix.T}
        made.plan = {"angle": "m#2:rad", "torque": "m#3:N.m", "rate_hz": made.rate_hz}
        if mistake != "matrix":
            made.must, made.names = "refuse", ("m#2", "m#3")
    elif mistake == "other rate by t":
        made.plan = {**made.plan, "rate_hz": 2 * made.rate_hz}
        made.plan.pop("time", None)
        made.must, made.names = "refuse", ("'t'",)
    elif mistake in ("other rate by Fs", "dt"):
        del contents["t"]
        key, value = ("dt", 1 / made.rate_hz) if mistake == "dt" else ("Fs", made.rate_hz)
        contents[key] = value
        made.plan.pop("time", None)
        made.plan["rate_hz"] = made.rate_hz * float(rng.choice([1.0, 2.0]))
        if made.plan["rate_hz"] != made.rate_hz:
            made.must, made.names = "refuse", names
    elif mistake == "t in ms":
        contents["t"] = 1e3 * time_s
        if not by_rate:
            made.plan["time"] = "t:ms"
    elif mistake in ("timeseries", "timeseries in ms"):
        newer = False
        late = 1e3 if mistake != "timeseries" else 1.0
        unit = "seconds" if mistake == "timeseries" else "milliseconds"
        contents = {
            name: {
                "Time": late * time_s, "Data": values, "TimeInfo": {"Units": unit},
                "DataInfo": {"Units": data_unit},
            }
            for name, values, data_unit in (("q", angle, "rad"), ("T", torque, "N*m"))
        }  # fmt: skip
        made.plan = {"angle": "q.Data:rad", "torque": "T.Data:N.m"}
        if by_rate:
            made.plan["rate_hz"] = made.rate_hz
        else:
            made.plan["time"] = "q.Time:s"
            if mistake != "timeseries":
                made.must, made.names = "refuse", ("q.Time",)
    elif mistake == "simulink":
        newer = False
        signals = np.empty((1, 2), dtype=[("values", "O"), ("label", "O")])
        signals[0, 0], signals[0, 1] = (angle[:, None], "q"), (torque[:, None], "T")
        contents = {"out": {"time": time_s, "signals": signals}}
        made.plan = {"angle": "out.signals(1).values:rad", "torque": "out.signals(2).values:N.m"}
        if by_rate:
            made.plan["rate_hz"] = 2 * made.rate_hz
            made.must, made.names = "refuse", ("out.time",)
        else:
            made.plan["time"] = "out.time:s"
    elif mistake == "text":
        contents["angle"] = "0.1 0.2"
        made.must, made.names = "refuse", names
    elif mistake == "complex":
        contents["torque"] = torque + 1j * torque
        made.must, made.names = "refuse", names
    elif mistake == "single":
        contents["angle"], made.digits = angle.astype(np.float32), 1e-6
    elif mistake == "gaps":
        present = np.delete(np.arange(len(angle)), np.s_[100:105])
        contents = {"t": time_s[present], "angle": angle[present], "torque": torque[present]}
        made.ticks = present
        if by_rate:
            made.must, made.names = "refuse", ("'t'",)
    elif mistake == "backward":
        contents["t"] = np.concatenate([time_s[: len(angle) // 2]] * 2 + [time_s])[: len(angle)]
        made.must, made.names = "refuse", ("'t'",)
    elif mistake == "nested t":
        contents = {"a": {"b": {"angle": angle, "torque": torque}, "t": time_s}}
        made.plan = {"angle": "a.b.angle:rad", "torque": "a.b.torque:N.m"}
        made.plan["rate_hz"] = made.rate_hz * (2 if by_rate else 1)
        if by_rate:
            made.must, made.names = "refuse", ("a.t",)
    elif mistake == "lengths":
        contents["torque"] = torque[:-7]
        made.must, made.names = "refuse", names
    made.story = f"mat, {mistake}, version 7.3 {newer}, {made.plan}"
    _write_mat(made.path, contents, newer)


def _write_mat(path: Path, contents: dict[str, Any], newer: bool) -> None:
    if not newer:
        import scipy.io

        scipy.io.savemat(path, contents, do_compression=True)
        return
    import h5py

    def add(group: Any, values: dict[str, Any]) -> None:
        for key, value in values.items():
            if isinstance(value, dict):
                add(group.create_group(key), value)
            elif isinstance(value, str):
                data = group.create_dataset(
                    key, data=np.array([[ord(c) for c in value]], np.uint16).T
                )
                data.attrs["MATLAB_class"] = np.bytes_("char")
            else:
                array = np.atleast_2d(np.asarray(value))
                kind = "single" if array.dtype == np.float32 else "double"
                data = group.create_dataset(key, data=array.T)
                data.attrs["MATLAB_class"] = np.bytes_(kind)

    with h5py.File(path, "w", userblock_size=512) as file:
        add(file, contents)
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
