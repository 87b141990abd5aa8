"""Estimates of touches: a session while the touch process prepares."""

import json
import time
from dataclasses import replace
from types import SimpleNamespace

import pytest

from rigd.engine.messages import TouchReady, TouchReport
from rigd.engine.shared_state import StateField, StopReason
from rigd.engine.workers import TOUCH
from rigd.runner._touch_search import TouchClient
from rigd.session.touches import touch_line, touches_of


class Group(dict):
    """Processes that are all the same one."""

    def __init__(self, messages):
        self.channels = SimpleNamespace(
            specs=None,
            samples=SimpleNamespace(written_count=0),
            shared_state={StateField.STOP_REASON: StopReason.NONE},
        )
        self.child = SimpleNamespace(send=lambda _: None, messages=messages)

    def idle_process(self, _):
        return self.child

    def __getitem__(self, _):
        return self.child


def make_client(group):
    order = SimpleNamespace(shear_projection=None)
    return TouchClient(group, SimpleNamespace(order=order, model=None), 1000.0)


def test_stop_does_not_wait_for_the_touch_process():
    begun_s = time.monotonic()
    waits = iter([True, False])
    touches = make_client(Group(lambda _: []))
    touches.await_ready(lambda: next(waits))
    assert time.monotonic() - begun_s < 2.0
    assert touches.poll() == []


@pytest.mark.parametrize(
    ("messages", "words"), [([TouchReady()], []), ([], ["was not ready within 0 s. Touches are"])]
)
def test_session_waits_for_the_touch_process(monkeypatch, messages, words):
    monkeypatch.setattr(TouchClient, "worker", replace(TOUCH, start_timeout_s=0.0))
    touches = make_client(Group(lambda _: messages))
    touches.await_ready(lambda: True)
    texts = [event.message for event in touches.poll()]
    assert len(texts) == len(words)
    assert all(each in text for each, text in zip(words, texts, strict=True))


def test_first_estimate_without_a_better_one_is_marked(monkeypatch):
    monkeypatch.setattr("rigd.runner._touch_search._FINAL_ESTIMATES_TIMEOUT_S", 0.0)
    x = {"value": 0.6, "std": 0.01, "interval_95": [0.58, 0.62]}
    reports = [TouchReport(1, 900, True, {"x_m": x}), TouchReport(2, 2900, False, {"x_m": x})]
    touches = make_client(Group(lambda _: reports))
    touches.poll()
    found = touches.finish(3, lambda: None)
    assert [touch.get("final") for touch in found] == [None, False, None]
    for each in (found, touches_of({"touches": json.dumps(found)})):
        final, first, without = map(touch_line, each)
        assert "first estimate" not in final + without
        assert first.endswith("(first estimate)")
        assert without == "Touch 3: not estimated"


def test_stop_ends_the_wait_for_estimates(monkeypatch):
    monkeypatch.setattr("rigd.runner._touch_search._WAIT_ANNOUNCED_AFTER_S", 0.0)
    monkeypatch.setattr("rigd.runner._worker_client._STOPPED_RESULTS_TIMEOUT_S", 0.0)
    group = Group(lambda _: [])  # a suspended process
    touches = make_client(group)
    texts = []

    def report_and_stop():
        assert len(texts) < 5, "the stop has no effect"
        texts.append([event.message for event in touches.poll()])
        if len(texts) == 2:
            group.channels.shared_state[StateField.STOP_REASON] = StopReason.OPERATOR

    assert touches.finish(1, report_and_stop) == [{"number": 1}]
    assert texts == [["Waiting for the estimates of the touches; a stop skips them."], []]
