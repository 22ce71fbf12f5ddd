"""Recorded packets and what they have to become, made by the script beside them; and commands.json, written by hand."""
