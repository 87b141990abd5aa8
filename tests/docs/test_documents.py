"""Documents name files and commands that exist, and their links lead somewhere."""

import re
import shlex
from pathlib import Path

import pytest
import typer

from analysis.cli.app import app as analyze_app
from rigd.cli.app import app as rigd_app

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
def test_links_lead_somewhere(path):
    for target in re.findall(r"\]\(([^)\s]+)\)", path.read_text("utf-8")):
        if re.match(r"https?:", target):
            continue
        file, _, anchor = target.partition("#")
        found = (path.parent / file) if file else path
        assert found.exists(), target
        if anchor:
            assert anchor in anchors(found), target


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(PROJECT)))
def test_files_of_the_project_that_are_named_exist(path):
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
            # Without a language stand commands that a test does not run, and drawings.
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
def test_commands_and_options_are_those_of_the_programs(path):
    """What is run as written elsewhere; here it only has to be understood."""
    for line in shell_lines(path):
        for program, words in commands(line):
            try:
                parse(PROGRAMS[program], words, program)
            except Exception as error:
                raise AssertionError(f"{line}: {error}") from error
