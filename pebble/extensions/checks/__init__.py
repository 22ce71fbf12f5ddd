"""Checks of a machine, of a broker, of a robot that runs, and of a robot by the contract: one engine, four tables."""
