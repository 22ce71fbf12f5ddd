"""Which client an MQTT connection uses: ours, or paho."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

from pebble.errors import TransportError
from pebble.transports.mqtt.client import Client

if TYPE_CHECKING:
    from pebble.transports.mqtt.paho_client import PahoClient

AnyClient: TypeAlias = "Client | PahoClient"


def client_class(name: str) -> type[AnyClient]:
    """The client of this name in the settings. Raises TransportError."""
    if name == "pebble":
        return Client
    if name != "paho":
        raise TransportError(f'client must be "pebble" or "paho", not "{name}"')
    try:
        from pebble.transports.mqtt.paho_client import PahoClient
    except ModuleNotFoundError as error:
        raise TransportError(
            f'"client": "paho" needs a package that is missing ({error}): pip install paho-mqtt, or leave out "client"'
        ) from None
    return PahoClient
