"""Robots' pictures and sound for all pages of a server, by a connection of their own to the broker."""

import asyncio

from pebble.client.broker import Broker
from pebble.transports import MqttSettings
from pebble.web.media.connection import MediaConnection
from pebble.web.media.pictures import MediaHub
from pebble.web.media.sound import NoteTalk, SoundHub
from pebble.web.robots import Robots


class PicturesAndSound:
    """``note`` is told of each talk, for the audit log."""

    def __init__(self, broker: MqttSettings, robots: Robots, note: NoteTalk) -> None:
        self.connection = MediaConnection(Broker(broker, "pebble-web-media"))
        self.pictures = MediaHub(self.connection, robots)
        self.sound = SoundHub(self.connection, robots, note)

    async def close(self) -> None:
        """Withdraw all requests."""
        await asyncio.gather(self.pictures.close(), self.sound.close())
