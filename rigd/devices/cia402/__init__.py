"""A CiA 402 servo drive over CANopen, in cyclic synchronous torque mode."""
