"""The file under an independent implementation of MCAP and of protobuf: @mcap/core, protobufjs."""

import hashlib
import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from rigd.session.layout import SAMPLE_FIELDS, decode_controls

pytestmark = pytest.mark.process

NODE_FILES = Path(__file__).parent / "node"


@pytest.fixture(scope="module")
def script(request):
    """The reading script with its installed packages, which the pytest cache stores."""
    for program in ("node", "npm"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed")
    version = hashlib.sha256()
    for name in ("package.json", "package-lock.json"):
        version.update((NODE_FILES / name).read_bytes())
    folder = request.config.cache.mkdir(f"session_node_{version.hexdigest()[:12]}")
    if not (folder / "installed").exists():
        for name in ("package.json", "package-lock.json"):
            shutil.copy(NODE_FILES / name, folder)
        command = ["npm", "ci", "--ignore-scripts", "--no-audit", "--no-fund", "--fetch-retries=0"]
        try:
            result = subprocess.run(
                command, cwd=folder, capture_output=True, text=True, timeout=300, check=False
            )
        except subprocess.TimeoutExpired:
            pytest.skip("npm could not install the packages within 60 s")
        if result.returncode:
            pytest.skip(f"npm could not install the packages: {result.stderr.strip()[-300:]}")
        (folder / "installed").touch()
    return shutil.copy(NODE_FILES / "read_session.mjs", folder)


def test_the_reference_implementation_reads_everything(script, recorded, kit):
    result = subprocess.run(
        ["node", script, recorded.path], capture_output=True, text=True, timeout=300, check=False
    )
    assert result.returncode == 0, result.stderr
    found = json.loads(result.stdout)
    assert {topic: of["count"] for topic, of in found["topics"].items()} == {
        "/rig/sample": 1111,
        "/rig/control": 112,
        "/rig/event": 2,
    }
    assert found["statistics"] == found["streamed"] == 1225
    assert found["done"] is True
    controls = decode_controls(recorded.controls)
    for topic, expected in (("/rig/sample", recorded.samples), ("/rig/control", controls)):
        of = found["topics"][topic]
        names = expected.dtype.names
        assert of["first"] == dict(zip(names, expected[0].item(), strict=True))
        assert of["last"] == dict(zip(names, expected[-1].item(), strict=True))
        for name in names:
            np.testing.assert_allclose(
                of["sums"][name], expected[name].sum(dtype=float), rtol=1e-12, atol=1e-9
            )
    assert set(found["topics"]["/rig/sample"]["first"]) == set(SAMPLE_FIELDS)
    assert found["topics"]["/rig/event"]["first"]["message"] == "before the first tick"
    assert kit.METADATA.items() <= found["metadata"]["session"].items()
    assert found["metadata"]["outcome"] == kit.OUTCOME
    assert found["attachments"] == {k: v.decode() for k, v in kit.ATTACHMENTS.items()}
