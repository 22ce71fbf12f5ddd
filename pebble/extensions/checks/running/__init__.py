"""Checks of a running robot, end to end, from its own transport and from its operators' broker."""
