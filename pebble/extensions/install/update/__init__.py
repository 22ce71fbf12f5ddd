"""Signed releases: they make a newer version safe to take."""
