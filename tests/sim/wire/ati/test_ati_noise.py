"""Noise on the wire: a short run of fuzz_ati_nodes.py."""

import runpy
from pathlib import Path


def test_sensors_survive_noise():
    fuzz = runpy.run_path(str(Path(__file__).with_name("fuzz_ati_nodes.py")))["fuzz"]
    fuzz(20_000)
