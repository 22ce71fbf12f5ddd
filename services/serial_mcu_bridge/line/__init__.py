"""The serial line itself: the open port, what waits to be sent, and the stop that is sent first and last."""
