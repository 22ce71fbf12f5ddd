"""The MQTT transport."""
