"""Signed releases, which make it safe to install a newer version."""
