"""The link to operators: heartbeat, mirroring between the robot and a remote broker, flags and system commands."""
