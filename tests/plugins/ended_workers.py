"""Functions for workers that end by themselves; they import little, as each worker does too."""

import os


def call_unless_one(function, source, *arguments):
    """Call a function, but end the process that is given 1.mcap, as lack of memory does."""
    if source.path.name == "1.mcap":
        os._exit(9)
    return function(source, *arguments)


def end_at_zero(number):
    """Return a number, but end the process that is given a 0."""
    if number == 0:
        os._exit(3)
    return number
