"""The simulated rig on the wire: nodes that speak CANopen, NETCANOEM and Modbus RTU."""
