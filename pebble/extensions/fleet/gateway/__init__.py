"""A program that carries the robots of a Zenoh hub to an MQTT broker, and their operators' commands back."""
