"""MQTT on a Zenoh robot: the robot's own topics on a broker on the robot, both ways."""
