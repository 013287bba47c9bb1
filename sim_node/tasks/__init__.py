"""The tasks that can be simulated."""
