"""The simulated rig: plant physics, and devices that show it to the loop."""
