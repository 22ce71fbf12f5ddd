"""Why a connection to an MQTT broker is not made, or ends."""

from pebble.transports.mqtt.bridge_mode import Result


class Lost(Exception):  # noqa: N818  (an event, not a mistake)
    """The connection was lost, or could not be made. Its text explains why."""


class Silent(Lost):
    """The other side does not answer."""


class Absent(Lost):
    """Nothing listens there."""


class TlsLate(Lost):
    """TCP is there, and TLS was not in time."""


class Refused(Lost):
    """The broker refused our CONNECT, or closed the connection instead of answering."""

    def __init__(self, text: str, result: Result = Result.FAILED) -> None:
        super().__init__(text)
        self.result = result
