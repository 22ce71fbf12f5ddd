"""The commands that set up a machine or a board."""
