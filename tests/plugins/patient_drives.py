"""Patience with simulated drives: how long they take to answer is the machine's affair."""

import pytest


@pytest.fixture
def patient_drives(monkeypatch):
    """Wait for a drive's answers and start as long as a machine does that is five times slower."""
    monkeypatch.setattr("rigd.devices.cia402._sdo._SDO_TIMEOUT_S", 2.5)
    monkeypatch.setattr("rigd.devices.cia402._node._OPERATIONAL_TIMEOUT_NS", 5_000_000_000)
