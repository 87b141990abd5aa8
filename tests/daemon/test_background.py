"""Predictions and checks of the daemon, made in a process of their own, whatever else is done."""

import asyncio
import os
import resource
from dataclasses import replace
from pathlib import Path

import pytest
from operated_daemons import CommandError

from rigd.daemon import background
from rigd.engine.processes import ChildProcess
from rigd.engine.workers import PREDICTION
from rigd.runner.planning import excitation_for, plan_session

CHIRP = {"excitation": "chirp", "parameters": {"duration_s": 5.0, "ring_down_s": 1.0}}


def loud(amplitude_rad):
    return CHIRP | {"parameters": CHIRP["parameters"] | {"amplitude_rad": amplitude_rad}}


def test_a_prediction_is_that_of_a_start_and_needs_no_rig(operate, profile):
    operated = operate()  # not connected
    told = operated.ask("predict", **loud(0.01))
    excitation = excitation_for(profile, "chirp", loud(0.01)["parameters"])
    planned = plan_session(profile, excitation)
    assert told["plan"]["peak_torque_nm"] == planned.prediction.peak_torque_nm
    assert told["plan"]["refused"] is None
    assert operated.service.controller is None
    largest_rad = told["largest_amplitude_rad"]
    refused = operated.ask("predict", **loud(3.0))
    assert refused["largest_amplitude_rad"] == largest_rad
    assert "exceeds" in refused["plan"]["refused"]
    assert operated.ask("predict", excitation="hold")["largest_amplitude_rad"] is None


def test_the_limit_of_the_slope_is_given_with_a_request(operate):
    """As a member of it, or as clients of before an update have it: among the parameters."""
    operated = operate()
    plan = operated.ask("predict", **loud(0.05), tip_slope_rad=2.0)["plan"]
    assert "tip slope" not in (plan["refused"] or "")
    assert plan["limits"]["tip_slope_rad"] == 2.0
    older = {"targets": "damping 1%", "tip_slope_rad": 0.2}
    plan = operated.ask("predict", excitation="until", parameters=older)["plan"]
    assert plan["parameters"]["tip_slope_rad"] == plan["limits"]["tip_slope_rad"] == 0.2


def test_what_no_prediction_can_be_made_of_is_refused(operate):
    told = operate().ask("predict", excitation="chirp", parameters={"stop_hz": 1e5})
    assert isinstance(told, CommandError)
    assert "stop_hz" in str(told)
    assert told.wrong_use


def test_only_so_many_predictions_wait(operate, monkeypatch):
    operated = operate()

    async def never(_):
        await asyncio.sleep(0.05)
        return {}

    monkeypatch.setattr(background, "perform", never)

    async def many():
        return await asyncio.gather(*(operated.handle("predict", **CHIRP) for _ in range(5)))

    *made, refused = operated.loop.run_until_complete(many())
    assert made == [{}] * 4
    assert isinstance(refused, CommandError)


def test_a_process_that_ends_is_a_refusal(operate, monkeypatch):
    silent = replace(PREDICTION, module="keyword")
    monkeypatch.setattr(background.PredictionJob, "worker", silent)
    told = operate().ask("predict", **CHIRP)
    assert isinstance(told, CommandError)
    assert "exit code 0" in str(told)


def test_of_the_free_memory_a_job_may_have_a_part(tmp_path):
    def limit(available_kib):
        (tmp_path / "meminfo").write_text(f"MemFree: 1 kB\nMemAvailable:   {available_kib} kB\n")
        return PREDICTION.memory.bytes_now(tmp_path / "meminfo")

    assert limit(2_000_000) == 500_000 * 1024
    assert limit(100_000_000) == 4 << 30
    assert limit(100_000) == 256 << 20


@pytest.mark.process
def test_a_job_is_the_first_that_is_killed_for_lack_of_memory():
    job = ChildProcess(PREDICTION)
    assert Path(f"/proc/{job.pid}/oom_score_adj").read_text() == "1000\n"
    assert resource.prlimit(job.pid, resource.RLIMIT_AS)[1] <= 4 << 30
    assert os.getpriority(os.PRIO_PROCESS, job.pid) == 19
    job.stop()
    assert not job.running


@pytest.mark.process
def test_a_prediction_without_the_memory_is_refused(profile, monkeypatch):
    little = replace(PREDICTION, memory=replace(PREDICTION.memory, fraction=0.0), niceness=0)
    monkeypatch.setattr(background.PredictionJob, "worker", little)
    job = background.PredictionJob(profile, "chirp", {"duration_s": 2300.0}, False, "")
    with pytest.raises(CommandError, match="not enough free memory") as refused:
        asyncio.run(background.perform(job))
    assert refused.value.wrong_use


def test_a_check_asks_no_device_and_keeps_a_start_waiting(operated, monkeypatch):
    asked = []

    async def look_first(job, perform=background.perform):
        asked.append(await operated.handle("start", **CHIRP))
        await operated.service.check_connection()
        return await perform(job)

    monkeypatch.setattr(background, "perform", look_first)
    told = operated.ask("check")
    (refused,) = asked
    assert "busy (check)" in str(refused)
    rows = {row["what"]: row for row in told["rows"]}
    assert rows["devices: connection"]["text"] == "connected by the daemon"
    assert rows["sensor: device"]["text"] == "simulated force-torque sensor"
    assert {row["status"] for row in told["rows"]} <= {"ok", "warning", "failed", "skipped"}
    assert all(row.keys() == {"what", "status", "text", "remedy"} for row in told["rows"])
    assert operated.service.status()["last_check"]["verdict"] == told["verdict"]
    assert operated.state == "ready"


def test_a_check_is_for_a_rig_without_a_session(operated):
    def check(_):
        told.append(operated.meanwhile("check"))

    told = []
    operated.world.then, operated.world.countdown = check, 50
    brief = {"duration_s": 0.3, "rest_s": 0.0, "ring_down_s": 0.0}
    operated.ask("start", excitation="hold", parameters=brief)
    assert "without a running session" in str(told[0])


@pytest.mark.further  # as a connected one
def test_an_unconnected_rig_can_be_checked(operate):
    rows = {row["what"]: row for row in operate().ask("check")["rows"]}
    assert rows["devices: connection"]["status"] == "skipped"
