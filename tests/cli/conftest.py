import pytest


@pytest.fixture
def patient(write_profile):
    """The simulated rig, for sessions in real time on a machine that may stand still."""
    return write_profile("sim", patient=True)
