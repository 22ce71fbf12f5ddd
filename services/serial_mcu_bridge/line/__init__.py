"""The serial line itself: the open port, lines that wait to be sent, and the stop that is sent first and last."""
