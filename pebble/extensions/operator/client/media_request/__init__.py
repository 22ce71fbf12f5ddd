"""One request for pictures or sound of a robot, however many look and listen."""
