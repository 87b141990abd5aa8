"""The command line of the rig: one module a command, light until a command runs."""
