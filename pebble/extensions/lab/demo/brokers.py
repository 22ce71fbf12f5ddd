"""The demo's brokers: mosquitto where it is installed, else amqtt from the extra ``demo``.

``python -m pebble.extensions.lab.demo.brokers PORT`` runs amqtt on loopback.
"""

import asyncio
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from typing import Any

from pebble.errors import PebbleError
from pebble.extensions.lab.rig.processes import HOST
from pebble.extensions.operator.places import mosquitto_path

EMBEDDED = "pebble.extensions.lab.demo.brokers"  # the module that runs amqtt


def broker_program() -> str | None:
    """Return the module that runs as the broker; None: mosquitto. Raises PebbleError if neither is installed."""
    if mosquitto_path() is not None:
        return None
    if find_spec("amqtt") is not None:
        return EMBEDDED
    raise PebbleError(
        "no broker: install mosquitto (apt install mosquitto) or amqtt (pip install 'pebble-robot[demo]')"
    )


class _Subscriptions(dict[str, Any]):
    """Subscriptions that may grow while amqtt 0.12.1 iterates over them, which would end its service of a client."""

    def __iter__(self) -> Iterator[str]:
        return iter(list(self.keys()))

    def items(self) -> Any:
        return list(super().items())


async def serve_amqtt(port: int) -> None:
    """Run amqtt on loopback until the task is cancelled."""
    from amqtt.broker import Broker as AmqttBroker  # optional

    listeners = {"default": {"type": "tcp", "bind": f"{HOST}:{port}"}}
    plugins = {"amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": True}}
    broker = AmqttBroker({"listeners": listeners, "plugins": plugins})
    broker._subscriptions = _Subscriptions()  # in place of a dict, which must not grow during an iteration
    await broker.start()
    await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(serve_amqtt(int(sys.argv[1])))
