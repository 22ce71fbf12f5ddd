"""Signed releases, by which a newer version can be installed safely."""
