"""In a fresh checkout the workers divide the rewriting of the tests' assertions.

Each of them would rewrite every file otherwise, at the same time as the others: 10 s of a processor
each. pytest itself stores the result next to the tests, and all read it.
"""

import contextlib
import sys
from pathlib import Path

import pytest


@pytest.hookimpl(tryfirst=True)
def pytest_collection(session: pytest.Session) -> None:
    worker = getattr(session.config, "workerinput", None)
    if worker is None or sys.dont_write_bytecode:
        return
    files = sorted(Path(__file__).parents[1].rglob("test_*.py"))
    own_files = files[int(worker["workerid"].removeprefix("gw")) :: worker["workercount"]]
    # Nothing of it is public; with a pytest that has it otherwise, each rewrites all as before.
    with contextlib.suppress(ImportError, AttributeError, TypeError, ValueError, OSError):
        from _pytest.assertion import rewrite

        state = session.config.stash[rewrite.assertstate_key]
        for path in own_files:
            cached = rewrite.get_cache_dir(path) / f"{path.stem}{rewrite.PYC_TAIL}"
            if rewrite._read_pyc(path, cached) is None and rewrite.try_makedirs(cached.parent):
                source, code = rewrite._rewrite_test(path, session.config)
                rewrite._write_pyc(state, code, source, cached)
