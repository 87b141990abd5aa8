"""A rig's profile: one TOML file that says everything about the rig, with units and sources."""

from rigd.profile.load import ProfileError, load_profile
from rigd.profile.settings import Profile, RealtimeSettings, SessionSettings

__all__ = ["Profile", "ProfileError", "RealtimeSettings", "SessionSettings", "load_profile"]
