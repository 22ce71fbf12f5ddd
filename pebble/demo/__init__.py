"""The demo: four simulated robots of different kinds, a scripted operator, and a judge of what they did."""
