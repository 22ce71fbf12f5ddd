"""The launcher of a robot: starts, supervises, restarts and stops its processes, and publishes their status."""
