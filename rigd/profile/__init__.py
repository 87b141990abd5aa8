"""A rig's profile: one TOML file that says everything about the rig, with units and sources.

The loader is imported on first use: the control process is handed a profile that was validated,
and does not pay for the validation.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from rigd.profile.schema import Profile, RealtimeSettings, SessionSettings

if TYPE_CHECKING:
    from rigd.profile.load import ProfileError, load_profile

__all__ = ["Profile", "ProfileError", "RealtimeSettings", "SessionSettings", "load_profile"]


def __getattr__(name: str) -> object:
    if name in ("ProfileError", "load_profile"):
        return getattr(import_module("rigd.profile.load"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
