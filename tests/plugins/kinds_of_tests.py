"""Which tests start processes, and which fit models: by names in their code and their fixtures'.

`make test-fast` leaves both out. What a test calls is looked at as far as it stands in the same
file; a fixture counts for all that use it.
"""

import inspect
from collections.abc import Callable, Iterator
from types import CodeType, FunctionType, ModuleType

import pytest

STARTS = {
    "subprocess", "fork", "Rig", "ProcessGroup", "Child", "run_in_foreground", "run_session",
    "run_alone", "process_pool", "LocalCluster", "Scene", "play", "busy", "attend",
    "QuickLooks", "PageProcess", "play_left_on",
}  # fmt: skip
"""Names by which processes are started, or all that one does is run in the test's."""
FITS = {
    "select", "fit_record", "fit_frf", "analyse", "analyse_session", "campaign", "CandidateSet",
    "Refit", "Comparison", "identify", "estimate_motor", "analyze_here", "judged",
    "make_quick_look", "fit_many",
}  # fmt: skip
"""Names by which models are fitted."""


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "process: starts processes (set by plugins/kinds_of_tests)")
    config.addinivalue_line("markers", "fit: fits models (set by plugins/kinds_of_tests)")
    config.addinivalue_line("markers", "browser: drives a browser (set by plugins/kinds_of_tests)")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    known: dict[object, frozenset[str]] = {}
    for item in items:
        assert isinstance(item, pytest.Function)
        fixtures = item._fixtureinfo.name2fixturedefs
        if "browser" in fixtures:
            item.add_marker("browser")
        functions = [item.obj, *(each.func for defs in fixtures.values() for each in defs)]
        names = frozenset(fixtures).union(*(names_in(each, known) for each in functions))
        for mark, telling in (("process", STARTS), ("fit", FITS)):
            if names & telling:
                item.add_marker(mark)


def names_in(function: Callable, known: dict[object, frozenset[str]]) -> frozenset[str]:
    """Names of globals and attributes in a function and in what it calls of the same file."""
    function = inspect.unwrap(getattr(function, "__func__", function))
    code = getattr(function, "__code__", None)
    if code is None:
        return frozenset()
    if function not in known:
        known[function] = frozenset()  # for those that call each other
        names = set(code_names(code))
        values = function.__globals__
        names -= {  # such as `select`, which is another thing in `analysis`
            name for name in names - STARTS if isinstance(values.get(name), ModuleType)
        }
        for name in tuple(names):
            for called in functions_of(values.get(name), function.__module__):
                names |= names_in(called, known)
        known[function] = frozenset(names)
    return known[function]


def code_names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from code_names(constant)


def functions_of(value: object, module: str) -> list[Callable]:
    """A function of a module, or the methods of a class of it."""
    if getattr(value, "__module__", None) != module:
        return []
    if isinstance(value, FunctionType):
        return [value]
    if inspect.isclass(value):
        return [each for each in vars(value).values() if isinstance(each, FunctionType)]
    return []
