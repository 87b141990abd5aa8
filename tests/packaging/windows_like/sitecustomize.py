"""Make the interpreter resemble Python on Windows to `rigd` and `analysis`.

Packages of MISSING_PACKAGES are not installed.

Python imports this module at its start if its folder is in PYTHONPATH, so worker processes have it
as well. Other packages exist for Windows, and see the real system. What remains of this system:
`sys.platform`, separators of paths, and start of processes.
"""

import builtins
import json
import os
import re
import sys
import types
from pathlib import Path

MISSING = json.loads(os.environ["MISSING_ON_WINDOWS"])
"""Module → its names that Windows does not have; None if it does not have the module."""
RESERVED = re.compile(r'(?i)[<>:"|?*\x00-\x1f]|[. ]$|^(?:con|prn|aux|nul|com\d|lpt\d)(?:\.|$)')
import_module, rename = builtins.__import__, os.rename


def windows_module(name):
    module = types.ModuleType(name)
    module.__dict__.update(
        {key: value for key, value in vars(sys.modules[name]).items() if key not in MISSING[name]}
    )
    return module


def windows_import(name, globals=None, *arguments, **options):  # noqa: A002 - its name in Python
    """Import a module; the packages under test get it as it is on Windows."""
    namespace = globals or {}
    importer = namespace.get("__package__") or namespace.get("__name__") or ""
    if name not in MISSING or importer.partition(".")[0] not in ("rigd", "analysis"):
        return import_module(name, globals, *arguments, **options)
    if MISSING[name] is None:
        raise ModuleNotFoundError(f"No module named '{name}'", name=name)
    import_module(name)
    return modules.setdefault(name, windows_module(name))


def windows_rename(source, target, **folders):
    if os.path.lexists(target):  # other than `os.replace`
        raise FileExistsError(17, "Cannot create a file when that file already exists", target)
    rename(source, target, **folders)


def is_open(path):
    """Return whether this process has a file open, or one in a folder."""
    path = os.path.realpath(path)
    for descriptor in Path("/proc/self/fd").iterdir():
        try:
            opened = str(descriptor.readlink())
        except OSError:
            continue
        if opened == path or opened.startswith(path + "/"):
            return True
    return False


def refuse(event, arguments):
    """Refuse what Windows refuses; called before each use of a file."""
    if event in ("os.fork", "os.forkpty"):
        raise AttributeError(event)
    if event == "open" and isinstance(arguments[0], (str, bytes)):
        path, _, flags = arguments
        path = os.fsdecode(path)
        if path.startswith(("/proc/", "/sys/")):
            raise FileNotFoundError(2, "No such file or directory", path)
        if Path(path).is_dir():
            raise PermissionError(13, "Permission denied", path)
        names = [path] if flags & (os.O_CREAT | os.O_WRONLY | os.O_RDWR) else []
    elif event in ("os.mkdir", "os.rename", "os.link"):
        names = [os.fsdecode(each) for each in arguments[:2] if isinstance(each, (str, bytes))]
    else:
        names = []
    for path in names:
        if path != os.devnull and RESERVED.search(Path(path).name):
            raise OSError(22, "The filename, directory name, or volume label is incorrect", path)
    if event in ("os.remove", "os.rename") and is_open(os.fsdecode(arguments[0])):
        raise PermissionError(13, "The file is used by another process", arguments[0])


modules = {}
sys.modules.update(dict.fromkeys(json.loads(os.environ["MISSING_PACKAGES"])))
builtins.__import__ = windows_import
os.rename = windows_rename
sys.addaudithook(refuse)
