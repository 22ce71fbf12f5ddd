"""Starts brokers, robots, workers and operators as processes, for the demo, comparisons and tests."""
