"""Documents name files and commands that exist, and their links lead somewhere."""

import inspect
import json
import re
import shlex
from pathlib import Path

import pytest
import typer

from analysis.cli.app import app as analyze_app
from rigd.cli import run
from rigd.cli.app import app as rigd_app
from rigd.profile import load_profile
from rigd.runner.planning import excitation_for, predict_session

PROJECT = Path(__file__).parents[2]
DOCUMENTS = sorted(
    [PROJECT / "README.md", PROJECT / "CONTRIBUTING.md", *(PROJECT / "docs").rglob("*.md")]
)
TO_BE_MADE = re.compile(r"NAME|sessions/")
"""Files that a reader is to make."""


def anchors(path):
    """Anchors of a document's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", path.read_text("utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", each.lower()).replace(" ", "-") for each in headings}


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(PROJECT)))
def test_links_are_valid(path):
    for target in re.findall(r"\]\(([^)\s]+)\)", path.read_text("utf-8")):
        if re.match(r"https?:", target):
            continue
        file, _, anchor = target.partition("#")
        found = (path.parent / file) if file else path
        assert found.exists(), target
        if anchor:
            assert anchor in anchors(found), target


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(PROJECT)))
def test_named_files_of_the_project_exist(path):
    named = re.findall(
        r"`((?:rigd|analysis|tests|benchmarks|examples|hw_profiles)/[\w/.]*)`",
        path.read_text("utf-8"),
    )
    for name in named:
        assert TO_BE_MADE.search(name) or (PROJECT / name).exists(), name


def shell_lines(path):
    """Lines for a shell in a document; those that continue are joined."""
    text = path.read_text("utf-8").replace("\\\n", " ")
    blocks = re.findall(r"^```(\w*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    for language, block in blocks:
        for line in block.splitlines():
            # Other blocks have commands that a test does not run (console), output and drawings.
            if language in ("sh", "bash") or re.match(r"(rigd|analyze) (?!.*[─│])", line):
                yield line


def commands(line):
    """Commands of ours in a line for a shell, as words; one inside another's text is a word."""
    line = re.sub(r"\$\([^)]*\)", "x", line)
    lexer = shlex.shlex(line, posix=True, punctuation_chars="();<>|&")
    lexer.whitespace_split = True
    found = [[]]
    for word in lexer:
        if set(word) <= set("();<>|&"):
            found.append([])
        else:
            found[-1].append(word)
    for words in found:
        while words and words[0] in BEFORE_A_COMMAND:
            del words[0]
        if words and words[0] in PROGRAMS:
            yield words[0], words[1:]


def parse(command, words, name):
    """Parse a command's words as the program does, down to the last of its subcommands."""
    context = command.make_context(name, list(words))
    rest = [*getattr(context, "_protected_args", ()), *context.args]
    if rest and hasattr(context.command, "resolve_command"):
        name, command, words = context.command.resolve_command(context, rest)
        parse(command, words, name)


BEFORE_A_COMMAND = {"do", "if", "sudo", "then", "until", "while"}
PROGRAMS = {
    "rigd": typer.main.get_command(rigd_app),
    "analyze": typer.main.get_command(analyze_app),
}


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(PROJECT)))
def test_commands_and_options_exist(path):
    """Commands run as written elsewhere; here they only have to be parsed."""
    for line in shell_lines(path):
        for program, words in commands(line):
            try:
                parse(PROGRAMS[program], words, program)
            except Exception as error:
                raise AssertionError(f"{line}: {error}") from error


def sessions_of(path):
    """Excitation, its parameters and options of each ``rigd run`` and ``start`` of a document."""
    for line in shell_lines(path):
        for program, words in commands(line):
            if program == "rigd" and words[:1] in (["run"], ["start"]) and len(words) > 1:
                kind, *options = words[1:]
                group = PROGRAMS["rigd"].commands[words[0]]
                given = group.commands[kind].make_context(kind, options).params
                function = getattr(run, kind)
                own = {name: given[name] for name in inspect.signature(function).parameters}
                parameters = {k: v for k, v in function(**own).items() if v is not None}
                yield line, kind, parameters, given


EVERY_SESSION = [each for path in DOCUMENTS for each in sessions_of(path)]
FILES = {
    "file": "time_s,angle_rad\n0,0\n2,0.02\n4,0\n",
    "modes": json.dumps({"modes": [
        {"file": "a", "estimator": "record", "frequency_hz": hz, "damping_ratio": ratio}
        for hz, ratio in ((2.57, 0.0091), (16.01, 0.00415), (44.81, 0.00995))
    ]}),
}  # fmt: skip
"""Files that an excitation reads: of docs/run_sessions.md, and of a first analysis."""


IDENTIFICATIONS = {
    (kind, repr(parameters)): (line, kind, parameters)
    for line, kind, parameters, given in EVERY_SESSION
    if kind not in ("move", "touch") and given["tip_slope_rad"] is None
}
"""Line, excitation and its parameters, each once."""


def test_every_kind_of_identification_is_shown():
    kinds = {kind for _, kind, *_ in EVERY_SESSION}
    assert {"chirp", "step", "multisine", "hold", "file", "modes", "until"} <= kinds
    assert len(EVERY_SESSION) > 20


@pytest.mark.parametrize(
    ("kind", "parameters"),
    [
        pytest.param(kind, parameters, id=re.sub(r"[^\w .-]", "", line)[:60])
        for line, kind, parameters in IDENTIFICATIONS.values()
    ],
)
def test_identifications_stay_within_the_tip_slope(kind, parameters, tmp_path):
    """As every default does; the reference paper's chirp alone is beyond it, and states so."""
    if kind in FILES:
        parameters = parameters | {"path": tmp_path / "file"}
        parameters["path"].write_text(FILES[kind])
    profile = load_profile("sim")
    plan = predict_session(profile, excitation_for(profile, kind, parameters))
    assert not plan.refusal_text
    slope_rad = plan.prediction.tip.slope_rad
    if kind == "chirp" and slope_rad > profile.limits.tip_slope_rad:
        assert slope_rad < 0.61
        assert "is not refused for it" in plan.tip_in_words
    else:
        assert slope_rad <= profile.limits.tip_slope_rad
