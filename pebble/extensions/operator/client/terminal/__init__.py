"""Drives one robot with the keys of a terminal."""
