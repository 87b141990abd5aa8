import json

import pytest

from rigd.profile import load_profile
from rigd.runner.planning import RigPreview

MODES = [
    {"frequency_hz": 2.57, "damping_ratio": 0.0091},
    {"frequency_hz": 16.01, "damping_ratio": 0.0042},
    {"frequency_hz": 44.8, "damping_ratio": 0.0099},
]


@pytest.fixture(scope="session")
def profile():
    return load_profile("sim")


@pytest.fixture(scope="session")
def rig(profile):
    return RigPreview(profile)


@pytest.fixture
def document(tmp_path):
    """Write a document with some modes, or with anything else."""

    def write(modes=MODES, **more):
        path = tmp_path / "fits.json"
        path.write_text(json.dumps({"modes": modes, **more}), encoding="utf-8")
        return path

    return write
