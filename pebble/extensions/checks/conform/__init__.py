"""Conformance of a robot to the contract, judged from outside: by what it publishes and how it answers."""
