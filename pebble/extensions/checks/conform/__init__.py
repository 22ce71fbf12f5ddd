"""Judges robots of other makers against the contract, from outside: only by what they publish and how they answer."""
