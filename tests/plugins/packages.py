"""Packages of one file that add parts by entry points, as pip leaves them in a folder."""

import os
import re
import subprocess
import sys
from importlib.metadata import distribution
from pathlib import Path

import warm_start
from packaging.requirements import Requirement


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


def required_distributions(distributions):
    """Return the distributions that some require, without extras, and those that these require."""
    found = {}
    waiting = list(distributions)
    while waiting:
        for text in waiting.pop().requires or ():
            requirement = Requirement(text)
            if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
                name = normalized(requirement.name)
                if name not in found:
                    found[name] = distribution(requirement.name)
                    waiting.append(found[name])
    return found


def normalized(name):
    """Return the name of a distribution as indexes write it."""
    return re.sub(r"[-_.]+", "-", name.lower())


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
