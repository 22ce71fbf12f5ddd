"""Plays an operator's voice: a jitter buffer, and a program that writes to the loudspeaker."""
