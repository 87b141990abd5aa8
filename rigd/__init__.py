"""Real-time acquisition daemon for a slewing flexible antenna."""

__version__ = "1.0.0"
