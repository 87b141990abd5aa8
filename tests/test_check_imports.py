"""The check of imports finds circles of every kind with file and line, and nothing else."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.process

CHECK = Path(__file__).parents[1] / ".ci" / "check_imports.py"


@pytest.fixture
def offences(tmp_path):
    """Check a tree of these files of `rigd`; returns the lines printed, and the exit code."""

    def found(files):
        for name, text in files.items():
            path = tmp_path / "rigd" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        done = subprocess.run(
            [sys.executable, CHECK, tmp_path], capture_output=True, text=True, check=False
        )
        return done.stdout.splitlines(), done.returncode

    return found


@pytest.mark.parametrize(
    "hidden",
    ["if TYPE_CHECKING:\n    from rigd.a import A\n", "def f():\n    import rigd.a\n"],
    ids=["type", "function"],
)
def test_circles_of_hidden_imports_are_found(offences, hidden):
    assert offences({"a.py": "from rigd import b\n", "b.py": hidden, "c.py": "import rigd.a"}) == (
        ["rigd/a.py:1: rigd.b leads back to rigd.a", "rigd/b.py:2: rigd.a leads back to rigd.b"],
        1,
    )


def test_a_public_name_is_an_import_of_the_module_that_defines_it(offences):
    package = {
        "p/__init__.py": "",
        "p/__init__.pyi": "from ._one import One as One\nfrom ._two import Two as Two\n",
        "p/_one.py": "from rigd.q import Q\n",
        "p/_two.py": "",
    }
    assert offences(package | {"q.py": "from rigd.p import Two\n"}) == ([], 0)
    lines, code = offences({"q.py": "from rigd.p import One\n"})
    assert code == 1
    assert lines == [
        "rigd/p/_one.py:1: rigd.q leads back to rigd.p._one",
        "rigd/q.py:1: rigd.p._one leads back to rigd.q",
    ]
