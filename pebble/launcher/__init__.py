"""Starts, watches, restarts and stops the processes of a robot, and says how they fare."""
