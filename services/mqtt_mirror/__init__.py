"""The mirror: it offers a Zenoh robot's topics on a broker on the robot."""
