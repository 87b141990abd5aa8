import multiprocessing
import os
import sys
import time

import pytest

from analysis.campaigns import CampaignError
from analysis.campaigns.workers import dask_cluster, process_pool, run_all


def test_results_come_in_order_and_progress_as_they_are_done(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    seen = []
    with process_pool(1) as pool:
        threads = run_all(pool, os.getenv, [("OMP_NUM_THREADS",), ("OPENBLAS_NUM_THREADS",)])
        found = run_all(pool, divmod, [(7, 2), (9, 4), (1, 1)], seen.append)
    assert threads == ["1", "1"]
    assert found == [(3, 1), (2, 1), (1, 0)]
    assert sorted(seen) == [0, 1, 2]
    assert os.environ["OMP_NUM_THREADS"] == "7"


def test_a_worker_that_dies_is_told():
    with process_pool(1) as pool, pytest.raises(CampaignError, match="worker process ended") as it:
        run_all(pool, os._exit, [(3,)])
    assert "--jobs" in str(it.value)


def test_work_under_way_is_dropped_when_the_operator_stops():
    begun = time.monotonic()
    with pytest.raises(KeyboardInterrupt), process_pool(1) as pool:
        pool.submit(time.sleep, 0.0).result()
        pool.submit(time.sleep, 60.0)
        raise KeyboardInterrupt
    while multiprocessing.active_children():
        assert time.monotonic() - begun < 30.0, "a worker goes on"
        time.sleep(0.01)


def test_without_dask_it_is_said_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(CampaignError, match=r"pip install 'rigd\[dask\]'"), dask_cluster("tcp://x"):
        pass


def test_the_same_on_a_dask_cluster():
    distributed = pytest.importorskip("distributed", reason="the extra `dask` is not installed")
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None
        ) as cluster,
        dask_cluster(cluster.scheduler_address) as executor,
    ):
        assert run_all(executor, pow, [(2, n) for n in range(9)]) == [2**n for n in range(9)]
        # Each call counts, though the arguments are the same.
        first, second = run_all(executor, time.monotonic_ns, [(), ()])
        assert first != second


def test_a_dask_scheduler_that_is_not_there_is_told(monkeypatch):
    pytest.importorskip("distributed", reason="the extra `dask` is not installed")
    monkeypatch.setattr("analysis.campaigns.workers._CONNECT_S", 0.3)
    with (
        pytest.raises(CampaignError, match=r"No Dask scheduler answers at tcp://127\.0\.0\.1:9"),
        dask_cluster("tcp://127.0.0.1:9"),
    ):
        pass
