"""What Rerun shows of a session: its layout, and what becomes of samples, events and health in it.

Rerun takes half a second to import, so it is imported by the functions that need it.
"""

APPLICATION_ID = "rigd"
"""Rerun keeps one layout for each application."""
