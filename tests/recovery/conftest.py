"""Sessions to damage, and the scripts of this folder."""

import importlib.util
import sys
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def load_script():
    """Return a function that imports a script of this folder, which has no importable name."""

    def load(name):
        spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name(f"{name}.py"))
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        spec.loader.exec_module(module)
        return module

    return load


@pytest.fixture(scope="session")
def fuzz_recovery(load_script):
    return load_script("fuzz_recovery")


@pytest.fixture(scope="session")
def original(fuzz_recovery, tmp_path_factory):
    """A sound session of 1.5 s with all channels."""
    path = tmp_path_factory.mktemp("original") / "a.mcap"
    return fuzz_recovery.load_original(fuzz_recovery.write_session(path, seconds=1.5))


@pytest.fixture
def torn(original, tmp_path):
    """The file of a process that died before it closed it, with 300 bytes of a chunk."""
    path = tmp_path / "a.mcap.part"
    path.write_bytes(original.data[: int(original.chunk_ends[3]) + 300])
    return path
