"""Checks of a robot that runs, end to end, from its own side and from its operators'."""
