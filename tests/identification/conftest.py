import pytest

from rigd.profile import load_profile


@pytest.fixture(scope="session")
def profile():
    return load_profile("sim")
