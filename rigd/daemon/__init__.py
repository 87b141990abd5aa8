"""The daemon: a rig that stays connected, and the socket over which it is operated."""
