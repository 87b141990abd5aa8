"""Optional packages, by the extra of ``pip install 'rigd[EXTRA]'`` that installs them."""

from importlib.util import find_spec
from typing import Final

from rigd.errors import FailureError

_MODULES_BY_EXTRA: Final = {
    "rig": ("aiohttp", "can", "canopen", "serial"),
    "live": ("rerun",),
}
"""Modules that each extra installs, except those whose absence a command reports itself."""


class MissingExtraError(FailureError):
    """Raised if an optional package is not installed; the message states how to install it."""


def require_extra(extra_name: str, subject: str) -> None:
    """Raise if the packages of an extra are not installed.

    Parameters
    ----------
    extra_name
        Name of the extra.
    subject
        Beginning of the message: what needs the packages.

    Raises
    ------
    MissingExtraError
        If a package is missing.
    """
    missing_modules = [
        module for module in _MODULES_BY_EXTRA[extra_name] if find_spec(module) is None
    ]
    if missing_modules:
        raise _missing_extra_error(subject, extra_name)


def explain_missing_module(error: ModuleNotFoundError) -> MissingExtraError | None:
    """Return the error to report for a missing module, or None if no extra installs the module."""
    module_name = (error.name or "").partition(".")[0]
    for extra_name, modules in _MODULES_BY_EXTRA.items():
        if module_name in modules:
            return _missing_extra_error("This command", extra_name)
    return None


def _missing_extra_error(subject: str, extra_name: str) -> MissingExtraError:
    """Return the error to raise if packages of an extra are missing."""
    return MissingExtraError(
        f"{subject} needs optional packages: pip install 'rigd[{extra_name}]'."
    )
