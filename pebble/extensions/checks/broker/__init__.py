"""Checks of a broker: its logins, the rights of an account, and how it delivers and retains messages."""

from typing import Final

MOSQUITTO: Final = "in mosquitto.conf: "
OTHER: Final = "use another broker"
