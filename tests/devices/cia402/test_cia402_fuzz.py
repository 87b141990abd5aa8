"""A short run of ``fuzz_cia402.py``."""

import importlib.util
import struct
from dataclasses import replace
from pathlib import Path

import pytest
from cases import further

from rigd.devices.canbus import CanExchange
from rigd.devices.parameters import Acquisition


def load():
    spec = importlib.util.spec_from_file_location(
        "fuzz_cia402", Path(__file__).with_name("fuzz_cia402.py")
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("mode", ["same_tick", further("previous_tick")])
def test_only_device_errors_leave_the_driver(rig, settings, mode):
    fuzzer = load()
    quick = replace(
        rig,
        acquisition=Acquisition(mode, 1.0),
        cia402=replace(settings, enable_timeout_s=0.003),
    )
    ends = fuzzer.fuzz(quick, 12_000)
    assert 100 < ends < 12_000


def test_the_fuzzer_finds_a_failing_handler(rig, monkeypatch):
    subscribe = CanExchange.subscribe

    def subscribe_fragile(exchange, can_id, handler):
        def fragile(data):
            struct.unpack("8s", data)
            handler(data)

        subscribe(exchange, can_id, fragile)

    monkeypatch.setattr(CanExchange, "subscribe", subscribe_fragile)
    with pytest.raises(struct.error, match="unpack requires a buffer of 8 bytes"):
        load().fuzz(replace(rig, acquisition=Acquisition("same_tick", 1.0)), 12_000)
