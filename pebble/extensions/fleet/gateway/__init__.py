"""The gateway: a program that forwards between the robots of a Zenoh hub and their operators' MQTT broker."""
