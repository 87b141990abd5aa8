"""Absurd values, on the command line and in files: refused in a sentence or two."""

import re
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def options(load_script):
    load_script("fuzz_hostile")  # which the other imports by its name
    return load_script("fuzz_options")


def test_every_option_of_every_command_has_a_case(options, tmp_path):
    ground = options.Ground(tmp_path)
    names = [case.name for case in options.option_cases(ground, 0, every=False)]
    for words, parameters in options.commands():
        for parameter, _ in parameters:
            is_option = parameter.param_type_name == "option"
            label = parameter.opts[-1] if is_option else parameter.name
            shared = f"{' '.join(words[:2])}( \\w+)? {label} "
            assert any(re.match(shared, name) for name in names), (words, label)
    assert len(names) > 300


HOSTILE = (
    ("rigd", "profile of deep arrays", 2),
    ("rigd", "profile of long number", 2),
    ("rigd", "profile of tables as many as there may be", 2),
    ("rigd", "show of escaped control", 2),
    ("rigd", "specimen of unknown keys", 0),
    ("rigd", "modes of deep objects", 2),
    ("rigd", "modes of surrogates", 2),
    ("rigd", "file of far times", 2),
    ("rigd", "file of a line without end", 2),
    ("rigd", "new of eds of control", 1),
    ("analyze", "import of deep header", 1),
    ("analyze", "import of text of nul", 1),
)


@pytest.mark.fit
@pytest.mark.parametrize(("program", "name", "code"), HOSTILE, ids=[name for _, name, _ in HOSTILE])
def test_a_hostile_file_is_refused_in_few_words(
    options, tmp_path, rigd_here, analyze_here, program, name, code
):
    case = next(c for c in options.whole_file_cases(options.Ground(tmp_path)) if c.name == name)
    arguments = options.prepared(case, tmp_path)
    done = (rigd_here if program == "rigd" else analyze_here)(*arguments)
    assert done.returncode == code, done.stderr
    assert len(done.stdout + done.stderr) < 100_000
    assert "Traceback" not in done.stderr
    assert (done.stdout + done.stderr).replace("\n", "").isprintable()


@pytest.mark.parametrize(
    "arguments",
    [
        ("run", "until", "--at-most", "1e300"),
        ("run", "chirp", "--amplitude", "5e-324"),
        ("run", "multisine", "--period", "1e308"),
        ("run", "hold", "--duration", "9" * 400),
        ("run", "step", "--amplitude", "nan"),
        ("bench", "--seconds", "inf"),
        ("check", "--profile", "x" * 1_000_000),
    ],
    ids=lambda words: " ".join(words)[:40],
)
def test_a_hostile_value_is_refused_in_few_words(rigd_here, arguments):
    profile = () if "--profile" in arguments else ("--profile", "sim")
    done = rigd_here(*arguments, *profile, *(("--fast",) if arguments[0] == "run" else ()))
    assert done.returncode == 2, done.stderr
    assert len(done.stderr) < 3000
    assert done.stderr.replace("\n", "").isprintable()


@pytest.mark.fit
@pytest.mark.parametrize("value", ["0,1e308", "nan,nan", "1e308,0", "0," + "9" * 5000])
def test_a_hostile_interval_of_an_import(analyze_here, options, tmp_path, value):
    ground = options.Ground(tmp_path)
    ground.record.write_text("a,t\n" + "0.1,0.2\n" * 10)
    channels = ("--angle", "a:rad", "--torque", "t:N.m", "--profile", "sim.toml")
    done = analyze_here(
        "import", str(ground.record), "b.mcap", *channels, "--rate-hz", "1000", "--sweep", value
    )
    assert done.returncode == 2
    assert "--sweep" in done.stderr
    assert len(done.stderr) < 3000


@pytest.mark.process
@pytest.mark.slow  # half an hour: every case with its resources
def test_all_cases(options):
    done = subprocess.run(
        [sys.executable, str(Path(options.__file__))], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout[-20_000:]
