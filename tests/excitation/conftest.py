import json
from functools import partial

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


def written(folder, modes=MODES, **more):
    path = folder / "fits.json"
    path.write_text(json.dumps({"modes": modes, **more}), encoding="utf-8")
    return path


@pytest.fixture
def document(tmp_path):
    """Write a document with some modes, or with anything else."""
    return partial(written, tmp_path)


@pytest.fixture(scope="session")
def document_of_modes(tmp_path_factory):
    """A document with three modes."""
    return written(tmp_path_factory.mktemp("modes"))
