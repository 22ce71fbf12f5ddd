"""Recordings for pages: the routes, and the process that reads the archive."""
