"""The table of workers, and the modules and messages in it."""

import pkgutil
import re
from importlib.util import find_spec
from pathlib import Path

import pytest

from rigd.engine import messages
from rigd.engine.workers import ONLINE_ESTIMATOR, PROCESSES, SUPERVISOR, WORKERS
from rigd.live.address import LiveAddress
from rigd.live.messages import LiveSessionShown

ARCHITECTURE = Path(__file__).parents[2] / "docs" / "architecture.md"


@pytest.mark.parametrize(
    "worker", [each for each in WORKERS if each is not SUPERVISOR], ids=lambda worker: worker.name
)
def test_module_and_messages_of_each_row_exist(worker):
    assert find_spec(worker.module)
    elsewhere = {each.__name__ for each in (LiveAddress, LiveSessionShown)}
    assert all(hasattr(messages, name) or name in elsewhere for name in worker.sent_messages)


def test_the_estimator_of_the_fit_exists():
    assert pkgutil.resolve_name(ONLINE_ESTIMATOR).estimate


def test_each_process_of_a_rig_is_described():
    rows = re.findall(r"^\| (\w+) \|", ARCHITECTURE.read_text(), re.MULTILINE)
    assert len({each.name for each in WORKERS}) == len(WORKERS)
    assert all(each.name in rows for each in PROCESSES)
