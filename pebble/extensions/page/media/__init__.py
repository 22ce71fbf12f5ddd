"""Pictures and sound between robots and pages: one request for each robot, however many pages use it."""
