"""Receives the pictures of a robot on this machine through shared memory, in place of an operators' broker."""

import time
from pathlib import Path

from pebble.cameras import Camera, camera
from pebble.client.media_receiver import MediaReceiver
from pebble.contract import VIDEO_OVERLAYS
from pebble.media.decode import Decoded
from pebble.transports import Transport


class LocalReceiver(MediaReceiver):
    """Pictures and overlays, no sound. ``transport`` is the robot's own; :meth:`poll` reads the newest picture."""

    def __init__(self, transport: Transport, base: str, config: Path) -> None:
        """Raises DeviceError if the robot does not run on this machine."""
        super().__init__(transport, base)
        self._camera: Camera = camera(config)
        self._overlays = transport.subscribe(VIDEO_OVERLAYS.topic(base), self._on_overlays, direct=True)

    def wait_for_capabilities(self, timeout: float) -> None:
        """Return at once: the camera needs none."""

    def request(self, encoding: str | None, *, sound: bool) -> None:
        """Change nothing: the pictures are those of the camera, whoever else receives them."""

    def poll(self) -> None:
        picture, frame = self._camera.newest(), self._camera.frame
        if picture is None or frame is None:
            return
        self.newest = Decoded(picture, captured_ms=None, frame=None, keyframe=True, encoding="local")
        self.encoding["video"] = "local"
        self.pictures.add(time.monotonic(), picture.nbytes)

    def close(self) -> None:
        self._overlays.close()
        self._camera.close()
        super().close()
