"""Checks of a robot's conformance to the contract, from outside: by its messages and its answers."""
