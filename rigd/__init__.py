"""Real-time acquisition daemon for a slewing flexible antenna."""

__version__ = "0.1.0"
