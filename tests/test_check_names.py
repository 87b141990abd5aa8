"""The check of names finds each kind of offence with its file and line, and nothing else."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.process

CHECK = Path(__file__).parents[1] / ".ci" / "check_names.py"


@pytest.fixture
def offences(tmp_path):
    """Check a tree of these files; returns the lines printed, and the exit code."""

    def found(**files):
        for name, text in files.items():
            path = tmp_path / name.replace("__", "/") / "module.py"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        done = subprocess.run(
            [sys.executable, CHECK, tmp_path], capture_output=True, text=True, check=False
        )
        return done.stdout.splitlines(), done.returncode

    return found


def test_words_are_found_in_identifiers_and_docstrings(offences):
    text = (
        '''"""Return the share.\n\nAs told."""\n\ntold_s = 1  # told\nTOLD = {"told": "told"}\n'''
    )
    assert offences(rigd__a=text) == (
        [
            "rigd/a/module.py:5: told_s: told",
            "rigd/a/module.py:6: TOLD: told",
            "rigd/a/module.py:1: docstring: share",
            "rigd/a/module.py:3: docstring: told",
        ],
        1,
    )


def test_benchmarks_and_their_tests_are_checked(offences):
    lines, code = offences(benchmarks="told = 1\n", tests__benchmarks="share = 1\n")
    assert code == 1
    assert lines == [
        "benchmarks/module.py:1: told: told",
        "tests/benchmarks/module.py:1: share: share",
    ]


def test_terms_of_the_field_are_allowed(offences):
    text = '"""Write a quick look with two decimal places."""\n\nQuickLook = quick_looks = 1\n'
    assert offences(rigd=text, analysis=text) == ([], 0)


def test_a_class_name_that_is_defined_twice_is_found(offences):
    lines, code = offences(rigd="class Row: ...\n", analysis__b="\nclass Row: ...\nclass A: ...\n")
    assert code == 1
    assert lines == [
        "rigd/module.py:1: class Row is defined 2 times",
        "analysis/b/module.py:2: class Row is defined 2 times",
    ]


@pytest.mark.parametrize(("count", "code"), [(10, 0), (1000, 1)])
def test_private_imports_in_tests_are_counted(offences, count, code):
    private = "from rigd._a import b\n" + "from rigd.a import _c, d\n" * count
    lines, found = offences(tests=private + "import rigd.a\nfrom os import _exit\n")
    assert found == code
    assert len(lines) == (count + 2 if code else 0)
    assert lines[:1] == ["tests/module.py:1: private import of rigd._a"][: len(lines)]
