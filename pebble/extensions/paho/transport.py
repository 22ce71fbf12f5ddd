"""The transport ``paho``: MQTT, by the client of paho-mqtt instead of Pebble's own."""

from pathlib import Path
from typing import Any, ClassVar, cast

from pebble.errors import TransportError
from pebble.extensions.paho.client import PahoClient
from pebble.transports import Message, MqttSettings, TlsSettings
from pebble.transports.mqtt.client import Client
from pebble.transports.mqtt.transport import MqttTransport


class PahoTransport(MqttTransport):
    """An MQTT transport on paho. ``settings``: `MqttSettings`, or its fields as an object in a config."""

    client_class: ClassVar = cast("type[Client]", PahoClient)  # it has the same methods

    def __init__(self, client_id: str, settings: MqttSettings | dict[str, Any], *, will: Message | None = None) -> None:
        if not isinstance(settings, MqttSettings):
            try:
                settings = _from_config(**settings)
            except TypeError as error:
                raise TransportError(f"settings of the transport paho: {error}") from None
        super().__init__(client_id, settings, will=will)


def _from_config(*, tls: dict[str, Any] | None = None, as_published: bool = True, **fields: Any) -> MqttSettings:
    """Return the settings with these fields of a config, in which the paths of files are texts."""
    certificates = None if tls is None else TlsSettings(**_with_paths(tls))
    return MqttSettings(**_with_paths(fields), tls=certificates, as_published=as_published)


def _with_paths(fields: dict[str, Any]) -> dict[str, Any]:
    files = ("ca_cert", "client_cert", "client_key", "password_file")
    return {name: Path(value) if name in files and value else value for name, value in fields.items()}
