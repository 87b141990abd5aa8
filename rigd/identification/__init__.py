"""Identification of the motor from recorded sessions: experiments, estimate, proposal."""
