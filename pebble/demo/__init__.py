"""The demo: two simulated robots on different transports, a scripted operator, and a judge of what they did."""
