"""Campaigns on a Dask cluster of this machine: in this process, and once as processes."""

import re
import sys
import threading
import time
from pathlib import Path

import pytest

from analysis.campaigns import CampaignError, campaign
from analysis.campaigns import workers as dask_workers
from analysis.campaigns.workers import FailedTask, dask_cluster, package_versions

ONE_DEATH_IS_ENOUGH = {"distributed.scheduler.allowed-failures": 0}


@pytest.fixture(scope="module")
def cluster():
    """Scheduler and one worker with two threads, in this process."""
    import distributed  # here, as half a second for every worker is spared

    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, dashboard_address=":0"
    ) as made:
        yield made


@pytest.mark.process
def test_results_come_in_order_and_each_call_counts(cluster):
    seen = []
    with dask_cluster(cluster.scheduler_address) as workers:
        assert workers.run(pow, [(2, n) for n in range(9)], seen.append) == [2**n for n in range(9)]
        first, second = workers.run(time.monotonic_ns, [(), ()])
    assert first != second
    assert sorted(seen) == list(range(9))


@pytest.mark.process
def test_an_error_of_a_task_is_none_of_the_cluster(cluster):
    with dask_cluster(cluster.scheduler_address) as workers, pytest.raises(ZeroDivisionError):
        workers.run(divmod, [(1, 0)])


@pytest.mark.fit
@pytest.mark.process
def test_campaign_agrees_with_a_local_one(cluster, short_sessions, settings, monkeypatch):
    """From another folder than the workers', by relative paths."""
    monkeypatch.chdir(short_sessions[0].parent)
    paths = [Path(path.name) for path in short_sessions[:2]]
    there = campaign(paths, settings, structures=(), dask_address=cluster.scheduler_address)
    here = campaign(paths, settings, structures=(), jobs=1)
    assert [each.path for each in there.sessions] == short_sessions[:2]
    for one, two in zip(there.statistics, here.statistics, strict=True):
        assert one.mean == pytest.approx(two.mean, rel=1e-9)


class Elsewhere:
    """A client whose one worker reports these versions."""

    def __init__(self, reported):
        self.reported = reported

    def wait_for_workers(self, *_, **__):
        pass

    def run(self, *_, **__):
        return {"tcp://10.0.0.7:1": self.reported}


@pytest.mark.parametrize(
    ("reported", "words"),
    [
        (
            package_versions() | {"rigd": "9.9"},
            f"7:1 has rigd 9.9 and not {package_versions()['rigd']}: install",
        ),
        (ModuleNotFoundError("no", name="analysis"), "7:1 has no module analysis: install rigd"),
        (OSError("no"), "7:1 cannot be used: no"),
    ],
)
def test_worker_of_other_versions_is_reported(reported, words):
    with pytest.raises(CampaignError, match=re.escape(words)):
        dask_workers._check_workers(Elsewhere(reported), "tcp://10.0.0.5:8786")
    dask_workers._check_workers(Elsewhere(package_versions()), "tcp://10.0.0.5:8786")


@pytest.mark.process
def test_cluster_without_workers_is_reported(monkeypatch):
    import distributed

    monkeypatch.setattr(dask_workers, "_FIRST_WORKER_TIMEOUT_S", 0.5)
    with (
        distributed.LocalCluster(n_workers=0, processes=False, dashboard_address=":0") as empty,
        pytest.raises(CampaignError, match="has no workers; start some with 'dask worker"),
        dask_cluster(empty.scheduler_address),
    ):
        pass


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "127.0.0.1:9", "nobody", "tcp://[::1]:9"])
def test_missing_scheduler_is_reported(address):
    with (
        pytest.raises(CampaignError, match=rf"No Dask scheduler answers at {re.escape(address)}"),
        dask_cluster(address),
    ):
        pass


def test_missing_dask_is_reported_with_its_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(CampaignError, match=r"pip install 'rigd\[dask\]'"), dask_cluster("tcp://x"):
        pass


@pytest.mark.process
@pytest.mark.further  # as test_workers.py
def test_lost_worker_loses_one_task_only():
    import dask
    import distributed

    with (
        dask.config.set(ONE_DEATH_IS_ENOUGH),
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, processes=True, dashboard_address=":0"
        ) as processes,
        dask_cluster(processes.scheduler_address) as workers,
    ):
        one, lost, two = workers.run(eval, [("1",), ("__import__('os')._exit(1)",), ("2",)])
    assert isinstance(lost, FailedTask)
    assert (one, two) == (1, 2)


GONE = threading.Event()


def until_it_is_gone(number):
    """End when the scheduler has gone, but for the first, which lets it go."""
    assert number == 0 or GONE.wait(300.0)


@pytest.mark.process
def test_lost_scheduler_is_reported():
    import distributed

    GONE.clear()
    processes = distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=":0"
    )

    def close(_done):
        # A closing worker finishes its task, and begins no other.
        threading.Timer(1.0, GONE.set).start()
        processes.close()

    with (
        processes,
        pytest.raises(CampaignError, match="went away; check its log"),
        dask_cluster(processes.scheduler_address) as workers,
    ):
        workers.run(until_it_is_gone, [(0,), (1,), (2,)], close)
