"""Robots live in the Foxglove app."""
