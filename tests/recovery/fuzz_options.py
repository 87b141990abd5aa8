"""Hostile values on the command line: ``python tests/recovery/fuzz_options.py [--seed SEED]``.

Every option and argument of every command of `rigd` and `analyze`, as the typer applications list
them, and every key of the files that a user writes (profile, specimen, EDS, JSON, reference, record
of another program), each with an absurd value: not finite, beyond every range, a million
characters, control characters, a pipe instead of a file. Each command may take 500 MB, 30 s of
a processor and 1 MB of output, and ends with 0, 1 or 2 and without a traceback. A daemon of a
simulated rig gets the requests of `rigd start` and the like, and may not grow.

"""

import argparse
import contextlib
import importlib
import inspect
import json
import os
import re
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import get_args

import typer
from fuzz_hostile import MOST_MEGABYTES, MOST_PRINTED, Outcome, run_forked
from typer.utils import get_params_from_function

from rigd.runtime.background import use_one_thread

LONG = 1_000_000
STEP = 11
"""From the value of one option to that of the next: prime to the lengths of the lists."""
DIGITS = "9" * 5000
CONTROL = "\x1b]0;owned\x07\x1b[2J\r\nError"
NUMBERS = (
    "nan", "inf", "-inf", "1e308", "-1e308", "1e300", "1e-308", "5e-324", "0", "-1", "1e9",
    DIGITS, "", "1e", "0x10", "\u0663", "9" * 400, CONTROL, "9" * LONG, "\udcff", "2147483648",
)  # fmt: skip
TEXTS = (
    "", "x" * LONG, CONTROL, "\udcff\udcfe", "nan", "0,1e308", "1e308,0", "nan,nan", "-1", DIGITS,
    "=", "a=" + "x" * LONG, "temperature_c=nan", f"temperature_c={DIGITS}", "../../etc/passwd", "/",
    ",".join(["1"] * 100_000), "\u202etxt", "%s%n{0}", "x=nan,angle=inf,stiffness=1e308",
    "x=1e-308,force=1e308,duration=1e308,at=1e300", "VI," * 100_000, "omega^1e308", "0:0", "1e300",
    "2=1e-308", "9999999999=1", "2026-13-45", "sensor_dead,at=nan", "unknown_section." * 1000,
)  # fmt: skip
FILES = (
    "pipe", "folder", "socket", "/dev/zero", "/dev/null", "missing", "empty", "binary", "nul",
    "x" * 5000, "", "\udcff", "loop", "huge", CONTROL, "/proc/self/mem", "\u202e.mcap",
)  # fmt: skip
"""Names of the objects of `make_odd`, and others."""
ODD = ("pipe", "folder", "socket", "empty", "binary", "nul", "loop", "huge", "missing")
SUFFIXES = (".toml", ".json", ".csv", ".mcap", ".mat", ".uff", ".tdms", ".eds", ".rrd", "")
INTERRUPTED_AFTER_S = 8.0
"""Time after which a command that serves is interrupted."""
SERVING = ("serve", "simulate", "live", "status", "replay")
MOST_GROWTH_MEGABYTES = 40
"""Memory by which the daemon may grow."""
IMPORTED = (
    "rigd.cli.app", "rigd.runner", "rigd.profile", "rigd.daemon", "rigd.session", "rigd.checks",
    "rigd.devices", "analysis.cli.app", "analysis.cli.exchange", "analysis.exchange",
    "analysis.exchange._csv_format", "analysis.paper", "analysis.report", "matplotlib.figure",
    "scipy.io",
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A command line with its files."""

    name: str
    program: str
    arguments: list[str]
    files: dict[str, bytes | Callable[[], bytes]] = field(default_factory=dict)
    """Files that it needs, or their makers, by their names in the case's folder."""

    @property
    def serves(self):
        """Whether it runs until it is interrupted."""
        return any(word in SERVING for word in self.arguments[:1])


class Ground:
    """Files and daemon for commands that are otherwise in order."""

    def __init__(self, folder):
        self.folder = Path(folder)
        self.session = self.folder / "session.mcap"
        self.reference = self.folder / "reference.csv"
        self.modes = self.folder / "modes.json"
        self.record = self.folder / "record.csv"
        self.eds = self.folder / "drive.eds"
        self.served = self.folder / "served.toml"
        self.daemon = None

    def make(self):
        """Write the files."""
        from rigd.testing import chirp_signals, write_profile, write_session

        write_session(self.session, chirp_signals(sweep_s=20.0))
        self.reference.write_text("angle_rad\n" + "0.001\n" * 200)
        modes = [{"frequency_hz": 2.6, "damping_ratio": 0.01}]
        values = {"density_over_stiffness": 0.052, "bending_stiffness_n_m2": 0.0903}
        parameters = {name: {"value": value, "std": 1e-6} for name, value in values.items()}
        self.modes.write_text(
            json.dumps({"modes": modes, "headlines": [{"file": "a", "parameters": parameters}]})
        )
        rows = [f"{i / 1000},{0.001 * (i % 7)},{0.01 * (i % 5)}" for i in range(3000)]
        self.record.write_text("time_s,angle_rad,torque_nm\n" + "\n".join(rows) + "\n")
        self.eds.write_bytes((Path(__file__).parents[1] / "data" / "eds" / "e35.eds").read_bytes())
        write_profile(self.folder, {"name": "served"})

    def start_daemon(self):
        """Start a daemon of a simulated rig; wait until it is ready."""
        command = [sys.executable, "-m", "rigd", "serve", "--profile", str(self.served), "--fast"]
        self.daemon = subprocess.Popen(
            [*command, "--no-look", "--output", str(self.folder / "served")],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        self.wait_until_ready()
        # Imports of the first session do not count as growth.
        self._run("start", *sound_arguments(self, ["rigd", "start", "chirp"])[:-2])
        self.wait_until_ready()

    def wait_until_ready(self):
        """End the session of the daemon, and wait until it is ready."""
        for _ in range(600):
            status = self._run("status", "--json")
            state = json.loads(status).get("state") if status else ""
            if state == "ready":
                return
            if state in ("running", "fault"):
                self._run("stop" if state == "running" else "reset")
            time.sleep(0.1)
        raise RuntimeError("the daemon does not become ready")

    def _run(self, *words):
        command = [sys.executable, "-m", "rigd", *words, "--profile", str(self.served)]
        return subprocess.run(command, capture_output=True, check=False).stdout

    def stop_daemon(self):
        """End it."""
        if self.daemon is not None:
            self.daemon.terminate()
            self.daemon.wait(60)

    def daemon_megabytes(self):
        """Return its memory now and its peak memory."""
        status = Path(f"/proc/{self.daemon.pid}/status").read_text()
        fields = dict(line.split(":", 1) for line in status.splitlines())
        return tuple(int(fields[name].split()[0]) / 1024 for name in ("VmRSS", "VmHWM"))


def sound_arguments(ground, words):
    """Return arguments with which a command is in order and short, by its words."""
    simulated = ["--profile", "sim"]
    short = ["--duration", "0.3", "--rest", "0", "--ring-down", "0"]
    rests = ["--rest", "0", "--ring-down", "0"]
    program, *names = words
    if program == "rigd" and names[0] in ("run", "start"):
        own = {
            "chirp": short, "hold": short, "step": [*short, "--amplitude", "0.001"],
            "multisine": [*short, "--period", "0.3", "--start-hz", "4"],
            "file": [str(ground.reference), *rests],
            "modes": [str(ground.modes), "--duration", "5", *rests],
            "touch": ["0.05", *rests], "move": ["0.05", *rests],
            "until": ["--at-most", "25", "--scan", "5", "--rest", "0"],
        }[names[1]]  # fmt: skip
        if names[0] == "start":
            return [*own, "--profile", str(ground.served)]
        return [*own, *simulated, "--fast", "--no-look", "--output", str(ground.folder / "out")]
    of_daemon = ["--profile", str(ground.served)]
    return {
        "rigd check": simulated, "rigd probe": [*simulated, "--fast"],
        "rigd serve": [*simulated, "--output", str(ground.folder / "out"), "--no-look"],
        "rigd live": of_daemon, "rigd status": of_daemon, "rigd stop": of_daemon,
        "rigd tare": of_daemon, "rigd zero": of_daemon, "rigd reset": of_daemon,
        "rigd list": [str(ground.folder)], "rigd specimens": [],
        "rigd info": [str(ground.session)],
        "rigd replay": [str(ground.session), "--save", "@/out.rrd"],
        "rigd recover": [str(ground.session)],
        "rigd bench": [*simulated, "--seconds", "1"],
        "rigd simulate": ["--profile", "antenna_can", "--quiet"],
        "rigd inject": ["sensor_dead", "--profile", "antenna_can"],
        "rigd identify motor": [*simulated, "--fast", "--output", str(ground.folder / "out")],
        "rigd plugins default": [], "rigd plugins show": ["netft"],
        "rigd plugins new": ["probe", "--folder", "@/package"],
        "rigd profiles list": [], "rigd profiles show": ["sim"],
        "rigd profiles copy": ["sim", "mine"],
        "rigd profiles new": ["--eds", str(ground.eds), "--output", "@/new.toml"],
        "analyze import": [
            str(ground.record), "@/imported.mcap", "--angle", "angle_rad:rad", "--torque",
            "torque_nm:N.m", "--profile", str(ground.served), "--time", "time_s",
        ],
        "analyze touch": [str(ground.session)],
        "analyze default": [
            str(ground.session), "--method", "welch", "--types", "III", "--report", "@/report",
        ],
        "analyze export record": [str(ground.session), "@/out.csv"],
        "analyze export frf": [str(ground.session), "@/out.csv"],
        "analyze export model": [str(ground.session), "@/out.json"],
    }[" ".join(words)]  # fmt: skip


def commands():
    """Yield each command of both programs: its words, and its parameters with their types."""
    from analysis.cli.app import app as analyze
    from rigd.cli.app import app as rigd

    def walk(command, words):
        if hasattr(command, "commands"):
            for name, each in command.commands.items():
                yield from walk(each, [*words, name])
            return
        known = get_params_from_function(inspect.unwrap(command.callback))
        yield words, [(each, known[each.name].annotation) for each in command.params]

    for name, app in (("rigd", rigd), ("analyze", analyze)):
        yield from walk(typer.main.get_command(app), [name])


def option_cases(ground, seed, every):
    """Yield a case for each option and argument, or for every value of it.

    An option common to all excitations is tried once with `rigd run` and once with `rigd start`.
    """
    turn = seed
    known = set()
    shared = set.intersection(
        *({p.opts[-1] for p, _ in parameters} for words, parameters in commands() if len(words) == 3
          and words[1] in ("run", "start"))
    )  # fmt: skip
    for words, parameters in commands():
        sound = sound_arguments(ground, words)
        program, *names = [word for word in words if word != "default"]
        positional, options = _split_arguments(sound)
        position = -1
        for parameter, annotation in parameters:
            types = {annotation, *get_args(annotation)}
            is_option = parameter.param_type_name == "option"
            label = parameter.opts[-1] if is_option else parameter.name
            position += not is_option
            if bool in types:
                values = ("",)
            elif types & {int, float}:
                values = NUMBERS
            elif Path in types or list[Path] in types:
                values = tuple(_file_values(label))
            else:
                values = (*TEXTS, *NUMBERS, *(f"@odd/{kind}.toml" for kind in ODD))
            if (*words[:2], label) in known and label in shared:
                continue
            known.add((*words[:2], label))
            for value in values if every else [values[turn % len(values)]]:
                name = f"{' '.join(words)} {label} {value[:40]!r}"
                if not is_option:
                    given = [*positional[:position], value, *positional[position + 1 :], *options]
                elif bool in types:
                    given = [*sound, label]
                elif label in sound and not parameter.multiple:
                    at = sound.index(label)
                    given = [*sound[: at + 1], value, *sound[at + 2 :]]
                else:
                    given = [*sound, label, value]
                yield Case(name, program, [*names, *given])
            turn += STEP


def _file_values(label):
    """Yield names of objects other than files, with the suffixes of the readers."""
    for number, name in enumerate(FILES * len(SUFFIXES)):
        if name in ODD:
            yield f"@odd/{name}{SUFFIXES[number % len(SUFFIXES)]}"
        else:
            yield name


def _split_arguments(arguments):
    """Split arguments before the first option."""
    first = next((i for i, each in enumerate(arguments) if each.startswith("--")), len(arguments))
    return arguments[:first], arguments[first:]


# Files


TOML_NUMBERS = (
    "nan", "inf", "-inf", "1e308", "-1e308", "1e300", "1e-308", "5e-324", "0.0", "-1.0", "1e9",
    DIGITS, "9" * 400, "9223372036854775808", '""', "true", "[]", "{}", "1979-05-27", "[1.0, nan]",
    '"\\u0000"', '"\\u001b[2J"', '"' + "x" * LONG + '"', "[" * 500 + "]" * 500, "1.0" + "0" * LONG,
)  # fmt: skip
TOML_TEXTS = (
    '""', '"\\u0000"', '"\\u001b[2J\\r\\n"', '"' + "x" * LONG + '"', "1", "nan", "[]", "{}",
    '"/dev/zero"', '"../../../../../../dev/zero"', DIGITS, '["a"]', '["' + "y" * LONG + '"]',
)  # fmt: skip
JSON_VALUES = (
    "NaN", "Infinity", "-Infinity", "1e308", "-1e308", "1e300", "1e-308", "5e-324", "0", "-1",
    "1e400", "9" * 400, DIGITS, '""', "null", "[]", "{}", "true", '"\\ud800"', '"\\u0000\\u001b"',
    '"' + "x" * LONG + '"', "[" * 100_000 + "]" * 100_000,
)  # fmt: skip
EDS_VALUES = (
    "", "nan", "9" * 31, DIGITS, "-1", "0x" + "F" * 32, "$NODEID" * 1000, "x" * LONG, "\x1b[2J",
    "TRUE", '"rw"', "0x", "\u0663", "1e308", "255", "0xFFFFFFFF",
)  # fmt: skip


def _sourced(value):
    return f'{{ value = {value}, source = "assumed" }}'


def _with_value(text, key, value):
    """Give a key of a profile another value, as it is written."""
    section, _, name = key.rpartition(".")
    lines, here, done = [], "", False
    for line in text.splitlines():
        if line.startswith("["):
            if here == section and not done:
                lines.append(f"{name} = {_sourced(value)}")
                done = True
            here = line.strip("[] ")
        elif here == section and line.partition("=")[0].strip() == name and not done:
            lines.append(f"{name} = {_sourced(value) if '{ value' in line else value}")
            done = True
            continue
        lines.append(line)
    if not done:
        lines.append(f"[{section}]\n{name} = {value}")
    return "\n".join(lines) + "\n"


def key_cases(seed, every):
    """Yield cases for each key of profile, specimen, EDS and JSON files."""
    from rigd.profile import load_profile
    from rigd.profile._schema import is_number_type, key_types

    turn = seed
    for base in ("sim", "antenna_can", "antenna_serial"):
        text = load_profile(base).text
        for key, annotation in key_types().items():
            if base != "sim" and not key.startswith(("can.", "cia402.", "ati_", "acquisition.")):
                continue
            values = TOML_NUMBERS if is_number_type(annotation) else TOML_TEXTS
            for value in values if every else [values[turn % len(values)]]:
                hostile = _with_value(text, key, value).encode(errors="replace")
                name = f"profile {base} {key} = {value[:40]}"
                yield Case(f"check {name}", "rigd", ["check", "--profile", "@/p.toml"],
                           {"p.toml": hostile})  # fmt: skip
                if base == "sim":
                    run = ["run", "hold", "--duration", "0.2", "--rest", "0", "--fast", "--no-look"]
                    yield Case(f"run {name}", "rigd",
                               [*run, "--profile", "@/p.toml", "--output", "@/out"],
                               {"p.toml": hostile})  # fmt: skip
            turn += STEP
    yield from _specimen_cases(seed, every)
    yield from _eds_cases(seed, every)
    yield from _json_cases(seed, every)


def _specimen_cases(seed, every):
    beam = {"length_m": "0.98", "density_kg_per_m": "0.0047", "bending_stiffness_n_m2": "0.0903"}
    keys = [f"beam.{key}" for key in beam]
    keys += [f"beam.damping.{key}" for key in ("alpha", "zeta", "lambda", "gamma")]
    keys += ["uncertainty.length_percent", "uncertainty.density_percent", "note", "unknown"]
    keys += ["beam.tip_mass_kg", "uncertainty.tip_mass_percent", "uncertainty.uniformity_percent"]
    keys += ["sensor.tool_inertia_kg_m2"]
    for turn, key in enumerate(keys, seed):
        for value in TOML_NUMBERS if every else [TOML_NUMBERS[STEP * turn % len(TOML_NUMBERS)]]:
            stated = {
                f"beam.{k}": f'{{ value = {v}, source = "assumed" }}' for k, v in beam.items()
            }
            braced = key not in ("note", "unknown")
            stated[key] = _sourced(value) if braced else value
            text = "\n".join(f"{k} = {v}" for k, v in stated.items()).encode()
            name = f"specimen {key} = {value[:40]}"
            files = {"specimens/beam.toml": text}
            yield Case(f"list {name}", "rigd", ["specimens"], files)
            run = ["run", "hold", "--duration", "0.2", "--rest", "0", "--fast", "--no-look"]
            run += ["--output", "@/out", "--specimen", "beam", "--profile", "sim"]
            yield Case(f"run {name}", "rigd", run, files)
            command = ["import", "@/a.csv", "@/b.mcap", "--angle", "a:rad", "--torque", "t:N.m"]
            command += ["--rate-hz", "1000", "--profile", "@/specimens/beam.toml"]
            record = b"a,t\n" + b"0.1,0.2\n" * 3000
            yield Case(f"import {name}", "analyze", command, files | {"a.csv": record})


def _eds_cases(seed, every):
    text = (Path(__file__).parents[1] / "data" / "eds" / "e35.eds").read_text()
    lines = text.splitlines()
    keys = {line.partition("=")[0].strip() for line in lines if "=" in line and line[0] not in ";#"}
    for turn, key in enumerate(sorted(keys), seed):
        for value in EDS_VALUES if every else [EDS_VALUES[STEP * turn % len(EDS_VALUES)]]:
            hostile = "\n".join(
                f"{key}={value}" if line.partition("=")[0].strip() == key else line
                for line in (lines if len(value) < 1000 else lines[:60])
            )
            files = {"d.eds": hostile.encode()}
            name = f"eds {key} = {value[:40]}"
            yield Case(
                f"new {name}",
                "rigd",
                ["profiles", "new", "--eds", "@/d.eds", "--output", "@/n.toml"],
                files,
            )
            check = ["check", "--profile", "antenna_can", "--eds", "@/d.eds"]
            yield Case(f"check {name}", "rigd", check, files)


def _json_cases(seed, every):
    names = ["frequency_hz", "damping_ratio", "frequency_std_hz", "estimator", "modes"]
    names += ["headlines", "parameters", "density_over_stiffness", "bending_stiffness_n_m2"]
    names += ["zeta", "alpha", "gamma", "lambda", "tool_inertia_kg_m2", "delay_s", "value", "std"]
    names += ["interval_95", "file"]
    for turn, key in enumerate(names, seed):
        for value in JSON_VALUES if every else [JSON_VALUES[STEP * turn % len(JSON_VALUES)]]:
            mark = "@@"
            mode = {"frequency_hz": 2.6, "damping_ratio": 0.01, "frequency_std_hz": 0.001}
            mode["estimator"] = "record"
            entry = {"value": 1.0, "std": 0.1, "interval_95": [0.8, 1.2]}
            chosen = {"density_over_stiffness": 0.052, "bending_stiffness_n_m2": 0.0903}
            parameters = {k: entry | {"value": v} for k, v in chosen.items()}
            headline = {"file": "a", "parameters": parameters}
            document = {"modes": [mode], "headlines": [headline]}
            holder = next(
                each for each in (document, headline, mode, entry, parameters)
                if key in each or each is parameters
            )  # fmt: skip
            if holder is entry:
                holder = parameters["density_over_stiffness"]
            holder[key] = mark if holder is not parameters else entry | {"value": mark}
            text = json.dumps(document).replace(f'"{mark}"', value).encode()
            files = {"m.json": text}
            short = ["--profile", "sim", "--fast", "--no-look", "--output", "@/out"]
            name = f"json {key} = {value[:40]}"
            modes = ["run", "modes", "@/m.json", "--duration", "5", "--ring-down", "0", *short]
            yield Case(f"modes {name}", "rigd", modes, files)
            move = ["run", "move", "0.05", "--model", "@/m.json", "--ring-down", "0", *short]
            yield Case(f"move {name}", "rigd", move, files)


def whole_file_cases(ground):
    """Yield files that are hostile as a whole, for each command that reads such files."""
    deep_toml = b"a = " + b"[" * 20_000 + b"]" * 20_000
    tomls = {
        "deep arrays": lambda: deep_toml,
        "deep tables": lambda: b"a = " + b"{ b = " * 20_000 + b"1" + b" }" * 20_000,
        "deep keys": lambda: b"a" + b".a" * 20_000 + b" = 1",
        "deep header": lambda: b"[" + b"a." * 20_000 + b"a]",
        "long number": lambda: b"a = " + b"9" * 5000,
        "long float": lambda: b"a = 1." + b"9" * 1_000_000,
        "unknown tables": lambda: b"".join(b"[t%d]\na = 1\n" % i for i in range(100_000)),
        "unknown keys": lambda: b"".join(b"k%d = 1\n" % i for i in range(100_000)),
        "unknown parts": lambda: b"[rig]\nrate_hz = { value = 1, "
        + b", ".join(b"p%d = 1" % i for i in range(20_000)) + b" }",
        "long key": lambda: b"x" * LONG + b" = 1",
        "nul": lambda: b"\0" * LONG,
        "control": lambda: b'a = "\x1b[2J"',
        "escaped control": lambda: b'"\\u001b[2J\\u0007" = 1\n[x]\n"\\u202e" = 2',
        "large": lambda: b"# comment\n" * 10_000_000,
        "tables as many as there may be": lambda: b"".join(
            b"[table_%d]\nkey = 1\n" % i for i in range(1400)
        ),
        "keys as long as there may be": lambda: b"".join(
            b"[t%d]\na" % i + b".a" * 2000 + b" = 1\n" for i in range(60)
        ),
        "not utf-8": lambda: b"\xff\xfe" * 1000,
    }  # fmt: skip
    run = ["run", "hold", "--duration", "0.2", "--fast", "--no-look", "--output", "@/out"]
    record = b"a,t\n" + b"0.1,0.2\n" * 3000
    convert = ["import", "@/a.csv", "@/b.mcap", "--angle", "a:rad", "--torque", "t:N.m"]
    convert += ["--rate-hz", "1000", "--profile"]
    for name, data in tomls.items():
        files = {"f.toml": data, "a.csv": record, "specimens/beam.toml": data}
        yield Case(f"profile of {name}", "rigd", ["check", "--profile", "@/f.toml"], files)
        yield Case(f"run of {name}", "rigd", [*run, "--profile", "@/f.toml"], files)
        yield Case(f"show of {name}", "rigd", ["profiles", "show", "@/f.toml"], files)
        yield Case(f"specimen of {name}", "rigd", ["specimens"], files)
        yield Case(f"import of {name}", "analyze", [*convert, "@/f.toml"], files)
    jsons = {
        "deep": lambda: b"[" * 200_000 + b"]" * 200_000,
        "deep objects": lambda: b'{"modes":' * 50_000 + b"1" + b"}" * 50_000,
        "long number": lambda: b'{"modes": ' + b"9" * 5000 + b"}",
        "many modes": lambda: b'{"modes": [' + b",".join(
            [b'{"frequency_hz": 2.6, "damping_ratio": 1}'] * 300_000
        ) + b"]}",
        "many keys": lambda: b"{" + b",".join(b'"k%d": 1' % i for i in range(500_000)) + b"}",
        "empty lists": lambda: b'{"modes": [' + b",".join([b"[]"] * 5_000_000) + b"]}",
        "long text": lambda: b'{"modes": "' + b"x" * 30_000_000 + b'"}',
        "large": lambda: b" " * 300_000_000,
        "surrogates": lambda: (
            b'{"modes": "\\ud800", "headlines": [{"file": "\\udfff", "parameters": 1}]}'
        ),
    }  # fmt: skip
    short = ["--profile", "sim", "--fast", "--no-look", "--output", "@/out"]
    for name, data in jsons.items():
        files = {"f.json": data}
        yield Case(f"modes of {name}", "rigd", ["run", "modes", "@/f.json", *short], files)
        move = ["run", "move", "0.05", "--model", "@/f.json"]
        yield Case(f"move of {name}", "rigd", [*move, *short], files)
        touch = ["run", "touch", "0.05", "--model", "@/f.json"]
        yield Case(f"touch of {name}", "rigd", [*touch, *short], files)
        touch = ["touch", str(ground.session), "--model", "@/f.json"]
        yield Case(f"analyze touch of {name}", "analyze", touch, files)
        start = ["start", "modes", "@/f.json", "--profile", str(ground.served)]
        yield Case(f"start of {name}", "rigd", start, files)
    texts = {
        "65 MB": lambda: b"0.001\n" * 11_000_000,
        "90 MB of times": lambda: b"time_s,angle_rad\n" + b"".join(
            b"%.3f,0.5010000000\n" % (i / 1000) for i in range(4_400_000)
        ),
        "many columns": (b"1," * 1_000_000 + b"\n") * 3,
        "a line without end": lambda: b"0" * 50_000_000,
        "quotes": lambda: b'angle_rad\n"' + b"0.1\n" * 5_000_000,
        "empty lines": lambda: b"angle_rad\n" + b"\n" * 50_000_000,
        "far times": lambda: b"time_s,angle_rad\n0,0\n1e308,0\n",
        "not finite": lambda: b"angle_rad\n0\nnan\n1e999\n",
        "long digits": lambda: b"angle_rad\n0\n" + b"9" * 200_000 + b"\n",
        "nul": lambda: b"\0" * 1_000_000,
        "huge angles": lambda: b"angle_rad\n0\n1e308\n",
    }  # fmt: skip
    for name, data in texts.items():
        files = {"f.csv": data}
        yield Case(f"file of {name}", "rigd", ["run", "file", "@/f.csv", *short], files)
        start = ["start", "file", "@/f.csv", "--profile", str(ground.served)]
        yield Case(f"start file of {name}", "rigd", start, files)
        command = ["import", "@/f.csv", "@/b.mcap", "--angle", "#1:rad", "--torque", "#1:N.m"]
        command += ["--rate-hz", "1000", "--profile", str(ground.served)]
        yield Case(f"import of text of {name}", "analyze", command, files)
    edss = {
        "many sections": lambda: b"".join(b"[%04X]\nParameterName=a\n" % i for i in range(60_000)),
        "many lines": lambda: b"[DeviceInfo]\n" + b"a=b\n" * 900_000,
        "one line": lambda: b"[DeviceInfo]\nVendorName=" + b"x" * 3_900_000,
        "large": lambda: b"x" * 50_000_000,
        "control": lambda: (
            b"[DeviceInfo]\nVendorName=\x1b[2J\n[1000]\nParameterName=\x1b[2J\nDataType=7\n"
        ),
        "compact": lambda: b"".join(
            b"[%04X]\nParameterName=a\nCompactSubObj=254\nDataType=7\n" % i
            for i in range(0x2000, 0x2100)
        ),
    }  # fmt: skip
    for name, data in edss.items():
        files = {"f.eds": data}
        new = ["profiles", "new", "--eds", "@/f.eds", "--output", "@/n.toml"]
        yield Case(f"new of eds of {name}", "rigd", new, files)
        check = ["check", "--profile", "antenna_can", "--eds", "@/f.eds"]
        yield Case(f"check of eds of {name}", "rigd", check, files)


def make_odd(path, kind):
    """Make an object that has a file's name and is no file of the expected kind."""
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as listener:
            listener.bind(str(path))
    elif kind == "loop":
        path.symlink_to(path)
    elif kind == "huge":
        with path.open("wb") as file:
            file.truncate(3_000_000_000)
    elif kind in ("empty", "binary", "nul"):
        path.write_bytes({"empty": b"", "binary": bytes(range(256)) * 4000, "nul": b"\0" * 9}[kind])


# Running


def write_files(files, folder):
    """Write files; return 0."""
    for name, data in files.items():
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(data() if callable(data) else data)
    return 0


def prepared(case, folder):
    """Make the files of a case; return its arguments with their paths."""
    if case.files:
        with (folder / "made").open("wb") as log:  # in a child, whose memory is freed with it
            code, _ = run_forked(lambda: write_files(case.files, folder), log.fileno())
        assert code == 0, (folder / "made").read_text()
    arguments = []
    for given in case.arguments:
        if given.startswith("@odd/"):
            name = given.removeprefix("@odd/")
            path = folder / name
            make_odd(path, name.partition(".")[0])
            arguments.append(str(path))
        else:
            arguments.append(given.replace("@/", f"{folder}/", 1))
    return arguments


def run_case(case):
    """Run a command line as its program does; return result and resources."""
    with tempfile.TemporaryDirectory(prefix="rigd-hostile-") as name:
        folder = Path(name)
        arguments = prepared(case, folder)

        def action():
            os.chdir(folder)
            os.environ["XDG_CONFIG_HOME"] = str(folder / "config")
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            sys.argv = [case.program, *arguments]
            if case.program == "analyze":
                from analysis.cli.app import main
            else:
                from rigd.cli.app import main
            main()
            return 0

        printed = folder / "printed.txt"
        with printed.open("wb") as output:
            interrupt_s = INTERRUPTED_AFTER_S if case.serves else None
            code, usage = run_forked(action, output.fileno(), interrupt_s)
        with printed.open("rb") as output:
            words = output.read(2 * MOST_PRINTED).decode(errors="replace")
            length = printed.stat().st_size
    if code == 130 and case.serves:
        code = 0
    if "Traceback" not in words:
        words = words[-2000:]
    return Outcome(
        case.name, case.program, code, usage.ru_maxrss / 1024, usage.ru_utime + usage.ru_stime,
        length, words,
    )  # fmt: skip


def warm_up():
    """Import the modules of the commands, so that the imports are not repeated in each child."""
    use_one_thread()
    for module in IMPORTED:
        importlib.import_module(module)


def all_cases(ground, seed=0, *, every=False):
    """Yield all cases; `every` value of each option and key instead of one."""
    yield from whole_file_cases(ground)
    yield from option_cases(ground, seed, every)
    yield from key_cases(seed, every)


def try_cases(ground, cases, report=lambda outcome: None):
    """Try cases in turn; return the complaints, with the daemon's growth."""
    wrong = []
    before = ground.daemon_megabytes()
    for case in cases:
        if "start" in case.arguments:
            ground.wait_until_ready()
        outcome = run_case(case)
        report(outcome)
        if outcome.wrong():
            wrong.append(outcome.wrong())
    held, most = ground.daemon_megabytes()
    if most > MOST_MEGABYTES or held > before[0] + MOST_GROWTH_MEGABYTES:
        wrong.append(f"the daemon: {before[0]:.0f} MB before, {held:.0f} after, {most:.0f} at most")
    return wrong


@contextlib.contextmanager
def ground_with_daemon():
    """Yield files and daemon for the commands, and remove them."""
    with tempfile.TemporaryDirectory(prefix="rigd-ground-") as name:
        runtime = Path(name) / "runtime"
        runtime.mkdir(mode=0o700)
        os.environ |= {"XDG_RUNTIME_DIR": str(runtime), "XDG_CACHE_HOME": str(runtime)}
        ground = Ground(name)
        ground.make()
        ground.start_daemon()
        try:
            yield ground
        finally:
            ground.stop_daemon()


def main():
    """Try all cases, and print the worst and the complaints."""
    parser = argparse.ArgumentParser(description=__doc__.partition(":")[0])
    parser.add_argument("--seed", type=int, default=0, help="turns the values of the options")
    parser.add_argument("--word", default="", help="only cases whose names match this expression")
    parser.add_argument("--every", action="store_true", help="every value of each option and key")
    parser.add_argument("--verbose", action="store_true", help="name each case")
    parsed = parser.parse_args()
    worst: dict[str, Outcome] = {}
    count = 0

    def report(outcome):
        nonlocal count
        count += 1
        if parsed.verbose:
            last = outcome.words.strip().splitlines()[-1:] or [""]
            sys.stdout.write(
                f"{outcome.code} {outcome.megabytes:4.0f} MB {outcome.seconds:5.1f} s "
                f"{outcome.printed:7} {outcome.case} | {last[0][:150]}\n"
            )
        for what in ("megabytes", "seconds", "printed"):
            known = worst.get(what)
            if known is None or getattr(outcome, what) > getattr(known, what):
                worst[what] = outcome

    warm_up()
    with ground_with_daemon() as ground:
        cases = all_cases(ground, parsed.seed, every=parsed.every)
        wrong = try_cases(
            ground, (case for case in cases if re.search(parsed.word, case.name)), report
        )
        held, most = ground.daemon_megabytes()
    for what, outcome in worst.items():
        sys.stdout.write(f"most {what:10} {getattr(outcome, what):10.1f}  {outcome.case}\n")
    sys.stdout.write("".join(f"WRONG {each}\n" for each in wrong))
    sys.stdout.write(f"daemon: {held:.0f} MB at the end, {most:.0f} MB at most\n")
    sys.stdout.write(f"{count} cases, seed {parsed.seed}: {len(wrong)} wrong\n")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
