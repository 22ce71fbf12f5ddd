"""The demo: four simulated robots of different kinds, the operator page, and a scripted operator that drives them."""
