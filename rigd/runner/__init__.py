"""The supervisor: starts the processes of a rig, has them run sessions, and ends them."""
