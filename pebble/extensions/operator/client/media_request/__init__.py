"""A single request for a robot's pictures or sound on behalf of all viewers."""
