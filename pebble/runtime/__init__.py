"""The base of every process of a robot: service, inbox, timers, connections, and notes to the launcher."""
