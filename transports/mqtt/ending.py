"""Why a connection to an MQTT broker is not made, or ends."""

from pebble.transports.mqtt import reasons
from pebble.transports.mqtt.bridge_mode import Result
from pebble.transports.settings import MqttSettings

_SHOWN = 3  # filters
_LACKS = {reasons.NO_RETAIN: Result.RETAIN_REFUSED, reasons.NO_QOS: Result.QOS_REFUSED}


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


class Ending:
    """What the broker said when it refused or ended one connection; ``where`` is the broker, in words."""

    def __init__(self, where: str, settings: MqttSettings) -> None:
        self.where, self._settings = where, settings
        self.begun = False  # it has refused us, or sent DISCONNECT
        self.refusal: Refused | None = None
        self.reason = ""  # that of its DISCONNECT
        self.may_concern_message = False  # that reason
        self._taken_over = True  # may be: MQTT 3.1.1 has no words for it

    def refuse(self, code: int) -> None:
        self.begun, refused = True, f"{self.where} refused us: "
        if code == reasons.PROTOCOL_REFUSED and self._settings.protocol != "5":
            self.refusal = Refused(refused + Result.PROTOCOL_REFUSED.value, Result.PROTOCOL_REFUSED)
        else:
            self.refusal = Refused(refused + reasons.connection_refused(code), _LACKS.get(code, Result.FAILED))

    def disconnect(self, code: int) -> None:
        self.begun, self.reason = True, f"{self.where} closed the connection: {reasons.words(code)}"
        self._taken_over = code == reasons.TAKEN_OVER
        self.may_concern_message = reasons.may_concern_message(code)

    def lost(self, *, accepted: bool, asked: list[str]) -> Lost:
        """Return why the other side has closed a connection that it had ``accepted``, and was ``asked`` filters on."""
        why, id_ = self.reason or f"{self.where} closed the connection", self._settings.client_id
        if id_ is not None and accepted and self._taken_over:
            why += f' (does another client use the client id "{id_}"? a broker lets in only the newest)'
        if asked:
            more = f" and {len(asked) - _SHOWN} more" if len(asked) > _SHOWN else ""
            why += f", asked to deliver {', '.join(asked[:_SHOWN])}{more}"
        return Lost(why)
