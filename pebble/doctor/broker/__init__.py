"""Judges a broker: what a robot and its operators have of it, found out below topics of its own."""
