"""Noise on the wire: the first part of what fuzz_ati_nodes.py does at length."""

import runpy
from pathlib import Path


def test_sensors_survive_noise():
    fuzz = runpy.run_path(str(Path(__file__).with_name("fuzz_ati_nodes.py")))["fuzz"]
    fuzz(20_000)
