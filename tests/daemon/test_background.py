"""Predictions and checks of the daemon, each in a process of its own."""

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


def chirp_request(amplitude_rad):
    return CHIRP | {"parameters": CHIRP["parameters"] | {"amplitude_rad": amplitude_rad}}


def test_prediction_equals_the_plan_and_needs_no_rig(operate, profile):
    operated = operate()  # not connected
    reply = operated.request("predict", **chirp_request(0.01))
    excitation = excitation_for(profile, "chirp", chirp_request(0.01)["parameters"])
    planned = plan_session(profile, excitation)
    assert reply["plan"]["peak_torque_nm"] == planned.prediction.peak_torque_nm
    assert reply["plan"]["refused"] is None
    assert operated.service.controller is None
    largest_rad = reply["largest_amplitude_rad"]
    refused = operated.request("predict", **chirp_request(3.0))
    assert refused["largest_amplitude_rad"] == largest_rad
    assert "exceeds" in refused["plan"]["refused"]
    assert operated.request("predict", excitation="hold")["largest_amplitude_rad"] is None


def test_limit_of_the_tip_slope_in_a_request(operate):
    """As a field of the request or, from older clients, among the parameters."""
    operated = operate()
    plan = operated.request("predict", **chirp_request(0.05), tip_slope_rad=2.0)["plan"]
    assert "tip slope" not in (plan["refused"] or "")
    assert plan["limits"]["tip_slope_rad"] == 2.0
    older = {"targets": "damping 1%", "tip_slope_rad": 0.2}
    plan = operated.request("predict", excitation="until", parameters=older)["plan"]
    assert plan["parameters"]["tip_slope_rad"] == plan["limits"]["tip_slope_rad"] == 0.2


def test_invalid_prediction_request_is_refused(operate):
    refused = operate().request("predict", excitation="chirp", parameters={"stop_hz": 1e5})
    assert isinstance(refused, CommandError)
    assert "stop_hz" in str(refused)
    assert refused.wrong_use


def test_number_of_waiting_predictions_is_limited(operate, monkeypatch):
    operated = operate()

    async def wait_briefly(_):
        await asyncio.sleep(0.05)
        return {}

    monkeypatch.setattr(background, "perform", wait_briefly)

    async def predict_five_times():
        return await asyncio.gather(*(operated.handle("predict", **CHIRP) for _ in range(5)))

    *made, refused = operated.loop.run_until_complete(predict_five_times())
    assert made == [{}] * 4
    assert isinstance(refused, CommandError)


def test_refusal_if_the_prediction_process_ends(operate, monkeypatch):
    silent = replace(PREDICTION, module="keyword")
    monkeypatch.setattr(background.PredictionJob, "worker", silent)
    refused = operate().request("predict", **CHIRP)
    assert isinstance(refused, CommandError)
    assert "exit code 0" in str(refused)


def test_memory_limit_is_a_fraction_of_the_free_memory(tmp_path):
    def limit(available_kib):
        (tmp_path / "meminfo").write_text(f"MemFree: 1 kB\nMemAvailable:   {available_kib} kB\n")
        return PREDICTION.memory.bytes_now(tmp_path / "meminfo")

    assert limit(2_000_000) == 500_000 * 1024
    assert limit(100_000_000) == 4 << 30
    assert limit(100_000) == 256 << 20


@pytest.mark.process
def test_job_is_killed_first_if_memory_is_short():
    job = ChildProcess(PREDICTION)
    assert Path(f"/proc/{job.pid}/oom_score_adj").read_text() == "1000\n"
    assert resource.prlimit(job.pid, resource.RLIMIT_AS)[1] <= 4 << 30
    assert os.getpriority(os.PRIO_PROCESS, job.pid) == 19
    job.stop()
    assert not job.running


@pytest.mark.process
def test_prediction_without_enough_memory_is_refused(profile, monkeypatch):
    without_memory = replace(
        PREDICTION, memory=replace(PREDICTION.memory, available_fraction=0.0), niceness=0
    )
    monkeypatch.setattr(background.PredictionJob, "worker", without_memory)
    job = background.PredictionJob(profile, "chirp", {"duration_s": 2300.0}, False, "")
    with pytest.raises(CommandError, match="not enough free memory") as refused:
        asyncio.run(background.perform(job))
    assert refused.value.wrong_use


def test_check_reads_no_device_and_start_is_busy_meanwhile(operated, monkeypatch):
    replies = []

    async def start_first(job, perform=background.perform):
        replies.append(await operated.handle("start", **CHIRP))
        await operated.service.check_connection()
        return await perform(job)

    monkeypatch.setattr(background, "perform", start_first)
    report = operated.request("check")
    (refused,) = replies
    assert "busy (check)" in str(refused)
    rows = {row["what"]: row for row in report["rows"]}
    assert rows["devices: connection"]["text"] == "connected by the daemon"
    assert rows["sensor: device"]["text"] == "simulated force-torque sensor"
    assert {row["status"] for row in report["rows"]} <= {"ok", "warning", "failed", "skipped"}
    assert all(row.keys() == {"what", "status", "text", "remedy", "name"} for row in report["rows"])
    assert rows["travel: if the loop fails"]["name"] == "travel_loop_fails"
    assert operated.service.status()["last_check"]["verdict"] == report["verdict"]
    assert operated.state == "ready"


def test_check_is_refused_during_a_session(operated):
    def check(_):
        replies.append(operated.meanwhile("check"))

    replies = []
    operated.world.then, operated.world.countdown = check, 50
    brief = {"duration_s": 0.3, "rest_s": 0.0, "ring_down_s": 0.0}
    operated.request("start", excitation="hold", parameters=brief)
    assert "without a running session" in str(replies[0])


@pytest.mark.further  # as a connected one
def test_an_unconnected_rig_can_be_checked(operate):
    rows = {row["what"]: row for row in operate().request("check")["rows"]}
    assert rows["devices: connection"]["status"] == "skipped"
