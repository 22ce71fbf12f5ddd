"""Reasons why a connection to an MQTT broker is not made, or ends."""

from pebble.transports.mqtt.bridge_mode import Result


class Lost(Exception):  # noqa: N818  (an event, not a mistake)
    """Loss of a connection, or failure to make one. Its text explains why."""


class Silent(Lost):
    """Silence: the other side does not answer."""


class Absent(Lost):
    """Absence: nothing listens there."""


class TlsLate(Lost):
    """Delay of TLS, after TCP was there in time."""


class Refused(Lost):
    """Refusal of our CONNECT, or a connection closed instead of an answer."""

    def __init__(self, text: str, result: Result = Result.FAILED) -> None:
        super().__init__(text)
        self.result = result
