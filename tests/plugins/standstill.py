"""A test that fails during a standstill of the machine is run once more and reported.

A virtual machine may get no processor for tenths of a second: a measurement made meanwhile is no
measurement. The tests are written to tolerate it; this is for the unforeseen rest. What fails on a
machine that does not stand still, or fails again, has failed.
"""

import threading
import time

import pytest
from _pytest.runner import runtestprotocol

_PERIOD_S = 0.02
_STANDSTILL_S = 0.1


class StandstillWatch:
    """How late a thread that does nothing is woken at worst, while this context is entered."""

    def __init__(self) -> None:
        self.longest_s = 0.0
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> "StandstillWatch":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()

    def _watch(self) -> None:
        before = time.monotonic()
        while not self._end.wait(_PERIOD_S):
            now = time.monotonic()
            self.longest_s = max(self.longest_s, now - before - _PERIOD_S)
            before = now


def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool:
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    with StandstillWatch() as watch:
        reports = runtestprotocol(item, nextitem=nextitem, log=False)
    failures = [report for report in reports if report.failed]
    if failures and watch.longest_s > _STANDSTILL_S:
        for report in failures:
            report.outcome = "repeated"
            report.standstill_s = watch.longest_s
            item.ihook.pytest_runtest_logreport(report=report)
        reports = runtestprotocol(item, nextitem=nextitem, log=False)
    for report in reports:
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


def pytest_report_teststatus(report: pytest.TestReport) -> tuple | None:
    if report.outcome == "repeated":
        return "repeated", "R", ("REPEATED", {"yellow": True})
    return None


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    for report in terminalreporter.stats.get("repeated", []):
        terminalreporter.section(f"REPEATED {report.nodeid}", yellow=True)
        terminalreporter.line(f"The machine stood still for {report.standstill_s:.2f} s.")
        terminalreporter.line(report.longreprtext)
