import multiprocessing
import os
import time

import pytest
from cases import further
from ended_workers import end_at_zero

from analysis.campaigns import CampaignError
from analysis.campaigns.workers import FailedTask, process_pool

pytestmark = pytest.mark.process


def test_results_come_in_order_and_progress_as_they_are_done(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    seen = []
    with process_pool(1) as pool:
        threads = pool.run(os.getenv, [("OMP_NUM_THREADS",), ("OPENBLAS_NUM_THREADS",)])
        found = pool.run(divmod, [(7, 2), (9, 4), (1, 1)], seen.append)
    assert threads == ["1", "1"]
    assert found == [(3, 1), (2, 1), (1, 0)]
    assert sorted(seen) == [0, 1, 2]
    assert os.environ["OMP_NUM_THREADS"] == "7"


def test_dead_worker_is_reported():
    with (
        process_pool(1) as pool,
        pytest.raises(CampaignError, match="worker processes ended") as it,
    ):
        pool.run(os._exit, [(3,)])
    assert "--jobs" in str(it.value)


def test_dead_worker_loses_one_task_only():
    with process_pool(2) as pool:
        found = pool.run(end_at_zero, [(n,) for n in (5, 4, 3, 0, 2, 1)])
    (lost,) = (each for each in found if isinstance(each, FailedTask))
    assert found == [5, 4, 3, lost, 2, 1]
    assert lost.reason.startswith("its worker process ended by itself twice")
    assert "memory" in lost.reason


@pytest.mark.parametrize("jobs", [1, further(2)])
def test_first_task_may_be_the_lost_one(jobs):
    with process_pool(jobs) as pool:
        lost, *others = pool.run(end_at_zero, [(n,) for n in (0, 1, 2)])
    assert isinstance(lost, FailedTask)
    assert others == [1, 2]


@pytest.mark.further  # as one that dies after others are done
def test_second_death_before_any_result_ends_all():
    with process_pool(1) as pool, pytest.raises(CampaignError, match="worker processes ended"):
        pool.run(end_at_zero, [(0,), (0,), (1,)])


def test_idle_worker_that_ends_is_replaced():
    before = set(multiprocessing.active_children())
    with process_pool(1) as pool:
        assert pool.run(abs, [(-1,)]) == [1]
        (worker,) = set(multiprocessing.active_children()) - before
        worker.kill()
        worker.join()
        assert pool.run(abs, [(-2,)]) == [2]


def interrupt(_number):
    raise KeyboardInterrupt


def test_running_work_is_dropped_on_interrupt():
    before = set(multiprocessing.active_children())
    with pytest.raises(KeyboardInterrupt), process_pool(2) as pool:
        pool.run(time.sleep, [(0.0,), (1000.0,)], interrupt)
    deadline = time.monotonic() + 300.0
    while set(multiprocessing.active_children()) - before:
        assert time.monotonic() < deadline, "a worker goes on"
        time.sleep(0.01)
