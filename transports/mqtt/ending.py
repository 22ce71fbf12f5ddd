"""Reasons why a connection to an MQTT broker could not be made, or has ended."""

from pebble.transports.mqtt.bridge_mode import Result


class Lost(Exception):  # noqa: N818  (an event, not a mistake)
    """An error: a connection could not be made, or is lost. Its text explains why."""


class Silent(Lost):
    """An error: the other side does not answer."""


class Absent(Lost):
    """An error: nothing listens at the address."""


class TlsLate(Lost):
    """An error: TLS takes too long, although TCP was connected in time."""


class Refused(Lost):
    """An error: the broker refused our CONNECT, or closed the connection instead of answering."""

    def __init__(self, text: str, result: Result = Result.FAILED) -> None:
        super().__init__(text)
        self.result = result
