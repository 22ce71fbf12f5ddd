"""MQTT by the package paho-mqtt, as a transport that is found by its entry point."""
