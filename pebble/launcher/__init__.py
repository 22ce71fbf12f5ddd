"""Starts, supervises, restarts and stops the processes of a robot, and publishes their status."""
