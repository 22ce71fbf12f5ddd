"""Checks of a broker: whom it lets in, what an account may do, and what robots have of it."""

from typing import Final

MOSQUITTO: Final = "in mosquitto.conf: "
OTHER: Final = "use another broker"
