"""Noise on the wire: the first part of what fuzz_ati_nodes.py does at length."""

import runpy
from pathlib import Path


def test_noise_raises_nothing_and_leaves_the_sensors_useful():
    fuzz = runpy.run_path(str(Path(__file__).with_name("fuzz_ati_nodes.py")))["fuzz"]
    fuzz(20_000)
