"""Offline analyser of session files: frequency response and fractional damping models."""
