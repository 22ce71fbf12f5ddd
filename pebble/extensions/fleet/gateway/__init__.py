"""The gateway: forwards between the robots of a Zenoh hub and their operators' MQTT broker."""
