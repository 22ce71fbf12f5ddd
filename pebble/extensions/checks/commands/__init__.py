"""The commands that check a machine, a robot or a broker."""
