"""Records the robot on the robot."""
