"""Starts brokers, robots and workers as processes, for the demo, comparisons and tests."""
