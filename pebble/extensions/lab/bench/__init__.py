"""Comparative runs: this way against that way, in one run on one machine."""
