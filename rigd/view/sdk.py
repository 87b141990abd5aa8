"""Rerun does what it is told here, whatever its user has set for programs of their own."""

import os
from collections.abc import Mapping


def without_settings(environment: Mapping[str, str]) -> dict[str, str]:
    """Return an environment without what is meant for Rerun: ``RERUN=off`` and so on."""
    return {
        name: value
        for name, value in environment.items()
        if not name.lstrip("_").startswith("RERUN")
    }


def settle_sdk() -> None:
    """Prepare this process's environment for the SDK; to be called before it is imported.

    What it has to say of a server that is gone or of a full disk is told by us.
    """
    for name in os.environ.keys() - without_settings(os.environ).keys():
        del os.environ[name]
    os.environ["RUST_LOG"] = "off"
