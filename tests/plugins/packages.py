"""Packages of one file that add parts by entry points, as pip leaves them in a folder."""

import os
import runpy
import subprocess
import sys
from pathlib import Path

import warm_start


def install(folder, package, version, code, entry_points):
    """Write module and metadata of a package; `entry_points` is the text of its file."""
    module = package.replace("-", "_")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{module}.py").write_text(code)
    metadata = folder / f"{module}-{version}.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Name: {package}\nVersion: {version}\n")
    (metadata / "entry_points.txt").write_text(entry_points)


def rigd_with(folder, *arguments, cwd=None, program=("-P", "-m", "rigd"), cold=False):
    """Run rigd with the packages of a folder; return exit code, output and errors.

    A `cold` start is of a new interpreter.
    """
    command = [sys.executable, *program, *map(str, arguments)]
    options = {"cwd": cwd or folder, "capture_output": True, "text": True}
    if cold:
        environment = os.environ | {"PYTHONPATH": str(folder)}
        done = subprocess.run(command, check=False, env=environment, **options)
    else:
        done = warm_start.run(command, check=False, packages=folder, **options)
    return done.returncode, done.stdout, done.stderr


def required_distributions(requirements):
    """Return the distributions that requirements name, and those that these require, by name."""
    program = runpy.run_path(str(Path(__file__).parents[2] / ".ci" / "dependencies.py"))
    return program["installed_requirements"](requirements)


DEVICES = Path(__file__).with_name("outside_devices.txt").read_text()
"""Code of a package with a drive and a sensor, both around the simulated rig."""

EXCITATION = Path(__file__).with_name("outside_excitation.txt").read_text()
"""Code of a package with the excitation ``triangle``."""

FORMAT = Path(__file__).with_name("outside_format.txt").read_text()
"""Code of a package with the import format ``.npz``."""

CONTROLLERS = Path(__file__).with_name("outside_controllers.txt").read_text()
"""Code of a package with three controllers: matrices, a shift of the reference, own code."""

STRUCTURE = Path(__file__).with_name("outside_structure.txt").read_text()
"""Code of a package with the damping structure ``zener``."""
