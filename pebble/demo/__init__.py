"""The demo: four simulated robots of different kinds, a scripted operator, and an assessment of every step."""
