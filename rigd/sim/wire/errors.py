"""What the simulated rig refuses before anything has begun."""


class WrongUseError(ValueError):
    """What was asked for cannot be had; the message says why, for the operator."""
