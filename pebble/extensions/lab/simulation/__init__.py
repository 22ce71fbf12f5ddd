"""Simulated robots and boards, on which the real firmware runs without hardware."""
