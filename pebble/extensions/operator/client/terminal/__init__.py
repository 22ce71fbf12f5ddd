"""The terminal as an input of keys, for driving a robot with them."""
