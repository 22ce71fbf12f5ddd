"""Recorded packets and what they have to become; each file is made by the script beside it."""
