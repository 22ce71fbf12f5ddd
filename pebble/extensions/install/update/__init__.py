"""Signed releases, which make a newer version safe to install."""
