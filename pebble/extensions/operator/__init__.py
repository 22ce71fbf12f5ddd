"""Operators' programs: the client library and the commands that use it."""
