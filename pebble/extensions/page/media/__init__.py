"""Pictures and sound between robots and pages: one request per robot, however many pages use it."""
