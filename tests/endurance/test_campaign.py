"""A short campaign as of ``run_campaign.py``, and its detection of growth."""

import gc
import importlib.util
import os
import random
import sys
from pathlib import Path

import pytest
from shipped_profile import load_shipped

from rigd.engine.workers import CONTROL
from rigd.excitation import hold
from rigd.runner import ProcessGroup, Rig
from rigd.runner.request import SessionOrder
from rigd.runtime import StopRequest

pytestmark = pytest.mark.fit

COARSE_KB = 4096


@pytest.fixture(scope="module")
def campaign():
    spec = importlib.util.spec_from_file_location(
        "run_campaign", Path(__file__).with_name("run_campaign.py")
    )
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


@pytest.mark.process
@pytest.mark.further  # at length
def test_sessions_on_one_connection_leave_no_memory_and_descriptors(campaign, tmp_path):
    profile = load_shipped("sim")
    excitation = hold(rate_hz=profile.rig.rate_hz, duration_s=1.0, rest_s=0.2, ring_down_s=0.0)
    group = ProcessGroup(with_live_view=False)
    control = group[CONTROL].pid
    rig = Rig(profile, uses_virtual_clock=True, group=group)
    usages = []
    gc.collect()  # garbage of other tests in this process, which would be freed during the test
    try:
        rig.connect()
        for number in range(6):
            path = tmp_path / f"{number}.mcap"
            rig.run(SessionOrder(profile, excitation, path), StopRequest(), lambda *_: None)
            assert campaign.check(path) == (1200, "")
            usages.append([campaign.ProcessUsage.at(pid) for pid in (os.getpid(), control)])
    finally:
        rig.disconnect()
    for warm, last in zip(usages[1], usages[-1], strict=True):
        assert last.descriptors <= warm.descriptors
        assert last.shared_kb <= warm.shared_kb
        assert last.private_kb - warm.private_kb < COARSE_KB
    assert not list(tmp_path.glob("*.part"))


def test_slow_leak_is_distinguished_from_noise(campaign):
    chooser = random.Random(1)
    noise = [30_000 + round(chooser.gauss(0.0, 2_000.0)) for _ in range(300)]
    leaking = [value + 20 * number for number, value in enumerate(noise)]
    converging = [30_000 - 15_000 // (1 + number) for number in range(300)]
    assert not campaign.Trend.of(noise).grows(300, campaign.FLAT_KB)
    assert not campaign.Trend.of(converging).grows(300, campaign.FLAT_KB)
    trend = campaign.Trend.of(leaking)
    assert trend.grows(300, campaign.FLAT_KB)
    assert trend.slope == pytest.approx(20.0, abs=5.0)
    descriptors = [16 + chooser.randrange(3) for _ in range(300)]
    one_in_a_hundred = [value + number // 100 for number, value in enumerate(descriptors)]
    assert not campaign.Trend.of(descriptors).grows(300, campaign.FLAT_DESCRIPTORS)
    assert campaign.Trend.of(one_in_a_hundred).grows(300, campaign.FLAT_DESCRIPTORS)
