"""Programs that move a robot: their base, the shipped ones, and perception."""
